# Sourced. cross_compiler TARGET: sets RUSTC to a compiler that has std of TARGET, and the linker of arm64; 1, with a line, where there is
# none. rustup's compiler after `rustup target add TARGET`; Debian's after `apt-get install rustc-web libstd-rust-web-dev:arm64`.
cross_compiler() {
    local rustc
    for rustc in "${RUSTC:-rustc}" /usr/bin/rustc; do
        if compgen -G "$("$rustc" --print target-libdir --target "$1" 2>/dev/null)/libstd-*.rlib" >/dev/null; then
            command -v aarch64-linux-gnu-gcc >/dev/null || { echo "no aarch64-linux-gnu-gcc here: apt-get install gcc-aarch64-linux-gnu"; return 1; }
            export RUSTC=$rustc CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc
            return 0
        fi
    done
    echo "no Rust standard library for $1 here: rustup target add $1, or Debian's rustc-web and libstd-rust-web-dev:arm64 (dpkg --add-architecture arm64)"
    return 1
}
