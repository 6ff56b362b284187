#!/bin/sh
# Three aircraft over real photographs: `dgtr replay` plays each region of sheffield_cross (raw GPS, gimbal angles, JPEG
# files) on a pseudo-terminal, `dgtr fly` builds its model from that, `dgtr serve` merges the three, `dgtr eval` scores
# them on held-out pictures. Needs the data set: DGTR_DATA, or ../shared beside the repository.
#   tests/sheffield.sh [OUT] [SPEED]
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
data="${DGTR_DATA:-$here/../shared}/data/sheffield_cross"
[ -d "$data" ] || { echo "sheffield.sh: $data is not there; set DGTR_DATA to the folder that holds data/"; exit 0; }
data=$(cd "$data" && pwd)
out="${1:-sheffield-out}"
speed="${2:-12}"
dgtr="$here/target/release/dgtr"
[ -x "$dgtr" ] || cargo build --quiet --release --locked --config "$here/.cargo/config.toml" --manifest-path "$here/Cargo.toml" --package runtime
mkdir -p "$out"
cp "$here/tests/missions/sheffield_cross.toml" "$out/mission.toml"
cd "$out"
for i in 0 1 2; do
    rm -rf "region$i"
    mkdir -p "region$i"
    "$dgtr" replay "$data" --link "pty:$PWD/region$i/port" --speed "$speed" --camera-dir "region$i/camera" \
        --poses telemetry --region "$i" --split train_dense --system-id $((i + 1)) --linger 3 > "region$i/replay.log" 2>&1 &
    player=$!
    while [ ! -e "region$i/port" ]; do sleep 0.1; done
    "$dgtr" fly --mission mission.toml --aircraft "region$i" --out "region$i/out" --silence 8
    wait $player
done
"$dgtr" serve --mission mission.toml --out ground --timeout 30
for i in 0 1 2; do
    echo "== region $i: its own model, with the naive guesses"
    "$dgtr" eval "region$i/out/model.dgtr" "$data" --region "$i" --baselines
    echo "== region $i: the global model"
    "$dgtr" eval ground/global.dgtr "$data" --region "$i"
done
echo "== all held-out pictures: the global model"
"$dgtr" eval ground/global.dgtr "$data" --baselines
