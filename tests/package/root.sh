#!/bin/sh
# Inside of a bare Debian: what a person types, then what systemd and udev make of it. Started by tests/package.sh.
set -eux
export DEBIAN_FRONTEND=noninteractive
. /etc/os-release
echo "$PRETTY_NAME, $(dpkg-query -f '.' -W | wc -c) packages"
cd /root
apt-get update -qq
cp dgtr_*.deb dgtr.deb
apt install -y ./dgtr.deb </dev/null >apt.log 2>&1 || { cat apt.log; exit 1; }
tail -n 3 apt.log
dgtr --version
dgtr doctor
dgtr demo
ls -l dgtr-demo
rm -rf dgtr-demo

apt-get install -y -qq --no-install-recommends systemd udev man-db bash-completion >/dev/null 2>&1
systemd-analyze --version | head -n 1
units="/usr/lib/systemd/system/dgtr-fly.service /usr/lib/systemd/system/dgtr-serve.service"
# shellcheck disable=SC2086
systemd-analyze verify $units
for unit in $units; do systemd-analyze security --offline=true --threshold=25 "$unit" | tail -n 1; done
udevadm verify --no-style /usr/lib/udev/rules.d/71-dgtr-autopilot.rules
id dgtr
man -w dgtr-fly
bash -c '. /usr/share/bash-completion/bash_completion; . /usr/share/bash-completion/completions/dgtr; complete -p dgtr'

# The onboard package takes the place of the whole and leaves nothing but what was flown.
apt-get install -y -qq ./dgtr-onboard_*.deb >/dev/null 2>&1
dgtr fly --help >/dev/null
if dgtr demo --help >/dev/null 2>&1; then exit 1; fi
apt-get purge -y -qq dgtr-onboard >/dev/null 2>&1
test ! -e /usr/bin/dgtr
test ! -e /etc/default/dgtr
# For the units' turn.
apt-get install -y -qq ./dgtr-onboard_*.deb >/dev/null 2>&1
echo "root: all is well"
