#!/bin/sh
# What crops are worth on real pictures: brighton_beach's card reduced to 1,600 x 900 with the data set's poses, whole pictures trained at
# a quarter of that size, 400 x 225, `bench detail`, then crops in all steps from progress 0.2 on. Needs the data: DGTR_DATA, or ../shared beside the repository.
#   tests/brighton.sh [OUT] [SECONDS] [SCALE]
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
data="${DGTR_DATA:-$here/../shared}/data"
[ -d "$data/brighton_beach_card" ] || { echo "brighton.sh: $data is not there; set DGTR_DATA to the folder that holds data/"; exit 0; }
out="${1:-brighton-out}"
seconds="${2:-60}"
scale="${3:-0.25}"
dgtr="$here/target/release/dgtr"
cargo build --quiet --release --locked --config "$here/.cargo/config.toml" --manifest-path "$here/Cargo.toml" --package runtime --package bench
mkdir -p "$out/data/images"
python3 -m venv "$out/python" && "$out/python/bin/pip" install --quiet pillow
"$out/python/bin/python" - "$data" "$out/data" <<'PY'
import json, os, shutil, sys
from PIL import Image
data, out = sys.argv[1:]
description = json.load(open(data + "/brighton_beach/transforms.json"))
for frame in description["frames"]:
    name = os.path.basename(frame["file_path"])
    picture = Image.open(f"{data}/brighton_beach_card/DCIM/{name[:-4]}.JPG").convert("RGB").resize((1600, 900), Image.LANCZOS)
    # Turned by hand in the source (the data set's README).
    picture = picture.rotate(180) if 24 <= int(name[4:8]) <= 29 else picture
    picture.save(f"{out}/images/{name}", quality=95)
# The original camera at this size (the data set's README).
description.update(camera_model="OPENCV", fl_x=951.0, fl_y=951.0, cx=800.0, cy=450.0, w=1600, h=900, k1=-0.0041, k2=0.0153, p1=0.0004, p2=0.0001)
json.dump(description, open(out + "/transforms.json", "w"))
shutil.copy(data + "/brighton_beach/split.json", out)
PY
"$here/target/release/bench" --quiet detail "$out/data" --out "$out" --scale "$scale" --seconds "$seconds"
printf '[training.crops]\nfrom = 0.2\nshare = 1.0\n' > "$out/early.toml"
"$dgtr" --quiet train "$out/data" --out "$out/early" --fresh --no-eval --scale "$scale" --max-gaussians 100000 --seconds "$seconds" --settings "$out/early.toml"
"$dgtr" --quiet eval "$out/early/model.dgtr" "$out/data" --split test --scale 1
