#!/bin/sh
# All tests. What a test needs and does not find (the large data sets, python3, the validation layers) it names and skips.
# Arguments go to `cargo test`; without any, the tests of the whole, which fly by the clock, run beside those of the crates.
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
cd "$here"
sh runtime/setup.sh --tests
if [ $# -gt 0 ]; then exec cargo test --release --locked --workspace "$@"; fi

cargo test --release --locked --workspace --no-run
log=$(mktemp)
trap 'rm -f "$log"' EXIT
# The same packages for both, so that neither compiles anything anew.
whole=$(for file in tests/tests/*.rs; do echo "--test $(basename "$file" .rs)"; done)
# shellcheck disable=SC2086
cargo test --release --locked --workspace --no-fail-fast $whole > "$log" 2>&1 &
flying=$!
failed=0
# What flies comes first.
nice -n 10 cargo test --release --locked --workspace --exclude tests || failed=$?
wait "$flying" || failed=$?
cat "$log"
exit "$failed"
