#!/bin/sh
# Builds `dgtr-rerun` (runtime/rerun), lets it follow a training, and asks Rerun itself (PyPI rerun-sdk) whether the recording is whole, has
# several versions of the model, and shows in its viewer, without a window on any Vulkan device. Not part of .ci/run: Rerun is 260 crates.
#   tests/rerun.sh [OUT]
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
out="${1:-/tmp/dgtr-rerun}"
rm -rf "$out" && mkdir -p "$out"
cargo build --quiet --release --locked --config "$here/.cargo/config.toml" --manifest-path "$here/Cargo.toml" --package runtime --package bench
cargo test --quiet --release --locked --manifest-path "$here/runtime/rerun/Cargo.toml"
cargo build --quiet --release --locked --manifest-path "$here/runtime/rerun/Cargo.toml"
dgtr="$here/target/release/dgtr"
follow="${CARGO_TARGET_DIR:-$here/runtime/rerun/target}/release/dgtr-rerun"
python3 -m venv "$out/venv"
"$out/venv/bin/pip" install --quiet rerun-sdk==0.36.3
cd "$out"
"$here/target/release/bench" map --out survey --steps 1 > /dev/null 2>&1 # for its pictures
"$follow" model/model.dgtr --to scene.rrd > follow.log &
watcher=$!
"$dgtr" train survey/data --out model --steps 400 --checkpoint-seconds 3 --no-eval
sleep 2
kill -INT $watcher && wait $watcher
cat follow.log
"$out/venv/bin/rerun" rrd verify scene.rrd
versions=$("$out/venv/bin/rerun" rrd stats scene.rrd 2> /dev/null | sed -n 's|^/world/model: ||p' | head -1)
[ "$versions" -ge 2 ] || { echo "rerun.sh: $versions versions of the model in the recording" >&2; exit 1; }
XDG_RUNTIME_DIR="$out" timeout 120 "$out/venv/bin/rerun" scene.rrd --headless --screenshot-to scene.png --window-size 1000x700 > viewer.log 2>&1
python3 - scene.png <<'P'
import os, sys
size = os.path.getsize(sys.argv[1])
assert size > 200_000, f"a picture of {size} bytes shows nothing"
print(f"shown: {sys.argv[1]}, {size} bytes")
P
echo "rerun.sh: $versions versions of the model, whole and shown"
