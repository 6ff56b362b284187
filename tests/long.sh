#!/bin/bash
# A long flight: `dgtr sim` flies a survey of as many pictures as asked, `dgtr fly` makes the model in a fixed plan, under a bound on
# its memory. What is asked of it: memory that does not grow with the flight, and a new picture in the model within
# seconds, however long the flight is already.
#   tests/long.sh [--pictures N] [--width W] [--speed X] [--seconds S] [--gaussians G] [--on-device H] [--degree D] [--out DIR]
# N pictures of a region of 600 × 400 m per 1,000; W pixels wide (4:3); X seconds of flight per second; S seconds of training after
# the landing (0.24 a picture); at most G Gaussians (560 a picture, 2.3 for a square metre) with SH of degree D (1), of which the
# device holds H at once (all) and the others wait in cells on the disk. Prints resident
# memory and processor time by hundreds of key frames, seconds from picture to model, and the PSNR of held-out views by thirds of the
# flight (needs python3). Ends with 0 when the flight ended with a model within its bounds.
set -euo pipefail
here=$(cd "$(dirname "$0")/.." && pwd)
pictures=1000 width=1280 speed=1 seconds= gaussians= on_device= degree=1 out=long-out
usage() { echo "usage: tests/long.sh [--pictures N] [--width W] [--speed X] [--seconds S] [--gaussians G] [--on-device H] [--degree D] [--out DIR]" >&2; exit 2; }
while [ $# -gt 0 ]; do
    [ $# -ge 2 ] || usage
    case "$1" in
        --pictures) pictures="$2" ;; --width) width="$2" ;; --speed) speed="$2" ;; --seconds) seconds="$2" ;;
        --gaussians) gaussians="$2" ;; --on-device) on_device="$2" ;; --degree) degree="$2" ;; --out) out="$2" ;;
        *) usage ;;
    esac
    shift 2
done
seconds="${seconds:-$(awk -v n="$pictures" 'BEGIN { print n * 0.24 }')}" gaussians="${gaussians:-$((pictures * 560))}"
on_device="${on_device:-$gaussians}"
dgtr="${DGTR:-$here/target/release/dgtr}"
[ -x "$dgtr" ] || cargo build --quiet --release --locked --config "$here/.cargo/config.toml" --manifest-path "$here/Cargo.toml" --package runtime
rm -rf "$out"; mkdir -p "$out/camera"
cd "$out"
# The memory of a software device is the host's: 512 MiB of it and 1,024 besides.
device_mib=512 host_mib=1536

# 48 × 36 m of ground a picture from 40 m; 12 m to the next on the line and 20 m to the next line.
awk -v n="$pictures" -v w="$width" -v d="$device_mib" -v h="$host_mib" -v s="$seconds" -v g="$gaussians" -v held="$on_device" -v degree="$degree" 'BEGIN {
    k = sqrt(n / 1000) / 2
    printf "name = \"long\"\nseed = 7\norigin = { lat_deg = 46.0, lon_deg = 7.0, alt_m = 500.0 }\n"
    f = w / 1.2
    printf "camera = { width = %d, height = %d, fx = %f, fy = %f, cx = %f, cy = %f, exposure_delay_ms = 60.0 }\n", w, w * 3 / 4, f, f, w / 2, w * 3 / 8
    printf "keyframes = { t_min_m = 6.0, max = %d }\n", n * 1.1 + 16
    printf "memory = { device_mib = %d, host_mib = %d, max_gaussians = %d, scene_gaussians = %d }\n", d, h, held, g
    printf "training = { seconds = %f, sh = { degree = %d } }\nupload = { folder = \"upload\" }\n", s, degree
    # The schedule after the landing is short on purpose: nothing is to be given up for it in flight.
    printf "failsafe = { behind_visits = 0.0, far_behind_visits = 0.0 }\n"
    printf "[[aircraft]]\nid = \"one\"\nlink = \"serial:port:921600\"\ncamera = { folder = \"camera\" }\n"
    x = 600 * k; y = 400 * k
    printf "region_enu = [[%f, %f], [%f, %f], [%f, %f], [%f, %f]]\n", -x, -y, x, -y, x, y, -x, y
}' > mission.toml

"$dgtr" sim --mission mission.toml --link "pty:$PWD/port" --speed "$speed" --forward-overlap 0.667 --side-overlap 0.583 \
    --reference "$PWD/truth" --linger 20 > sim.log 2>&1 &
sim=$!
fly=
trap 'kill "$sim" ${fly:+"$fly"} 2>/dev/null || true' EXIT
while [ ! -e port ]; do kill -0 "$sim" || { cat sim.log >&2; exit 1; }; sleep 0.1; done
DGTR_KERNELS=default "$dgtr" --limit-mib "$host_mib" fly --mission mission.toml --out out --silence 120 > fly.log 2>&1 &
fly=$!

# Seconds, key frames, resident MiB, seconds of processor time.
sample() {
    local frames rss cpu
    frames=$(grep -c 'key frame [0-9]' fly.log || true)
    rss=$(awk '/^VmRSS/ { print $2 / 1024 }' "/proc/$fly/status" 2>/dev/null) || return 0
    cpu=$(awk -v hz="$(getconf CLK_TCK)" '{ sub(/^.*\) /, ""); print ($12 + $13) / hz }' "/proc/$fly/stat" 2>/dev/null) || return 0
    [ -z "$rss" ] || echo "$((SECONDS - begun)) $frames $rss $cpu" >> samples
}
begun=$SECONDS
while kill -0 "$fly" 2>/dev/null; do sample; sleep 2; done
code=0; wait "$fly" || code=$?
wait "$sim" || true

echo "$pictures pictures of ${width} pixels at ${speed}x: fly ended with $code after $((SECONDS - begun)) s"
[ "$code" = 0 ] && [ -s out/model.dgtr ] || { tail -n 3 fly.log >&2; echo "long.sh: failed" >&2; exit 1; }
# By hundreds of key frames: resident memory, its mean and its most (what a growth takes for a moment comes and goes), and processor time.
awk '$2 > 0 { h = int(($2 - 1) / 100); n[h]++; sum[h] += $3; if ($3 > most[h]) most[h] = $3; cpu[h] = $4; upto[h] = $2; if (h > last) last = h }
    END { for (h = 0; h <= last; h++) if (h in n) {
        printf "  up to key frame %4d: %4d MiB resident, %4d at most, %.2f s of processor time each\n", upto[h], sum[h] / n[h], most[h], (cpu[h] - before) / (upto[h] - at)
        before = cpu[h]; at = upto[h] } }' samples
DGTR_KERNELS=default "$dgtr" eval out/model.dgtr truth --split test --scale "$(awk -v w="$width" 'BEGIN { s = 640 / w; print s < 1 ? s : 1 }')" --json > eval.json
python3 - <<'PY'
import json
run, scores = json.load(open("out/run.json")), [view["psnr"] for view in json.load(open("eval.json"))["views"]]
waits, growth = run["picture_to_model_s"], run.get("growth", {})
print(f"  {run['steps']} steps, {run['gaussians']} Gaussians; a picture to the model: median {waits['median']:.2f} s, a tenth beyond {waits['p90']:.2f}")
print("  by hundred:", " ".join(f"{median:.2f}" for median in waits["median_by_hundred"]))
if growth:
    each = lambda name: growth[name] / growth["growths"]
    print(f"  of each of {growth['growths']} growths: {each('depths'):.1f} depth maps, {each('adjusted_frames'):.1f} poses, {each('adjusted_observations'):.0f} sightings; all poses {growth['whole_solves']} times")
third = len(scores) // 3
mean = lambda part: sum(part) / len(part)
print(f"  held-out PSNR by thirds of the flight: {mean(scores[:third]):.2f} {mean(scores[third:-third]):.2f} {mean(scores[-third:]):.2f} dB")
PY
