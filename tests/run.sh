#!/bin/sh
# All tests. A test that does not find what it needs fails, unless DGTR_SKIP names that (tests/needs/src/lib.rs). Of a Vulkan device and
# ONNX Runtime setup.sh sees to it that they are there; of the rest this script names what the machine lacks.
# Arguments go to `cargo test`; without any, the tests of the whole, which fly by the clock, run beside those of the crates.
# DGTR_FEATURES=hal/v4l2 adds what is not built by default.
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
cd "$here"
sh runtime/setup.sh --tests

skip=${DGTR_SKIP:-}
lacks() { case ",$skip," in *",$1,"*) ;; *) skip="${skip:+$skip,}$1" ;; esac; }
has() { command -v "$1" >/dev/null 2>&1; }
[ -d "${DGTR_DATA:-../shared}/data" ] || lacks data
[ -d "${DGTR_DATA:-../shared}/field/cards" ] || lacks cases
[ -n "${DGTR_S3_TEST:-}" ] || lacks bucket
{ has chromium || has chromium-browser || has google-chrome; } && has node || lacks chromium
has npm || lacks viewer
getent hosts localhost >/dev/null 2>&1 || lacks localhost
layer=vulkan/explicit_layer.d/VkLayer_khronos_validation.json
[ -e "/usr/share/$layer" ] || [ -e "/etc/$layer" ] || lacks validation-layer
fetched=$(mktemp -d)
python3 -c 'import ensurepip, venv' 2>/dev/null && python3 -m pip download -q --no-deps -d "$fetched" pyserial==3.5 >/dev/null 2>&1 ||
    lacks python-packages
rm -rf "$fetched"
export DGTR_SKIP="$skip"
[ -z "$skip" ] || echo "=== tests that need $skip are SKIPPED: this machine lacks that (DGTR_SKIP) ===" >&2
all="--release --locked --workspace ${DGTR_FEATURES:+--features $DGTR_FEATURES}"
# shellcheck disable=SC2086
if [ $# -gt 0 ]; then exec cargo test $all "$@"; fi

# shellcheck disable=SC2086
cargo test $all --no-run
log=$(mktemp)
flying=
trap 'rm -f "$log"; [ -z "$flying" ] || kill "$flying" 2>/dev/null || true' EXIT
trap 'exit 130' INT TERM
# The same packages for both, so that neither compiles anything anew.
whole=$(for file in tests/tests/*.rs; do echo "--test $(basename "$file" .rs)"; done)
# shellcheck disable=SC2086
cargo test $all --no-fail-fast $whole > "$log" 2>&1 &
flying=$!
failed=0
# What flies comes first.
# shellcheck disable=SC2086
nice -n 10 cargo test $all --no-fail-fast --exclude tests || failed=$?
# On a processor the program's own kernels ran; the driver's, which are those of every other device, on the same promises.
driver="bands compiles_once degrees gradients half_moments masks numerical_gpu repeatable stages steady walk"
# shellcheck disable=SC2086
DGTR_PROCESSOR=driver nice -n 10 cargo test $all --no-fail-fast $(for test in $driver; do echo "--test $test"; done) || failed=$?
wait "$flying" || failed=$?
flying=
cat "$log"
exit "$failed"
