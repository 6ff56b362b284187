#!/bin/bash
# Builds the Debian packages into target/debian and checks them: lintian, then, in a bare Debian (as root, mmdebstrap), the
# units (systemd-analyze verify), the udev rule (udevadm verify), `apt install ./dgtr.deb && dgtr demo`, and the units started by a
# systemd of its own (systemd-nspawn).
# Not part of .ci/run: it builds the release anew and loads a few hundred MB.
#   tests/package.sh [--arch amd64|arm64] [--no-root] [--transcript FILE]
# An arm64 package is built here with the std of its target and aarch64-linux-gnu-gcc; it is not started (tests/arm64.sh runs the program).
# Wants: cargo install cargo-deb --locked; apt-get install lintian mmdebstrap systemd-container python3-pip (and gcc-aarch64-linux-gnu).
set -euo pipefail
cd "$(dirname "$0")/.."

arch=$(dpkg --print-architecture) root=yes transcript=/tmp/install-transcript.txt suite=${DGTR_SUITE:-trixie}
while [ $# -gt 0 ]; do
    case $1 in
    --arch) arch=$2; shift ;;
    --no-root) root= ;;
    --transcript) transcript=$2; shift ;;
    *) echo "package.sh: unknown argument $1" >&2; exit 2 ;;
    esac
    shift
done
case $arch in
amd64) target=x86_64-unknown-linux-gnu machine=x86_64 ;;
arm64) target=aarch64-unknown-linux-gnu machine=aarch64 ;;
*) echo "package.sh: no packages for $arch" >&2; exit 2 ;;
esac
cross=()
if [ "$arch" != "$(dpkg --print-architecture)" ]; then
    # shellcheck source=package/cross.sh
    . tests/package/cross.sh
    cross=(--target "$target")
    (cross_compiler "$target")
fi

made=target/package
rm -rf "$made" && mkdir -p "$made"

# shellcheck source=package/onnxruntime.sh
. tests/package/onnxruntime.sh
onnxruntime "$machine" "$made"

# Names, licences and notices of every crate that may be linked in.
cargo metadata --format-version 1 --locked --filter-platform "$target" --features runtime/v4l2 | python3 -c '
import glob, gzip, json, os, sys
metadata = json.load(sys.stdin)
packages = {p["id"]: p for p in metadata["packages"]}
nodes = {n["id"]: n for n in metadata["resolve"]["nodes"]}
seen, left = set(), [p["id"] for p in metadata["packages"] if p["name"] == "runtime" and not p["source"]]
while left:
    one = left.pop()
    if one not in seen:
        seen.add(one)
        used = [d for d in nodes[one]["deps"] if any(k["kind"] is None for k in d["dep_kinds"])]
        left += [d["pkg"] for d in used]
text = []
for p in sorted((packages[i] for i in seen if packages[i]["source"]), key=lambda p: (p["name"], p["version"])):
    text.append("==== %s %s: %s\n" % (p["name"], p["version"], p["license"]))
    folder = os.path.dirname(p["manifest_path"])
    for path in sorted(glob.glob(folder + "/*")):
        if os.path.basename(path).upper().startswith(("LICENSE", "LICENCE", "COPYING", "NOTICE", "UNLICENSE")) and os.path.isfile(path):
            text.append(open(path, errors="replace").read() + "\n")
sys.stdout.buffer.write(gzip.compress("".join(text).encode(), 9, mtime=0))
' > "$made/third-party.txt.gz"

# The manual is written by the program of this machine, whatever architecture it is for.
cargo build --profile dist --locked -p runtime --bin dgtr --features v4l2
here=${CARGO_TARGET_DIR:-target}/dist/dgtr
manual() { rm -rf "$made/manual" && "$here" manual --out "$made/manual" "$@"; }
cp "$here" "$made/dgtr-here" && here=$made/dgtr-here

[ ${#cross[@]} = 0 ] || cross_compiler "$target"
mkdir -p target/debian && rm -f target/debian/dgtr*_"$arch".deb
manual
cargo deb --profile dist -p runtime "${cross[@]}" --locked --output target/debian/
manual --onboard
cargo deb --profile dist -p runtime --variant onboard "${cross[@]}" --locked --output target/debian/
ls -l target/debian/

debs=$(ls target/debian/dgtr*_"$arch".deb)
# shellcheck disable=SC2086
lintian --allow-root --fail-on error,warning $debs
[ -n "$root" ] || exit 0
[ "$arch" = "$(dpkg --print-architecture)" ] || { echo "package.sh: $arch is not started here"; exit 0; }

# A Debian with nothing but what is required, and apt.
bare=$(mktemp -d)
chmod 755 "$bare"
trap 'umount "$bare/dev/pts" "$bare/proc" 2>/dev/null || true; rm -rf --one-file-system "$bare"' EXIT
mmdebstrap --quiet --variant=minbase "$suite" "$bare"
mount -t proc proc "$bare/proc"
mount -t devpts -o newinstance,ptmxmode=0666 devpts "$bare/dev/pts"
# shellcheck disable=SC2086
cp $debs tests/package/root.sh tests/package/units.sh "$bare/root/"
inside() { chroot "$bare" env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root TERM=dumb "$@"; }
inside sh /root/root.sh 2>&1 | tee "$transcript"
# A signed flight under the units' rules about what may be written.
cp tests/package/sandbox.sh "$bare/root/" && inside bash /root/sandbox.sh /usr/bin/dgtr 2>&1 | tee -a "$transcript"
tail -n 1 "$transcript" | grep -q "sandbox: all is well"
command -v systemd-nspawn >/dev/null || { echo "package.sh: units not started (apt-get install systemd-container)"; exit 0; }
umount "$bare/dev/pts" "$bare/proc"
cat > "$bare/etc/systemd/system/units.service" <<'UNIT'
[Unit]
After=multi-user.target
[Service]
Type=oneshot
ExecStart=/bin/bash -c '/root/units.sh > /root/units.txt 2>&1'
UNIT
mkdir -p "$bare/etc/systemd/system/multi-user.target.wants"
ln -s ../units.service "$bare/etc/systemd/system/multi-user.target.wants/"
timeout 300 systemd-nspawn --quiet -D "$bare" --register=no --keep-unit /lib/systemd/systemd </dev/null >/dev/null 2>&1 || true
tee -a "$transcript" < "$bare/root/units.txt"
tail -n 3 "$bare/root/units.txt" | grep -q "units: all is well"
