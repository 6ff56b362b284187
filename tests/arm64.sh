#!/bin/bash
# dgtr for the boards' processor, without a board. As arm64 programs under qemu: the unit tests of config, hal and models, what
# `dgtr doctor` finds, a small training on Mesa's lavapipe with first Gaussians by ONNX Runtime's arm64 library, and three steps
# of fox at a quarter of its size (where the data set is), whose loss and PSNR are compared with this machine's own.
#   tests/arm64.sh [build|test|train]...      default all; half an hour on two cores, most of it compilers
# Not part of .ci/run, which only checks that everything compiles for arm64. What it needs and does not find it names, and skips.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
cd "$here/.."
skip() { echo "arm64.sh: skipped: $*"; exit 0; }
[ $# -gt 0 ] || set -- build test train
# shellcheck source=boards/kit.sh
. "$here/boards/kit.sh"
# shellcheck source=package/onnxruntime.sh
. "$here/package/onnxruntime.sh"
# shellcheck source=package/cross.sh
. "$here/package/cross.sh"
target=aarch64-unknown-linux-gnu lib=/usr/lib/aarch64-linux-gnu
native_rustc=${RUSTC:-rustc}
why=$(cross_compiler $target) || skip "$why"
cross_compiler $target
out=${CARGO_TARGET_DIR:-target}/arm64
mkdir -p "$out"
out=$(cd "$out" && pwd)
[ -e "$out/libonnxruntime.so" ] || onnxruntime aarch64 "$out"

# emulated PROGRAM ARGUMENTS…: on lavapipe, which computes; paths are looked for in the arm64 root first.
emulator="$kit/qemu/usr/bin/qemu-aarch64 -L $kit/root -E LD_LIBRARY_PATH=$lib -E VK_DRIVER_FILES=/usr/share/vulkan/icd.d/lvp_icd.json"
emulator="$emulator -E ORT_DYLIB_PATH=$out/libonnxruntime.so -E DGTR_KERNELS=default"
emulated() { $emulator "$@"; }
export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER="$emulator"
cross() { local verb=$1; shift; cargo "$verb" --release --locked --target $target --target-dir "$out" "$@"; }
program=$out/$target/release/dgtr

build() {
    cross build -p runtime --no-default-features --features zenoh,v4l2 --bin dgtr
    cp "$program" "$out/dgtr-onboard"
    cross build -p runtime --features v4l2 --bin dgtr
    cp "$program" "$out/dgtr"
    aarch64-linux-gnu-strip -o "$out/stripped" "$out/dgtr-onboard" && stat -c 'what flies: %s bytes, stripped' "$out/stripped"
    aarch64-linux-gnu-strip -o "$out/stripped" "$out/dgtr" && stat -c 'everything: %s bytes, stripped' "$out/stripped"
}

# qemu's vfork is a fork: who starts a program that is not there does not hear of it. And a test that starts itself once more asks
# the kernel for an arm64 program, without the emulator.
test_units() {
    cross test -p config -p hal -p models --lib -- \
        --skip a_program_that_does_not_exist_is_named --skip a_library_that_is_there_but_cannot_be_opened_is_not_called_found
}

# figure NAME FILE: a number of run.json.
figure() { python3 -c 'import json, sys; print(json.load(open(sys.argv[2]))[sys.argv[1]])' "$1" "$2"; }

train() {
    [ -x "$out/dgtr" ] || { echo "arm64.sh: build first: tests/arm64.sh build train" >&2; exit 2; }
    emulated "$out/dgtr" doctor
    local data="${DGTR_DATA:-$here/../../shared}/data"
    [ -d "$data/fox" ] || skip "no $data/fox: what was trained cannot be compared"
    RUSTC=$native_rustc cargo build --release --locked -p runtime --bin dgtr
    local steps="--steps 3 --scale 0.25 --max-gaussians 12000 --budget-mib 64"
    # shellcheck disable=SC2086
    DGTR_KERNELS=default "${CARGO_TARGET_DIR:-target}/release/dgtr" -q train "$data/fox" --init sfm $steps --out "$out/fox-here"
    # shellcheck disable=SC2086
    emulated "$out/dgtr" -q train "$data/fox" --init sfm $steps --out "$out/fox-arm64"
    emulated "$out/dgtr" -q train "$data/sheffield_cross" --init feed-forward --steps 1 --scale 0.25 --max-gaussians 12000 --no-eval --out "$out/network"
    local of here_has arm64_has
    for of in loss psnr; do
        here_has=$(figure $of "$out/fox-here/run.json") arm64_has=$(figure $of "$out/fox-arm64/run.json")
        echo "$of: $here_has here, $arm64_has on arm64"
        # Another Mesa (its exponentials) and other instructions (fused multiplications): the last digits differ.
        python3 -c "import sys; sys.exit(abs($here_has - $arm64_has) > 1e-3 * abs($here_has))" ||
            { echo "arm64.sh: they differ by more than a thousandth" >&2; exit 1; }
    done
}

for part in "$@"; do
    case $part in
        build) build ;;
        test) test_units ;;
        train) train ;;
        *) echo "arm64.sh: unknown part $part" >&2; exit 2 ;;
    esac
done
