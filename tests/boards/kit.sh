# Sourced by the scripts that run arm64 programs here: a compiler's check, and what they run on. The packages (150 MB: an arm64 root with
# Mesa's Vulkan drivers and drm-shim, Vulkan's headers, qemu; Debian sid: the newer the Mesa, the more GPUs its shim knows) are unpacked
# in $kit; nothing is installed. `skip` is the script's own.
kit=${XDG_CACHE_HOME:-$HOME/.cache}/dgtr/boards

for tool in apt-get dpkg-deb python3; do command -v $tool >/dev/null || skip "no $tool here"; done
command -v aarch64-linux-gnu-gcc >/dev/null || skip "no arm64 compiler; apt-get install gcc-aarch64-linux-gnu libc6-dev-arm64-cross"

# fetch NAME ARCH SUITE MODE PACKAGE…: packages by an apt of its own, which knows nothing as installed; unpacked into $kit/NAME.
fetch() {
    local name=$1 arch=$2 suite=$3 mode=$4 at=$kit/apt/$1 mirror keyring
    shift 4
    mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' | grep -m1 '/debian/$') || return 1
    keyring=$(dpkg -L debian-archive-keyring | grep -m1 'debian-archive-keyring\.gpg$') || return 1
    mkdir -p "$at"/etc/{apt.conf.d,preferences.d,sources.list.d} "$at"/{lists,cache/archives}/partial "$kit/$name"
    : > "$at/status"
    echo "deb [arch=$arch signed-by=$keyring] $mirror $suite main" > "$at/etc/sources.list"
    cat > "$at/apt.conf" <<END
APT::Architecture "$arch";
APT::Architectures { "$arch"; };
APT::Install-Recommends "false";
APT::Sandbox::User "root";
Acquire::Languages "none";
Acquire::Check-Valid-Until "false";  // a mirror frozen at some date is as good
Dir::Etc "$at/etc";
Dir::Etc::sourcelist "$at/etc/sources.list";
Dir::Etc::parts "$at/etc/apt.conf.d";
Dir::State::lists "$at/lists";
Dir::State::status "$at/status";
Dir::Cache "$at/cache";
END
    export APT_CONFIG=$at/apt.conf
    apt-get update -qq || return 1
    if [ "$mode" = alone ]; then
        (cd "$at/cache/archives" && apt-get download -qq "$@") || return 1
    else
        apt-get install -qq -y --download-only "$@" || return 1
    fi
    unset APT_CONFIG
    for deb in "$at"/cache/archives/*.deb; do dpkg-deb -x "$deb" "$kit/$name" || return 1; done
    rm -rf "$at/cache"
}

if [ ! -e "$kit/complete" ]; then
    mkdir -p "$kit"
    {
        fetch root arm64 sid whole libc6 libgcc-s1 libstdc++6 libvulkan1 mesa-vulkan-drivers mesa-drm-shim &&
        fetch headers arm64 sid alone libvulkan-dev &&
        fetch qemu "$(dpkg --print-architecture)" trixie alone qemu-user
    } > "$kit/fetch.log" 2>&1 || skip "the packages could not be had: $(tail -1 "$kit/fetch.log")"
    [ -e "$kit/root/lib" ] || ln -s usr/lib "$kit/root/lib"  # base-files would; the loader is /lib/ld-linux-aarch64.so.1
    touch "$kit/complete"
fi
