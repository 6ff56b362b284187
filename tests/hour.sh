#!/bin/bash
# An hour's flight of 600 pictures in a bad world: `dgtr sim` flies it with a line that loses and damages what it carries and a
# camera that blackens, cuts, doubles and delays; meanwhile, at random, `dgtr fly` is killed, stopped, started a second time,
# its disk fills, its checkpoint is damaged, and rubbish lies in the camera's folder. All faults follow from the seed.
#   tests/hour.sh [--seed N] [--speed X] [--minutes M] [--out DIR]
# Ends with 0 when there is a model, memory and disk stayed below their bounds and every fault was survived. The disk fills only where
# a file system of its own can be mounted (root); it says so where not.
set -euo pipefail
here=$(cd "$(dirname "$0")/.." && pwd)
seed=1 speed=2 minutes=90 out=hour-out
usage() { echo "usage: tests/hour.sh [--seed N] [--speed X] [--minutes M] [--out DIR]" >&2; exit 2; }
while [ $# -gt 0 ]; do
    [ $# -ge 2 ] || usage
    case "$1" in
        --seed) seed="$2" ;; --speed) speed="$2" ;; --minutes) minutes="$2" ;; --out) out="$2" ;; *) usage ;;
    esac
    shift 2
done
dgtr="${DGTR:-$here/target/release/dgtr}"
[ -x "$dgtr" ] || cargo build --quiet --release --locked --config "$here/.cargo/config.toml" --manifest-path "$here/Cargo.toml" --package runtime
rm -rf "$out"; mkdir -p "$out/disk" "$out/camera"
cd "$out"
limit_mib=1536 disk_mib=360 quota_mib=400
mounted=
if mount -t tmpfs -o "size=${quota_mib}m" none "$PWD/disk" 2>/dev/null; then mounted=1; else
    echo "hour.sh: no file system of its own for the disk (not root); it will not fill" >&2
fi

cat > mission.toml <<M
name = "hour"
seed = $seed
origin = { lat_deg = 46.0, lon_deg = 7.0, alt_m = 500.0 }
camera = { width = 256, height = 192, fx = 128.0, fy = 128.0, cx = 128.0, cy = 96.0, exposure_delay_ms = 60.0 }
keyframes = { t_min_m = 6.0, max = 700 }
memory = { device_mib = 256, host_mib = $limit_mib, max_gaussians = 40000, disk_mib = $disk_mib }
training = { seconds = 600.0 }
upload = { folder = "upload" }

[faults]
frame_loss_pct = 0.5
byte_loss_pct = 0.01
bit_flip_pct = 0.005
attitude_spike_pct = 0.5
nan_pct = 0.5
trigger_loss_pct = 1.0
picture_loss_pct = 1.0
picture_twice_pct = 2.0
picture_late_pct = 2.0
picture_black_pct = 1.0
picture_over_pct = 1.0
picture_cut_pct = 1.0

[[aircraft]]
id = "one"
link = "serial:port:921600"
camera = { folder = "camera" }
region_enu = [[-240.0, -240.0], [240.0, -240.0], [240.0, 240.0], [-240.0, 240.0]]
M

"$dgtr" sim --mission mission.toml --link "pty:$PWD/port" --speed "$speed" --forward-overlap 0.53 --side-overlap 0.68 --cross \
    --linger 30 > sim.log 2>&1 &
sim=$!
fly=
cleanup() {
    kill "$sim" ${fly:+"$fly"} 2>/dev/null || true
    [ -z "$mounted" ] || { sleep 1; umount -l "$PWD/disk" || true; }
}
trap cleanup EXIT
while [ ! -e port ]; do kill -0 "$sim" || { cat sim.log >&2; exit 1; }; sleep 0.1; done
start() {
    "$dgtr" fly --mission mission.toml --out disk/out --limit-mib "$limit_mib" --silence 60 >> fly.log 2>&1 &
    fly=$!
}
start

RANDOM=$seed
declare -A done_=()
failed=0
note() { echo "$(date +%T) $*" >> faults.log; done_[$1]=$((${done_[$1]:-0} + 1)); }
fault() {
    case $((RANDOM % 7)) in
        0) kill -9 "$fly" 2>/dev/null; wait "$fly" 2>/dev/null || true; note killed; start ;;
        1) note stopped; kill -STOP "$fly"; sleep 10; kill -CONT "$fly" ;;
        2) [ -n "$mounted" ] || return 0
           note disk_full; dd if=/dev/zero of=disk/filler bs=64k 2>/dev/null || true; sleep 20; rm -f disk/filler ;;
        3) note rubbish
           echo "not a picture" > "camera/note$RANDOM.jpg"; : > "camera/empty$RANDOM.jpg"
           # The newest picture, cut in the middle, under another name.
           newest=$(ls -t camera/*.jpg | sed -n 1p); head -c 2000 "$newest" > "camera/half$RANDOM.jpg" ;;
        4) note second_process
           code=0; "$dgtr" fly --mission mission.toml --out disk/out > second.log 2>&1 || code=$?
           [ "$code" = 2 ] || [ "$code" = 1 ] || { echo "hour.sh: a second process ended with $code" >&2; failed=1; } ;;
        5) kill -9 "$fly" 2>/dev/null; wait "$fly" 2>/dev/null || true
           note checkpoint_damaged; [ ! -f disk/out/model.dgtr ] || truncate -s 1000 disk/out/model.dgtr; start ;;
        6) note interrupted; kill -INT "$fly"; wait "$fly" 2>/dev/null || true; start ;;
    esac
}
resident() { awk '/^VmRSS/ { print int($2 / 1024) }' "/proc/$fly/status" 2>/dev/null || true; }
begun=$SECONDS next=$((SECONDS + 60))
while kill -0 "$sim" 2>/dev/null; do
    kill -0 "$fly" 2>/dev/null || { echo "hour.sh: fly ended in flight:" >&2; tail -n 3 fly.log >&2; exit 1; }
    echo "$((SECONDS - begun)) $(resident) $(du -sm --exclude=filler disk | cut -f1) $(ls camera | wc -l)" >> samples
    if [ "$SECONDS" -ge "$next" ]; then fault; next=$((SECONDS + 40 + RANDOM % 80)); fi
    [ $((SECONDS - begun)) -lt $((minutes * 60)) ] || { echo "hour.sh: still flying after $minutes minutes" >&2; exit 1; }
    sleep 5
done
code=0; wait "$fly" || code=$?
echo "$((SECONDS - begun)) 0 $(du -sm --exclude=filler disk | cut -f1) $(ls camera | wc -l)" >> samples

highest() { awk -v c="$1" 'NF == 4 && $c > m { m = $c } END { print m + 0 }' samples; }
half() { awk -v n="$(wc -l < samples)" -v h="$1" 'NF == 4 && ((NR <= n / 2) == (h == 1)) && $2 > m { m = $2 } END { print m + 0 }' samples; }
echo "seed $seed, $((SECONDS - begun)) s at ${speed}x: fly ended with $code"
for what in "${!done_[@]}"; do echo "  $what: ${done_[$what]}"; done
echo "  most resident: $(half 1) MiB in the first half, $(half 2) MiB in the second, of $limit_mib"
echo "  most on the disk: $(highest 3) MiB of $disk_mib"
tail -n 3 sim.log
tail -n 1 fly.log
[ "$code" = 0 ] && [ -s disk/out/model.dgtr ] && [ "$failed" = 0 ] && [ "$(highest 3)" -le "$disk_mib" ] || { echo "hour.sh: failed" >&2; exit 1; }
cp disk/out/run.json disk/out/model.dgtr .
find disk/out -name '.dgtr-*' | grep . && { echo "hour.sh: temporary files stayed" >&2; exit 1; } || true
