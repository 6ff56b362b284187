#!/bin/sh
# Poses of a card, ours and COLMAP's (PyPI pycolmap), on the same machine, two threads each: seconds, registered pictures, reprojection
# error, agreement with reference poses. Prints a Markdown table for each card.
#   tests/peers.sh DATASET [--counts "43 86"] [--simulated 300] [--out DIR]
# The pictures of DATASET carry EXIF; --simulated adds a card of some so many pictures that `dgtr sim` takes. Nothing else should run.
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
usage() { echo "usage: tests/peers.sh DATASET [--counts LIST] [--simulated N] [--out DIR]" >&2; exit 2; }
[ $# -ge 1 ] || usage
data=$(realpath "$1"); shift
counts="43 86" simulated=300 out=peers-out
while [ $# -gt 0 ]; do
    [ $# -ge 2 ] || usage
    case "$1" in
        --counts) counts="$2" ;;
        --simulated) simulated="$2" ;;
        --out) out="$2" ;;
        *) usage ;;
    esac
    shift 2
done
dgtr=${CARGO_TARGET_DIR:-$here/target}/release/dgtr
[ -x "$dgtr" ] || { echo "peers.sh: $dgtr is not there; cargo build --release -p runtime" >&2; exit 2; }
mkdir -p "$out" && cd "$out"
[ -d venv ] || { python3 -m venv venv && venv/bin/pip install --quiet pycolmap numpy; }
peers() { venv/bin/python "$here/tests/peers.py" "$@"; }
export OMP_NUM_THREADS=2 RAYON_NUM_THREADS=2

both() {
    "$dgtr" train "$1" --out "run-$1" --fresh --steps 1 --no-eval --max-gaussians 20000 >/dev/null
    peers ours "run-$1" "$1-ours.json"
    peers colmap "$1" "$1-incremental.json"
    peers colmap "$1" "$1-incremental-2000.json" --features 2000
    peers colmap "$1" "$1-global.json" --mapper global
    peers compare "$1" "$1-ours.json" "$1-incremental.json" "$1-incremental-2000.json" "$1-global.json"
}

for n in $counts; do
    peers card "$data" "card$n" --pictures "$n"
    both "card$n"
done
if [ "$simulated" -gt 0 ]; then
    # 305 pictures over 240 m.
    cat > mission.toml <<MISSION
name = "peers"
origin = { lat_deg = 47.4, lon_deg = 8.5, alt_m = 400.0 }
camera = { width = 640, height = 480, fx = 520.0, fy = 520.0, cx = 320.0, cy = 240.0 }
[[aircraft]]
id = "a"
link = "udpin:127.0.0.1:14550"
camera = { folder = "pictures" }
region_enu = [[0, 0], [$((simulated * 4 / 5)), 0], [$((simulated * 4 / 5)), 100], [0, 100]]
MISSION
    [ -d simulated ] || "$dgtr" sim --mission mission.toml --card simulated --cross --pitch -75
    both simulated
fi
