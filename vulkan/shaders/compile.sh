#!/bin/sh
# Compiles every kernel to FOLDER (default: spirv, what is checked in): compile.sh [FOLDER]. Needs glslangValidator.
# Kernels that fetch texels are compiled a second time, to read storage buffers instead (frame.glsl), and those that hold strips
# once more, to hold less of them at a time (window.glsl). Those of a lane per run are compiled for lanes that cannot read each other,
# too (tile.glsl).
set -eu
cd "$(dirname "$0")"
to=${1:-spirv}
compile() {
    glslangValidator -V --target-env vulkan1.1 "$@" > "$to/log" || { cat "$to/log" >&2; exit 1; }
}
compile_reads() {
    compile "$@" -o "$to/$name.spv" "$source"
    if glslangValidator -E -DSTORAGE_READS "$source" | grep -q 'buffer Read_'; then
        compile "$@" -DSTORAGE_READS -o "$to/$name.storage.spv" "$source"
    fi
}
for source in *.comp; do
    name=${source%.comp}
    compile_reads
    if grep -q 'PARTS(' "$source"; then
        name=${name}_short
        compile_reads -DSHORT
    fi
    if grep -q '#define LANE_PER_RUN' "$source"; then
        name=${name}_shared
        compile_reads -DSHARED
    fi
done
rm "$to/log"
