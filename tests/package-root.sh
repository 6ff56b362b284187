#!/bin/sh
# Inside of a bare Debian: what a person types, then what systemd and udev make of it. Started by tests/package.sh.
set -eux
export DEBIAN_FRONTEND=noninteractive
. /etc/os-release
echo "$PRETTY_NAME: $(dpkg-query -f '.' -W | wc -c) packages"
cd /root
apt-get update -qq
cp dgtr_*.deb dgtr.deb
apt install -y -qq ./dgtr.deb </dev/null >/root/apt.log 2>&1 || { cat /root/apt.log; exit 1; }
tail -n 3 /root/apt.log
dgtr --version
dgtr doctor
time dgtr demo
ls -l dgtr-demo

apt-get install -y -qq --no-install-recommends systemd udev man-db bash-completion >/dev/null 2>&1
systemd-analyze --version | head -n 1
systemd-analyze verify /usr/lib/systemd/system/dgtr-fly.service /usr/lib/systemd/system/dgtr-serve.service
systemd-analyze security --offline=true /usr/lib/systemd/system/dgtr-fly.service /usr/lib/systemd/system/dgtr-serve.service |
    grep -i overall
udevadm verify --no-style /usr/lib/udev/rules.d/71-dgtr-autopilot.rules
id dgtr
man -w dgtr-fly
bash -c '. /usr/share/bash-completion/bash_completion; . /usr/share/bash-completion/completions/dgtr; complete -p dgtr'

# The onboard package takes the place of the whole, and goes without leaving anything but what was flown.
apt-get install -y -qq ./dgtr-onboard_*.deb >/dev/null 2>&1
dgtr fly --help >/dev/null
if dgtr demo --help >/dev/null 2>&1; then exit 1; fi
apt-get purge -y -qq dgtr-onboard >/dev/null 2>&1
if command -v dgtr; then exit 1; fi
test ! -e /etc/default/dgtr
echo "package-root: all is well"
