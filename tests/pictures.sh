#!/bin/sh
# The README's picture of what a survey takes home, made from nothing but this repository: `dgtr demo`, the live page of one of its
# aircraft while it flies, then orthophoto, heights and the viewer's page of the merged scene, in headless Chromium. Some three minutes on
# two cores.
#   tests/pictures.sh [PROGRAM]        a dgtr; target/release/dgtr unless said. Writes tests/data/products.jpg; all else to target/pictures
# Wants: Chromium, node, runtime/setup.sh --viewer.
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
program=${1:-$here/target/release/dgtr}
[ -x "$program" ] || { echo "pictures.sh: no $program; cargo build --release -p runtime" >&2; exit 2; }
program=$(realpath "$program")
chromium=$(command -v chromium || command -v chromium-browser) || { echo "pictures.sh: no Chromium; apt-get install chromium" >&2; exit 2; }
mkdir -p "$here/target/pictures" && cd "$here/target/pictures"

shot() { node "$here/tests/pictures.mjs" "$chromium" "$@"; }

# The page of the aircraft in the west, once it has a first model: it draws a coarse map of it then.
port=${DGTR_PAGE_PORT:-18490}
rm -rf demo map relief
"$program" demo --out demo --seconds "${DGTR_PICTURES_SECONDS:-40}" --http "127.0.0.1:$port" > demo.log 2>&1 &
demo=$!
trap 'kill "$demo" 2> /dev/null || true' EXIT
until [ -f demo/west/out/map/ortho.png ]; do
    kill -0 "$demo" 2> /dev/null || { tail -n 3 demo.log >&2; exit 1; }
    sleep 1
done
sleep 10
shot "http://127.0.0.1:$((port + 1))/#map" live.png 1280x815 5
wait "$demo" || { tail -n 3 demo.log >&2; exit 1; }
trap - EXIT

model=demo/ground/out/global.dgtr
"$program" ortho "$model" --out map --gsd 12
# A relief shows every centimetre of noise: coarser, it shows the trees.
"$program" ortho "$model" --out relief --gsd 30
"$program" export "$model" --to html --out scene.html
echo '[{"shot": "scene"}]' > steps.json
node "$here/tests/viewer.mjs" "$chromium" scene.html . steps.json > viewer.json

cp "$here/tests/pictures.html" contact.html
shot "file://$PWD/contact.html" "$here/tests/data/products.jpg" 1600x1130 2
ls -l "$here/tests/data/products.jpg"
