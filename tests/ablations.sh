#!/bin/sh
# The paper's two ablations on a data set: scales of Σ (global, local) and the depth loss (on/off, shape freezing), as held-out
# PSNR and SSIM in two Markdown tables. The last row of both is the default recipe: one training, shown twice.
#   tests/ablations.sh DATASET [--steps N] [--max-gaussians N] [--out DIR] [further arguments of dgtr train]
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
usage() { echo "usage: tests/ablations.sh DATASET [--steps N] [--max-gaussians N] [--out DIR] [train arguments]" >&2; exit 2; }
[ $# -ge 1 ] || usage
data="$1"; shift
[ -d "$data" ] || { echo "ablations.sh: $data is not there" >&2; exit 2; }
steps=1000 gaussians=200000 out=ablations-out
while [ $# -gt 0 ]; do
    case "$1" in
        --steps) steps="$2"; shift 2 ;;
        --max-gaussians) gaussians="$2"; shift 2 ;;
        --out) out="$2"; shift 2 ;;
        *) break ;;
    esac
done
dgtr="$here/target/release/dgtr"
[ -x "$dgtr" ] || cargo build --quiet --release --locked --config "$here/.cargo/config.toml" --manifest-path "$here/Cargo.toml" --package runtime
mkdir -p "$out"

# train NAME 'SETTINGS' [train arguments]: one training, unless its run.json is already there.
train() {
    name="$1" settings="$2"; shift 2
    [ -f "$out/$name/run.json" ] && return
    printf '%b' "$settings" > "$out/$name.toml"
    "$dgtr" train "$data" --out "$out/$name" --init feed-forward --steps "$steps" --max-gaussians "$gaussians" \
        --settings "$out/$name.toml" --fresh "$@" >&2
}
field() { sed -n "s/^  \"$2\": \([0-9.]*\),*\$/\1/p" "$out/$1/run.json"; }
row() { printf '| %s | %.2f | %.3f |\n' "$1" "$(field "$2" psnr)" "$(field "$2" ssim)"; }

train scales-off-off '[init]\nglobal_scale = false\nlocal_scale = false\n' "$@"
train scales-on-off '[init]\nglobal_scale = true\nlocal_scale = false\n' "$@"
train depth-off '[training.loss]\ndepth = 0.0\n' "$@"
train depth-on-off '[training.loss]\nfreeze_shape = false\n' "$@"
train all-on '[init]\nglobal_scale = true\nlocal_scale = true\n[training.loss]\nfreeze_shape = true\n' "$@"

echo "$(basename "$data"), $steps steps, at most $gaussians Gaussians, held out:"
echo
echo "| global / local scale | PSNR, dB | SSIM |"
echo "|---|---|---|"
row "off / off" scales-off-off
row "on / off" scales-on-off
row "on / on" all-on
echo
echo "| depth loss / shape freezing | PSNR, dB | SSIM |"
echo "|---|---|---|"
row "off / off" depth-off
row "on / off" depth-on-off
row "on / on" all-on
