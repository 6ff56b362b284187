#!/bin/sh
# The live page in a real browser: while `dgtr demo` flies, the ground's page and an aircraft's load without console errors and
# change; afterwards the reports, which are the same page, ask nobody for anything. axe-core looks at labels, contrast and keyboard
# (WCAG 2 A and AA), light and dark. Pictures are left in target/page. Skips, saying why, what the machine lacks.
#   tests/page.sh [PROGRAM]        a dgtr; target/release/dgtr unless said
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
program=${1:-$here/target/release/dgtr}
out=$here/target/page
skip() { echo "skipped: $*"; exit 0; }
[ -x "$program" ] || skip "no $program (cargo build --release -p runtime)"
command -v node > /dev/null || skip "no node (apt-get install nodejs)"
chromium=$(command -v chromium || command -v chromium-browser) || skip "no Chromium (apt-get install chromium)"
mkdir -p "$out"
# Pinned: another version finds other things. The driver brings no browser of its own.
packages="axe-core@4.10.3 playwright-core@1.55.0"
if [ ! -d "$out/node_modules/axe-core" ]; then
    command -v npm > /dev/null || skip "no npm (apt-get install npm)"
    # shellcheck disable=SC2086
    npm install --prefix "$out" --no-save --no-audit --no-fund $packages > "$out/npm.log" 2>&1 || skip "npm does not give $packages ($out/npm.log)"
fi
port=${DGTR_PAGE_PORT:-18480}
rm -rf "$out/demo"
"$program" demo --out "$out/demo" --seconds "${DGTR_PAGE_SECONDS:-20}" --http "127.0.0.1:$port" > "$out/demo.log" 2>&1 &
demo=$!
trap 'kill "$demo" 2> /dev/null || true' EXIT
NODE_PATH=$out/node_modules CHROMIUM=$chromium node "$here/tests/page.cjs" live "$out" "$port"
wait "$demo" || { tail -5 "$out/demo.log"; exit 1; }
trap - EXIT
NODE_PATH=$out/node_modules CHROMIUM=$chromium node "$here/tests/page.cjs" frozen "$out" \
    "$out/demo/report.html" "$out/demo/west/out/report.html" "$out/demo/ground/out/report.html"
