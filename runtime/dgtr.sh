#!/bin/sh
# `runtime/dgtr.sh ARGS…` = install what is missing, build, run `dgtr ARGS…`.
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
sh "$here/runtime/setup.sh"
command -v cargo >/dev/null || { echo "dgtr: cargo not found; install Rust 1.89 or later from https://rustup.rs" >&2; exit 3; }
exec cargo run --quiet --release --locked --config "$here/.cargo/config.toml" --manifest-path "$here/Cargo.toml" --package runtime --bin dgtr -- "$@"
