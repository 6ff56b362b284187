#!/bin/sh
# What GDAL makes of a map (PyPI rasterio and rio-cogeo, in an environment of their own): reference system, bounds, overviews, nodata,
# and whether both files are valid Cloud-Optimised GeoTIFF.
#   tests/maps.sh FOLDER       a folder that `dgtr ortho` wrote
#   tests/maps.sh --large      draws 20,000 x 20,000 pixels of a simulated survey under --limit-mib 256 first: more than ten minutes on lavapipe
set -eu
here=$(cd "$(dirname "$0")/.." && pwd)
[ $# -eq 1 ] || { echo "usage: tests/maps.sh FOLDER | --large" >&2; exit 2; }
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/python" && "$work/python/bin/pip" install --quiet rasterio rio-cogeo
folder=$1
if [ "$folder" = --large ]; then
    dgtr="$here/target/release/dgtr"
    cargo build --quiet --release --locked --config "$here/.cargo/config.toml" --manifest-path "$here/Cargo.toml" --package runtime --package bench
    "$here/target/release/bench" --quiet map --out "$work/survey" --steps 60 --max-gaussians 30000 > "$work/figures"
    folder="$work/map"
    mkdir "$folder"
    # The survey's ground is some 90 m wide: at 0.4 cm a pixel it fills the raster.
    west=$("$work/python/bin/python" - "$dgtr" "$work" <<'PY'
import json, subprocess, sys
dgtr, work = sys.argv[1:]
subprocess.run([dgtr, "--quiet", "ortho", work + "/survey/trained/model.dgtr", "--out", work + "/small", "--gsd", "50"], check=True)
g = json.load(open(work + "/small/map.georef.json"))
west, south = g["west"] + 5, g["north"] - 85
print(f"{west:.3f},{south:.3f},{west + 80:.3f},{south + 80:.3f}")
PY
)
    /usr/bin/env time -v "$dgtr" --quiet --limit-mib 256 ortho "$work/survey/trained/model.dgtr" --out "$folder" --gsd 0.4 --min-views 0 \
        --bounds "$west" 2> "$work/time" || { cat "$work/time" >&2; exit 1; }
    grep -E 'Elapsed|Maximum resident' "$work/time"
    ls -l "$folder"
fi
"$work/python/bin/python" - "$folder" <<'PY'
import json, sys, rasterio
from rio_cogeo.cogeo import cog_validate
folder = sys.argv[1]
georef = json.load(open(folder + "/map.georef.json"))
for name, bands, dtype in (("ortho.tif", 4, "uint8"), ("dsm.tif", 1, "float32"), ("dsm_sigma.tif", 1, "float32"), ("ortho_sigma.tif", 1, "float32")):
    with rasterio.open(f"{folder}/{name}") as d:
        crs = None if d.crs is None else f"EPSG:{d.crs.to_epsg()}"
        print(name, crs, tuple(d.bounds), d.width, "x", d.height, "overviews", d.overviews(1), "nodata", d.nodata)
        assert crs == georef["crs"], crs
        assert (d.width, d.height, d.count, d.dtypes[0]) == (georef["columns"], georef["rows"], bands, dtype)
        gsd = georef["gsd_m"]
        assert abs(d.bounds.left - georef["west"]) < 1e-6 and abs(d.bounds.top - georef["north"]) < 1e-6
        assert abs(d.res[0] - gsd) < 1e-9 and abs(d.res[1] - gsd) < 1e-9
        assert max(d.width, d.height) <= 512 or d.overviews(1), "no overviews"
        if bands == 4:
            assert d.colorinterp[3] == rasterio.enums.ColorInterp.alpha, d.colorinterp
        else:
            assert d.nodata == georef["no_height"]
    valid, errors, warnings = cog_validate(f"{folder}/{name}")
    print(name, "valid COG" if valid else "NOT a valid COG", errors, warnings)
    assert valid
PY
