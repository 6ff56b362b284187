#!/bin/bash
# The boards' own Vulkan drivers compile every kernel, without a board: Mesa's V3DV, PanVK and Turnip as arm64 programs under
# qemu, over Mesa's drm-shim, a fake kernel device. It tells whether a kernel compiles, how large it becomes and what it spills;
# submitted work does nothing. Prints the table kernel x board and compares it with tests/data/boards.md: ends with 1 and the
# kernels' names when one spills more or no longer compiles; DGTR_BLESS=1 writes the table instead.
#   tests/boards.sh [--spirv FOLDER] [BOARD...]     boards: pi5 pi4 g610 adreno660 adreno730, default all
# Packages (150 MB, Debian sid: the newer the Mesa, the more GPUs its shim knows) go to ${XDG_CACHE_HOME:-~/.cache}/dgtr/boards;
# nothing is installed. Five minutes on two cores once they are there (half an hour on a slow day). What it needs and does not find it names, and skips.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
spirv=$here/../vulkan/shaders/spirv
if [ "${1:-}" = --spirv ]; then spirv=$2; shift 2; fi
boards=("$@")
[ $# -gt 0 ] || boards=(pi5 pi4 g610 adreno660 adreno730)
skip() { echo "boards.sh: skipped: $*"; exit 0; }

# shellcheck source=boards/kit.sh
. "$here/boards/kit.sh"
aarch64-linux-gnu-gcc -O1 -Wall -Werror -I"$kit/headers/usr/include" -o "$kit/pipelines" "$here/boards/pipelines.c" -ldl
version=$(zcat "$kit"/root/usr/share/doc/mesa-vulkan-drivers/changelog.Debian*.gz | sed -n '1s/.*(\(.*\)).*/\1/p')

# compile BOARD: one line per kernel to BOARD.tsv.
compile() {
    local driver shim model lib=/usr/lib/aarch64-linux-gnu
    case $1 in
        pi5) driver=broadcom shim=v3d model=V3D_GPU_ID=71 ;;
        pi4) driver=broadcom shim=v3d model=V3D_GPU_ID=42 ;;
        g610) driver=panfrost shim=panfrost model=PAN_GPU_ID=a867 ;;
        adreno*) driver=freedreno shim=freedreno model=FD_GPU_ID=${1#adreno} ;;
        *) echo "boards.sh: unknown board $1" >&2; return 2 ;;
    esac
    # The shim lives in the guest: LD_PRELOAD must not reach qemu itself, hence -E.
    env "$model" MESA_SHADER_CACHE_DISABLE=true nice "$kit/qemu/usr/bin/qemu-aarch64" -L "$kit/root" \
        -E LD_LIBRARY_PATH=$lib -E "LD_PRELOAD=$lib/lib${shim}_noop_drm_shim.so" \
        -E VK_DRIVER_FILES=/usr/share/vulkan/icd.d/${driver}_icd.json \
        "$kit/pipelines" "$spirv" < "$here/boards/kernels.txt" > "$kit/$1.tsv" 2> "$kit/$1.log" ||
        { echo "boards.sh: $1: ended at '$(tail -1 "$kit/$1.tsv")': $(tail -1 "$kit/$1.log")" >&2; return 1; }
}
export -f compile
export kit spirv here
printf '%s\n' "${boards[@]}" | xargs -P "$(nproc)" -I{} bash -c 'compile {}'
files=()
for board in "${boards[@]}"; do files+=("$board=$kit/$board.tsv"); done
python3 "$here/boards/table.py" "$here/data/boards.md" "${version:-unknown}" "${files[@]}"
