#!/bin/bash
# Inside of a booted systemd: the units as they are shipped, but that a hang is found within seconds. Started by
# tests/package.sh by way of systemd-nspawn; ends by switching off.
trap 'systemctl --no-block start poweroff.target' EXIT
set -euxo pipefail
mkdir -p /etc/dgtr /var/lib/dgtr/pictures
chown -R dgtr: /var/lib/dgtr
cat > /etc/dgtr/mission.toml <<'M'
name = "bench"
origin = { lat_deg = 46.0, lon_deg = 7.0, alt_m = 500.0 }
camera = { width = 256, height = 192, fx = 200.0, fy = 200.0, cx = 128.0, cy = 96.0 }
keyframes = { max = 8 }
memory = { device_mib = 96, host_mib = 1024, max_gaussians = 5000 }
upload = { folder = "/var/lib/dgtr/upload" }
[[aircraft]]
id = "one"
link = "udpin:127.0.0.1:14550"
camera = { folder = "/var/lib/dgtr/pictures" }
region_enu = [[-20.0, -20.0], [20.0, -20.0], [20.0, 20.0], [-20.0, 20.0]]
M
for unit in dgtr-fly dgtr-serve; do
    mkdir -p /etc/systemd/system/$unit.service.d
    printf '[Service]\nWatchdogSec=4\n' > /etc/systemd/system/$unit.service.d/hang.conf
done
setpriv --reuid dgtr --regid dgtr --init-groups dgtr plan --mission /etc/dgtr/mission.toml --systemd |
    tee /etc/systemd/system/dgtr-fly.service.d/plan.conf
systemctl daemon-reload
is() { test "$(systemctl show "$1" -p "$2" --value)" = "$3"; }
is dgtr-fly MemoryMax $((1024 << 20))
for unit in dgtr-fly dgtr-serve; do
    # Comes back when the job has said that it is ready.
    systemctl start $unit
    systemctl show $unit -p ActiveState,StatusText,User,MemoryMax,CPUQuotaPerSecUSec,RestartSteps
    # Longer than a hang takes to be found.
    sleep 8
    is $unit ActiveState active
    is $unit NRestarts 0
    pid=$(systemctl show $unit -p MainPID --value)
    grep -E '^(Uid|Groups|NoNewPrivs|CapEff|Seccomp):' "/proc/$pid/status"
    kill -STOP "$pid"
    sleep 12
    is $unit ActiveState active
    is $unit NRestarts 1
    systemctl stop $unit
    is $unit MainPID 0
    journalctl -u $unit --no-pager -o cat
done
echo "units: all is well"
