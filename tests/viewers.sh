#!/bin/sh
# What other programs read in the files of `dgtr export`, against the model itself: PlayCanvas' splat-transform (SOG), pygltflib (glTF),
# our own reader (SPZ; the tests compare it with the crate spz); bytes of a Gaussian, PSNR and SSIM on held-out pictures.
#   tests/viewers.sh MODEL.dgtr DATASET [FOLDER]
# Not part of .ci/run: it loads packages from npm and PyPI. Wants node, npm, python3 with venv.
set -eu
[ $# -ge 2 ] || { echo "viewers.sh: give a MODEL.dgtr and a DATASET" >&2; exit 2; }
here=$(cd "$(dirname "$0")/.." && pwd)
model=$(realpath "$1") data=$(realpath "$2") out=${3:-$(mktemp -d)}
dgtr=${CARGO_TARGET_DIR:-$here/target}/release/dgtr
[ -x "$dgtr" ] || { echo "viewers.sh: $dgtr is not there; cargo build --release -p runtime" >&2; exit 2; }
mkdir -p "$out" && cd "$out"

[ -d venv ] || { python3 -m venv venv && venv/bin/pip install --quiet pygltflib numpy; }
[ -d node_modules ] || npm install --silent --no-save --ignore-scripts --prefix . @playcanvas/splat-transform@3.7.0
cp "$model" exact.dgtr
for format in sog spz gltf; do "$dgtr" export exact.dgtr --to "$format" >/dev/null; done

node node_modules/@playcanvas/splat-transform/bin/cli.mjs -w exact.sog theirs.ply >/dev/null 2>&1
venv/bin/python "$here/tests/viewers.py" move theirs.ply exact.sog.georef.json sog.ply
venv/bin/python "$here/tests/viewers.py" glb exact.glb glb.ply
"$dgtr" import sog.ply --out sog.dgtr
"$dgtr" import glb.ply --out glb.dgtr
"$dgtr" import exact.spz --out spz.dgtr

gaussians=$("$dgtr" export exact.dgtr --to ply | sed 's/.*: \([0-9]*\) Gaussians.*/\1/')
for format in dgtr sog spz glb; do
    name=$([ "$format" = dgtr ] && echo exact || echo "$format")
    "$dgtr" eval "$name.dgtr" "$data" --split test --json 2>/dev/null |
        venv/bin/python -c 'import json, os, sys
d, (file, n) = json.load(sys.stdin), sys.argv[1:]
print("%-9s %6.1f bytes a Gaussian  %.2f dB  %.4f" % (file[6:], os.path.getsize(file) / int(n), d["psnr"], d["ssim"]))' \
            "exact.$format" "$gaussians"
done
