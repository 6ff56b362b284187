#!/bin/sh
# Feed-forward initialisation against structure from motion (PyPI pycolmap): the same pictures, two threads each, for growing numbers
# of pictures and two sizes. Prints seconds and their ratio as a Markdown table; with --quality also held-out PSNR from both starts.
#   tests/sfm.sh DATASET [--counts "43 86 300"] [--scales "1 0.5"] [--out DIR] [--quality "300 1000"]
# A count up to the number of training pictures takes those (key frames first); above it all pictures; above that, pictures of
# mirrored and negative copies of the scene beside it, which no matcher takes for the same place.
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
usage() { echo "usage: tests/sfm.sh DATASET [--counts LIST] [--scales LIST] [--out DIR] [--quality STEPS]" >&2; exit 2; }
[ $# -ge 1 ] || usage
data="$1"; shift
[ -f "$data/transforms.json" ] || { echo "sfm.sh: $data/transforms.json is not there" >&2; exit 2; }
counts="43 86 300" scales="1 0.5" out=sfm-out quality=
while [ $# -gt 0 ]; do
    [ $# -ge 2 ] || usage
    case "$1" in
        --counts) counts="$2" ;;
        --scales) scales="$2" ;;
        --out) out="$2" ;;
        --quality) quality="$2" ;;
        *) usage ;;
    esac
    shift 2
done
dgtr="$here/target/release/dgtr"
[ -x "$dgtr" ] || cargo build --quiet --release --locked --config "$here/.cargo/config.toml" --manifest-path "$here/Cargo.toml" --package runtime
mkdir -p "$out"
if [ -n "${DGTR_SFM_PYTHON:-}" ]; then
    python="$DGTR_SFM_PYTHON"
else
    venv=$(mktemp -d)
    trap 'rm -rf "$venv"' EXIT
    python3 -m venv "$venv" && "$venv/bin/pip" install --quiet pycolmap pillow numpy
    python="$venv/bin/python"
fi
export OMP_NUM_THREADS=2 RAYON_NUM_THREADS=2

# number FILE PATH…: a number out of a JSON file.
number() { "$python" -c 'import json,sys; v=json.load(open(sys.argv[1]))
for k in sys.argv[2:]: v=v[k]
print(v)' "$@"; }

echo "| pictures | size | SfM: extract + match + map | SfM, s | feed-forward, s | ms per picture | ratio |"
echo "|---|---|---|---|---|---|---|"
for scale in $scales; do
    for count in $counts; do
        set="$out/$count-$scale"
        "$python" "$here/tests/sfm.py" prepare "$data" "$set" --pictures "$count" --scale "$scale" >&2
        "$python" "$here/tests/sfm.py" run "$set" --threads 2 >&2
        "$dgtr" train "$set" --out "$set/feed-forward" --split train --init feed-forward --steps 1 --max-gaussians 200000 \
            --budget-mib 2048 --scale 1 --no-eval --fresh >&2
        "$python" - "$set" <<'P'
import json, pathlib, sys
folder = pathlib.Path(sys.argv[1])
sfm, own = json.loads((folder / "sfm.json").read_text()), json.loads((folder / "feed-forward/run.json").read_text())
seconds, n = own["stage_ms"]["init"] / 1e3, sfm["pictures"]
parts = " + ".join(f"{sfm[k]:.1f}" for k in ("extract_s", "match_s", "map_s"))
print(f"| {n} | {sfm['width']}×{sfm['height']} | {parts} ({sfm['registered']} registered, {sfm['points']} points) | {sfm['total_s']:.1f}"
      f" | {seconds:.2f} | {1e3 * seconds / n:.0f} | {sfm['total_s'] / seconds:.2f} |")
P
    done
done
[ -n "$quality" ] || exit 0
echo
echo "| pictures | size | start | steps | PSNR, dB | SSIM |"
echo "|---|---|---|---|---|---|"
for scale in $scales; do
    for count in $counts; do
        set="$out/$count-$scale"
        [ -f "$set/sparse/0/points3D.bin" ] || continue
        for init in sfm feed-forward; do
            for steps in $quality; do
                "$dgtr" train "$set" --out "$set/$init-$steps" --init "$init" --steps "$steps" --max-gaussians 200000 \
                    --budget-mib 1024 --fresh >&2
                run="$set/$init-$steps/run.json"
                [ "$(number "$run" psnr)" != None ] || continue
                printf '| %s | %s | %s | %s | %.2f | %.3f |\n' "$count" "$scale" "$init" "$steps" \
                    "$(number "$run" psnr)" "$(number "$run" ssim)"
            done
        done
    done
done
