#!/bin/sh
# All tests. What a test needs and does not find (the large data sets, python3, the validation layers) it names and skips.
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
cd "$here"
sh runtime/setup.sh --tests
exec cargo test --release --locked --workspace "$@"
