#!/bin/sh
# Installs what dgtr needs beside git, a C compiler and Rust, and only what is missing:
#   - the Vulkan loader and, where no GPU driver is installed, Mesa's software driver (Debian/Ubuntu packages, needs root);
#   - ONNX Runtime's shared library, out of its published Python package, into ~/.local/share/dgtr/lib.
#   - where npm is, the viewer that `dgtr export --to html` puts into its pages, at the version and with the hashes of viewer.pin,
#     into ~/.local/share/dgtr/viewer. Nothing else needs it; `setup.sh --viewer` brings npm, too, and does nothing else.
# Ends with 0 when everything is there, with 3 and one line that says what to install when it cannot be.
# `setup.sh --tests` also brings what only the tests need (a C++ compiler for the shader check, numpy, Vulkan's validation layer).
set -eu

lib="${XDG_DATA_HOME:-$HOME/.local/share}/dgtr/lib"
viewer="${XDG_DATA_HOME:-$HOME/.local/share}/dgtr/viewer"
pin="$(cd "$(dirname "$0")" && pwd)/viewer.pin"
onnxruntime="$(cd "$(dirname "$0")" && pwd)/onnxruntime.txt"

say() { echo "dgtr setup: $*" >&2; }
give_up() { say "$*"; exit 3; }

# apt PACKAGE...: installs as root, or with a sudo that asks nothing; otherwise says which command to run.
apt() {
    command -v apt-get >/dev/null || give_up "no apt-get here; install the equivalents of: $*"
    if [ "$(id -u)" = 0 ]; then as=; elif sudo -n true 2>/dev/null; then as="sudo -n"; else
        give_up "not root; run: sudo apt-get install $*"
    fi
    say "installing $*"
    $as apt-get update -qq >&2 || say "apt-get update failed; trying with the package lists there are"
    $as env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null ||
        give_up "apt-get could not install: $*"
}

have_library() { { ldconfig -p 2>/dev/null || /sbin/ldconfig -p; } | grep -q "$1"; }

have_vulkan_driver() {
    [ -n "${VK_DRIVER_FILES:-}${VK_ICD_FILENAMES:-}" ] && return 0
    for dir in /usr/share /usr/local/share /etc "${XDG_DATA_HOME:-$HOME/.local/share}"; do
        for file in "$dir"/vulkan/icd.d/*.json; do [ -e "$file" ] && return 0; done
    done
    return 1
}

have_viewer() { (cd "$viewer" 2>/dev/null && sed -n 's/^sha256 \([^ ]*\) /\1  /p' "$pin" | sha256sum --check --status); }

# No second tries: without a network every start would wait for them. The package as npm has it, compared with the pinned hash before anything of it is unpacked.
fetch_viewer() {
    read -r name version <"$pin"
    say "fetching $name $version into $viewer"
    package=$(mktemp -d)
    (
        cd "$package" && npm pack --silent --fetch-retries=0 --fetch-timeout=60000 "$name@$version" >/dev/null && mv ./*.tgz viewer.tgz &&
            echo "$(sed -n 's/^sha512 //p' "$pin")  viewer.tgz" | sha512sum --check --status && tar -xzf viewer.tgz
    ) && mkdir -p "$viewer.part/public" && (
        cd "$package/package" && cp public/index.js public/index.css "$viewer.part/public/" && cp LICENSE "$viewer.part/"
    ) && rm -rf "$viewer" && mv "$viewer.part" "$viewer"
    status=$?
    rm -rf "$package"
    [ "$status" = 0 ] && have_viewer
}

if [ "${1:-}" = --viewer ]; then
    have_viewer && exit 0
    command -v npm >/dev/null || apt npm
    fetch_viewer || give_up "npm could not fetch the viewer, or it is not what viewer.pin says; see npm's own message: npm pack $(head -n 1 "$pin" | tr ' ' @)"
    exit 0
fi

have_library libvulkan.so.1 || apt libvulkan1
have_vulkan_driver || apt mesa-vulkan-drivers

if [ -z "${ORT_DYLIB_PATH:-}" ] && [ ! -e "$lib/libonnxruntime.so" ] && ! have_library libonnxruntime.so; then
    command -v python3 >/dev/null && python3 -m pip --version >/dev/null 2>&1 || apt python3 python3-pip
    say "fetching ONNX Runtime into $lib"
    wheel=$(mktemp -d)
    trap 'rm -rf "$wheel"' EXIT
    # Whatever Python is here: of the wheel only the library is used.
    python3 -m pip download --quiet --disable-pip-version-check --no-deps --only-binary=:all: --implementation cp \
        --python-version 3.13 --abi cp313 --platform "manylinux_2_28_$(uname -m)" --platform "manylinux_2_27_$(uname -m)" \
        --dest "$wheel" --require-hashes -r "$onnxruntime" ||
        give_up "pip could not fetch ONNX Runtime as onnxruntime.txt names it; or set ORT_DYLIB_PATH to a libonnxruntime.so of 1.22 or later"
    mkdir -p "$lib"
    python3 - "$wheel" "$lib" <<'PY'
import glob, os, sys, zipfile
wheel = zipfile.ZipFile(glob.glob(sys.argv[1] + "/onnxruntime-*.whl")[0])
name = next(n for n in wheel.namelist() if "/capi/libonnxruntime.so" in n)
for member, target in ((name, "libonnxruntime.so"), ("onnxruntime/LICENSE", "LICENSE.onnxruntime")):
    path = os.path.join(sys.argv[2], target)
    with open(path + ".part", "wb") as out:
        out.write(wheel.read(member))
    os.replace(path + ".part", path)
PY
fi

if ! have_viewer && command -v npm >/dev/null; then
    fetch_viewer || say "without its viewer dgtr export --to html does not work; try runtime/setup.sh --viewer later"
fi

if [ "${1:-}" = --tests ]; then
    command -v c++ >/dev/null || apt g++
    # The reader of models in Python. A Python that is not Debian's does not see Debian's packages.
    numpy() { python3 -c "import numpy" 2>/dev/null || /usr/bin/python3 -c "import numpy" 2>/dev/null; }
    numpy || apt python3 python3-numpy
    numpy || give_up "python3 has no numpy; install it"
    # Without it the validation test says that it is skipped.
    [ -e /usr/share/vulkan/explicit_layer.d/VkLayer_khronos_validation.json ] || (apt vulkan-validationlayers) || true
fi
