#!/bin/sh
# What each format makes of a model: bytes for each of its Gaussians, milliseconds to write and to read, PSNR and SSIM on held-out
# pictures; then what the first bytes of the file show that goes to the ground.
#   tests/codecs.sh MODEL.dgtr FOR_DELIVERY.dgtr delivery|fine DATASET [FOLDER]
# FOR_DELIVERY is the same scene trained with --for-delivery (=fine). Bytes are for each Gaussian of MODEL. Wants python3; zstd if there.
set -eu
[ $# -ge 4 ] || { echo "codecs.sh: give a MODEL.dgtr, one trained for delivery, delivery or fine, and a DATASET" >&2; exit 2; }
here=$(cd "$(dirname "$0")/.." && pwd)
model=$(realpath "$1") trained=$(realpath "$2") encoding=$3 data=$(realpath "$4") out=${5:-$(mktemp -d)}
dgtr=${CARGO_TARGET_DIR:-$here/target}/release/dgtr
[ -x "$dgtr" ] || { echo "codecs.sh: $dgtr is not there; cargo build --release -p runtime" >&2; exit 2; }
fine=$([ "$encoding" = fine ] && echo --fine || true)
mkdir -p "$out" && out=$(realpath "$out")

# Scores FILE: PSNR, tab, SSIM.
score() {
    "$dgtr" eval "$1" "$data" --split test --json 2>/dev/null |
        python3 -c 'import json, sys; d = json.load(sys.stdin); print("%.2f\t%.4f" % (d["psnr"], d["ssim"]))'
}

# FILE SCORED BYTES_EACH MS_WRITE MS_READ.
row() { printf '| %s | %s | %s | %s | %s |\n' "$1" "$3" "$(score "$2" | sed 's/\t/ dB, /')" "$4" "$5"; }

cd "$here"
DGTR_MODEL="$model" DGTR_OUT="$out" cargo test --quiet --release --locked -p models --test codecs -- --ignored --nocapture |
    grep '	' > "$out/measured"
cd "$out"
gaussians=$("$dgtr" export "$model" --to ply --out counted.ply | sed 's/.*: \([0-9]*\) Gaussians.*/\1/')
rm counted.ply
echo "$gaussians Gaussians"
echo "| file | bytes a Gaussian | PSNR, SSIM | ms to write | ms to read |"
echo "| --- | ---: | ---: | ---: | ---: |"
while IFS="$(printf '\t')" read -r file each writing reading; do
    scored=$file
    case $file in
    *.spz | *.ply) scored=$file.dgtr && "$dgtr" import "$file" --out "$scored" >/dev/null ;;
    esac
    row "$file" "$scored" "$each" "$writing" "$reading"
done < measured
each() { python3 -c 'import os, sys; print("%.2f" % (os.path.getsize(sys.argv[1]) / int(sys.argv[2])))' "$1" "$gaussians"; }
now() { python3 -c 'import time; print(round(time.monotonic() * 1e3))'; }
if command -v zstd >/dev/null; then
    began=$(now) && zstd -q -f -19 -T1 exact.dgtr && written=$(now) && zstd -q -d -c exact.dgtr.zst >/dev/null && read=$(now)
    row "zstd -19 of exact.dgtr" exact.dgtr "$(each exact.dgtr.zst)" $((written - began)) $((read - written))
fi
began=$(now)
"$dgtr" export "$trained" --to delivery $fine --out delivered.dgtr >/dev/null
row "trained for it, $encoding" delivered.dgtr "$(each delivered.dgtr)" "$(($(now) - began)) (whole command)" ""

echo
echo "| first bytes of the delivered file | PSNR, SSIM |"
echo "| ---: | ---: |"
for kilobytes in 25 50 75 100 150 200 300 400; do
    [ $((kilobytes * 1000)) -lt "$(wc -c < delivered.dgtr)" ] || break
    head -c "${kilobytes}000" delivered.dgtr > part.dgtr
    printf '| %s | %s |\n' "${kilobytes},000" "$(score part.dgtr | sed 's/\t/ dB, /')"
done
printf '| %s | %s |\n' "$(wc -c < delivered.dgtr)" "$(score delivered.dgtr | sed 's/\t/ dB, /')"
