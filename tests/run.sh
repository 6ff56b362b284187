#!/bin/sh
# All tests. What a test needs and does not find (the large data sets, python3, the validation layers) it names and skips.
# Arguments go to `cargo test`; without any, the tests of the whole, which fly by the clock, run beside those of the crates.
# DGTR_FEATURES=hal/v4l2 adds what is not built by default.
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
cd "$here"
sh runtime/setup.sh --tests
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
wait "$flying" || failed=$?
flying=
cat "$log"
exit "$failed"
