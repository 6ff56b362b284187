#!/bin/bash
# Flies once, with keys and MAVLink signing (the simulated autopilot does not sign, so that unsigned messages are accepted), as the units do: the whole disk can only be read, but for the state and cache folders, and /tmp is their own
# (ProtectSystem=strict, StateDirectory, CacheDirectory, PrivateTmp; `unshare` in the place of systemd, so no filter of system calls).
# Keys and the autopilot's signing key lie in etc/, which may not be written. Run by tests/package.sh; as root:
#   tests/package/sandbox.sh DGTR
set -euo pipefail
dgtr=$(realpath "${1:?the program}")
if [ -z "${DGTR_SANDBOX:-}" ]; then
    at=$(mktemp -d)
    trap 'rm -rf "$at"' EXIT
    DGTR_SANDBOX=$at unshare --mount --propagation private "$(realpath "$0")" "$dgtr"
    exit
fi
at=$DGTR_SANDBOX
mkdir -p "$at"/etc "$at"/lib/pictures "$at"/cache "$at"/sim
cat > "$at/etc/mission.toml" <<M
name = "sandbox"
seed = 3
origin = { lat_deg = 46.0, lon_deg = 7.0, alt_m = 500.0 }
camera = { width = 256, height = 192, fx = 200.0, fy = 200.0, cx = 128.0, cy = 96.0, exposure_delay_ms = 60.0 }
keyframes = { t_min_m = 6.0, max = 24 }
memory = { device_mib = 96, host_mib = 1024, max_gaussians = 15000, view_slots = 2 }
training = { seconds = 20.0 }
link = { signing = "accept", signing_key = "mavlink.key" }
map = { ground = false }
[upload]
connect = ["tls/127.0.0.1:17447"]
listen = ["tls/127.0.0.1:17447"]
[ground]
epochs = 0
[[aircraft]]
id = "one"
link = "udpin:127.0.0.1:14556"
camera = { folder = "$at/lib/pictures" }
region_enu = [[-20.0, -20.0], [20.0, -20.0], [20.0, 20.0], [-20.0, 20.0]]
M
(umask 077 && head -c 32 /dev/urandom > "$at/etc/mavlink.key")
mapfile -t public < <("$dgtr" keys --mission "$at/etc/mission.toml" | grep '^public_key')
sed -i -e "s/^\[ground\]/[ground]\n${public[0]}/" -e "s/^id = \"one\"/id = \"one\"\n${public[1]}/" "$at/etc/mission.toml"

# Nothing but these may be written from here on.
for own in lib cache sim; do mount --bind "$at/$own" "$at/$own"; done
mount -t tmpfs tmpfs /var/tmp
while read -r _ _ _ _ where options _; do
    case $where in "$at"/*|/proc*|/sys*|/dev*|/var/tmp) ;; *) mount -o remount,bind,ro "$where" 2>/dev/null || true ;; esac
done < /proc/self/mountinfo
if touch "$at/etc/x" 2>/dev/null; then echo "sandbox: $at/etc can be written"; exit 1; fi
library=${XDG_DATA_HOME:-$HOME/.local/share}/dgtr/lib/libonnxruntime.so
[ -n "${ORT_DYLIB_PATH:-}" ] || [ ! -e "$library" ] || export ORT_DYLIB_PATH=$library
export TMPDIR=/var/tmp XDG_CACHE_HOME=$at/cache MESA_SHADER_CACHE_DIR=$at/cache HOME=/nonexistent DGTR_KERNELS=default

# Not all that it looks at has to be here.
env STATE_DIRECTORY="$at/lib" "$dgtr" doctor --mission "$at/etc/mission.toml" > "$at/sim/doctor" 2> /dev/null || true
grep -E 'state folder|private key|signatures|may write' "$at/sim/doctor"
if grep -E '^missing +(state|private|signatures|may write)' "$at/sim/doctor"; then exit 1; fi
env STATE_DIRECTORY="$at/lib" "$dgtr" serve --mission "$at/etc/mission.toml" --out "$at/lib/ground" -q 2> "$at/sim/serve.log" &
serve=$!
env STATE_DIRECTORY="$at/lib" "$dgtr" fly --mission "$at/etc/mission.toml" --out "$at/lib/flight" --silence 6 -q 2> "$at/sim/fly.log" &
fly=$!
sleep 2
env STATE_DIRECTORY="$at/sim" "$dgtr" sim --mission "$at/etc/mission.toml" --link udpout:127.0.0.1:14556 --speed 6 --linger 0 -q 2> "$at/sim/sim.log" &
failed=0
wait $fly || { failed=$?; echo "sandbox: fly ended with $failed"; tail -n 5 -q "$at/sim/fly.log"; }
[ "$failed" != 0 ] || wait $serve || { failed=$?; echo "sandbox: serve ended with $failed"; tail -n 5 -q "$at/sim/serve.log"; }
[ "$failed" = 0 ] || { kill $(jobs -p) 2>/dev/null || true; exit 1; }
test -s "$at/lib/ground/global.dgtr"
# What counts is where it may be counted.
test "$(cat "$at/lib/one.flight")" = 1
test -s "$at/lib/mavlink.key.timestamp" -a -s "$at/lib/sandbox.received.json"
echo "sandbox: all is well"
