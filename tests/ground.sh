#!/bin/bash
# One merge by one process, by the three commands, by Ray with two workers, by Ray with one of them killed half-way, and by the commands
# of the Slurm and Kubernetes recipes: the same global model, to the byte. Then what the recipes' files say is held against them.
#   tests/ground.sh OUT [MODEL…]    without models: those of a simulated field of six aircraft
# Needs python3 with ray (PYTHON=…/bin/python3) and, for the bucket, moto[server]; what is missing is named and skipped.
set -euo pipefail
here=$(cd "$(dirname "$0")/.." && pwd)
dgtr=${DGTR:-$here/target/release/dgtr}
python=${PYTHON:-python3}
out=$1
shift
mkdir -p "$out"
export DGTR_KERNELS=default
how=(--epochs "${EPOCHS:-1}" --scale 0.5 --cell-m "${CELL_M:-64}")
if [ $# = 0 ]; then
    [ -e "$out/field/ground/received" ] || cargo run --quiet --release --locked --config "$here/.cargo/config.toml" --manifest-path "$here/Cargo.toml" --package bench -- ground --aircraft 6 --side-m 240 --out "$out/field" > /dev/null
    set -- "$out"/field/ground/received/*/model.dgtr
fi

hash_of() { sha256sum < "$1/global.dgtr" | cut -d ' ' -f 1; }
wanted=
same() { # NAME FOLDER
    local got
    got=$(hash_of "$2")
    wanted=${wanted:-$got}
    if [ "$got" = "$wanted" ]; then echo "same   $1"; else echo "DIFFERS $1: $got, not $wanted"; exit 1; fi
}

rm -rf "$out"/{one,by-hand,ray,killed,slurm,kubernetes}*
time "$dgtr" -q aggregate "$@" --out "$out/one" "${how[@]}" > /dev/null
same "one process" "$out/one"

"$dgtr" -q ground plan "$@" --store "$out/by-hand-store" "${how[@]}" > "$out/keys"
echo "       $(wc -l < "$out/keys") cells"
# In no order at all, by two at once.
sort -R "$out/keys" | xargs -P 2 -n 3 "$dgtr" -q ground cell --store "$out/by-hand-store" > /dev/null
"$dgtr" -q ground join --store "$out/by-hand-store" --out "$out/by-hand" > /dev/null
same "three commands, shuffled, two at once" "$out/by-hand"

by_ray() { "$python" "$here/runtime/ground/ray_ground.py" --dgtr "$dgtr" --workers 2 --store "$out/$1-store" --out "$out/$1" "${@:2}" -- "${how[@]}" > "$out/$1.log" 2>&1; }
if "$python" -c 'import ray' 2> /dev/null; then
    by_ray ray "$@" || { cat "$out/ray.log"; exit 1; }
    same "Ray, two workers" "$out/ray"

    by_ray killed "$@" &
    job=$!
    # Half of the cells are there: a worker and what it runs are killed.
    half=$(($(wc -l < "$out/keys") / 2))
    killed=
    while kill -0 "$job" 2> /dev/null && [ -z "$killed" ]; do
        there=$(find "$out/killed-store" -path '*/cells/*' -type f 2> /dev/null | wc -l || true)
        child=$(pgrep -f "ground cell .*--store $out/killed-store" | head -1 || true)
        if [ "$there" -ge "$half" ] && [ -n "$child" ]; then
            worker=$(ps -o ppid= -p "$child" | tr -d ' ' || true)
            [ -n "$worker" ] && kill -9 "$worker" "$child" 2> /dev/null && killed="$worker and $child"
        fi
        sleep 0.02
    done
    wait "$job" || { cat "$out/killed.log"; exit 1; }
    [ -n "$killed" ] || { echo "nobody was killed: too few cells for it"; exit 1; }
    same "Ray, a worker killed ($killed)" "$out/killed"
else
    echo "Ray skipped: $python has none (pip install ray)"
fi

# What an array's jobs run, with the variables that the engines set.
export DGTR=$dgtr JOBS=3
mkdir -p "$out/slurm-bin"
cat > "$out/slurm-bin/sbatch" <<'FAKE'
#!/bin/bash
# What Slurm does with the recipe's calls, one after the other.
array=
while [ $# -gt 0 ]; do
    case $1 in
        --array=0-*) array=${1#--array=0-} ;;
        --wrap) sh -c "$2" > /dev/null; echo 1; exit ;;
        --*) ;;
        *) break ;;
    esac
    shift
done
for i in $(seq 0 "$array"); do SLURM_ARRAY_TASK_ID=$i SLURM_ARRAY_TASK_COUNT=$((array + 1)) "$@" > /dev/null; done
echo 1
FAKE
chmod +x "$out/slurm-bin/sbatch"
STORE=$out/slurm-store OUT=$out/slurm PATH="$(cd "$out/slurm-bin" && pwd):$PATH" "$here/runtime/ground/slurm.sh" "$@" "${how[@]}" > /dev/null
same "Slurm's recipe (a stand-in for sbatch)" "$out/slurm"

"$dgtr" -q ground plan "$@" --store "$out/kubernetes-store" "${how[@]}" > /dev/null
if "$python" -c 'import yaml' 2> /dev/null; then
    # The container's own command, once for each index of the job.
    "$python" - "$here/runtime/ground/kubernetes.yaml" "$dgtr" "$out/kubernetes-store" <<'RUN'
import os, subprocess, sys, yaml
job = yaml.safe_load(open(sys.argv[1]))
spec = job["spec"]
container = spec["template"]["spec"]["containers"][0]
env = {e["name"]: e["value"] for e in container["env"]}
assert job["kind"] == "Job" and spec["completionMode"] == "Indexed" and env["SHARES"] == str(spec["completions"])
env.update(STORE=sys.argv[3], PATH=os.path.dirname(sys.argv[2]) + ":" + os.environ["PATH"])
for index in range(spec["completions"]):
    own = {**os.environ, **env, "JOB_COMPLETION_INDEX": str(index)}
    subprocess.run(container["command"], env=own, check=True, stdout=subprocess.DEVNULL)
RUN
    "$dgtr" -q ground join --store "$out/kubernetes-store" --out "$out/kubernetes" > /dev/null
    same "Kubernetes' recipe (its command, without Kubernetes)" "$out/kubernetes"
else
    echo "Kubernetes skipped: $python has no yaml"
fi

if "$python" -c 'import moto.server' 2> /dev/null; then
    port=$((20000 + RANDOM % 20000))
    "$python" -m moto.server -H 127.0.0.1 -p $port > "$out/moto.log" 2>&1 &
    moto=$!
    trap 'kill "$moto" 2> /dev/null || true' EXIT
    export AWS_ENDPOINT_URL=http://127.0.0.1:$port AWS_REGION=us-east-1 AWS_ACCESS_KEY_ID=test AWS_SECRET_ACCESS_KEY=test
    for _ in $(seq 100); do
        "$python" -c "import boto3; boto3.client('s3').create_bucket(Bucket='field')" 2> /dev/null && break
        sleep 0.2
    done
    "$dgtr" -q ground plan "$@" --store s3://field/merge "${how[@]}" > "$out/bucket-keys"
    xargs -P 2 -n 4 "$dgtr" -q ground cell --store s3://field/merge < "$out/bucket-keys" > /dev/null
    "$dgtr" -q ground join --store s3://field/merge --out "$out/bucket" > /dev/null
    same "a bucket (moto)" "$out/bucket"
else
    echo "bucket skipped: $python has no moto (pip install 'moto[s3,server]')"
fi
