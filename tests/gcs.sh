#!/bin/sh
# A ground station's view of an aircraft, by an implementation that is not ours: pymavlink reads the camera definition by MAVLink FTP
# and the parameters of component 100 while `dgtr sim` and `dgtr fly` fly, sets some, is refused others, and says what it saw; Python's
# own XML reader reads the definition as QGroundControl does. Foxglove's reader reads what `--record` left. Skips, saying why, what the machine lacks.
#   tests/gcs.sh [PROGRAM]        a dgtr; target/release/dgtr unless said
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
program=${1:-$here/target/release/dgtr}
out=$here/target/gcs
skip() { echo "skipped: $*"; exit 0; }
[ -x "$program" ] || skip "no $program (cargo build --release -p runtime)"
command -v python3 > /dev/null || skip "no python3"
mkdir -p "$out"
# Pinned: another version is another opinion.
packages="pymavlink==2.4.49 mcap==1.6.0 jsonschema==4.25.1"
if ! "$out/venv/bin/python" -c "import pymavlink, mcap, jsonschema" 2> /dev/null; then
    python3 -m venv "$out/venv" > "$out/pip.log" 2>&1 || skip "python3 has no venv (apt-get install python3-venv)"
    # shellcheck disable=SC2086
    "$out/venv/bin/python" -m pip install --quiet $packages > "$out/pip.log" 2>&1 || skip "pip does not give $packages ($out/pip.log)"
fi
exec "$out/venv/bin/python" "$here/tests/gcs.py" "$program" "$out/flight"
