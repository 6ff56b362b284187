"""MAVProxy's camera module, driven as its user drives it: discovers the camera, lists its settings, sets one, takes a photo and a series.
Prints what it saw as JSON; ends by itself after two minutes, whatever it waits for.
  python mavproxy_client.py PORT    (where a router listens, which hands everything on)"""
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time

signal.alarm(120)
lines, lock = [], threading.Lock()
program = os.path.join(os.path.dirname(sys.executable), "mavproxy.py")
arguments = ["--master", f"udpout:127.0.0.1:{sys.argv[1]}", "--default-modules", "ftp,camera", "--state-basedir", tempfile.mkdtemp()]
shell = subprocess.Popen([sys.executable, "-u", program, *arguments], text=True, bufsize=1,
                         stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def read():
    for line in shell.stdout:
        with lock:
            lines.append(line.rstrip())


threading.Thread(target=read, daemon=True).start()
seen = {"steps": []}


def found(pattern):
    with lock:
        return [match for match in (re.search(pattern, line) for line in lines) if match]


def end(failed=None):
    if failed:
        seen["failed"] = failed + ": " + " | ".join(lines[-40:])
    print(json.dumps(seen), flush=True)
    shell.kill()
    sys.exit(1 if failed else 0)


def step(name, command, pattern, more=1, tries=40, again=True):
    """What is said once `pattern` was said `more` times more; the command is given again where that harms nothing."""
    before = len(found(pattern))
    for turn in range(tries):
        if command and (turn == 0 or (again and turn % 6 == 0)):
            shell.stdin.write(command + "\n")
            shell.stdin.flush()
        time.sleep(0.5)
        if len(found(pattern)) >= before + more:
            seen["steps"].append(name)
            return found(pattern)
    end(name)


captured = r"Camera \d+ image (\d+) captured"
if not found(r"loaded \d+ settings"):
    step("settings", None, r"loaded \d+ settings", tries=80)
seen["settings"] = int(found(r"loaded (\d+) settings")[-1].group(1))
seen["information"] = step("information", "camera info", r"resolution=.*")[-1].string
step("read", "camera params", r"KF_DISTANCE +[0-9.]+")
step("set", "camera param KF_DISTANCE 5.5", r"KF_DISTANCE", more=0, again=False)
time.sleep(2.0)
seen["set"] = step("get", "camera params", r"KF_DISTANCE +5\.5.*")[-1].string
# One picture alone could belong to another exposure: it is told with the next.
step("photo", "camera photo", captured, more=0, again=False)
time.sleep(1.5)
step("captured", "camera photo", captured, again=False)
step("series", "camera photo 1 3", captured, more=3, again=False)
step("stop", "camera stopphotos", r".*", more=0, again=False)
time.sleep(1.0)
seen["captured"] = [int(match.group(1)) for match in found(captured)]
seen["rejected"] = [match.string for match in found(r"rejected by")]
end()
