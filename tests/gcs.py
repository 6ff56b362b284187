"""A ground station beside a simulated aircraft and its onboard job: see gcs.sh."""
import base64
import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
import xml.etree.ElementTree as xml

os.environ["MAVLINK20"] = "1"
import jsonschema  # noqa: E402
from mcap.reader import make_reader  # noqa: E402
from pymavlink import mavftp, mavutil  # noqa: E402

PORTS = (18570, 18571)  # the vehicle's side of a UDP hub, and the job's
REAL, COUNT = 9, 5  # MAV_PARAM_EXT_TYPE
ACCEPTED, UNSUPPORTED, FAILED = 0, 1, 2  # PARAM_ACK
MISSION = """
name = "gcs"
seed = 3
origin = { lat_deg = 46.0, lon_deg = 7.0, alt_m = 500.0 }
camera = { width = 128, height = 96, fx = 100.0, fy = 100.0, cx = 64.0, cy = 48.0, exposure_delay_ms = 60.0 }
keyframes = { t_min_m = 500.0, r_max_deg = 180.0, max = 24 }
memory = { device_mib = 96, host_mib = 1024, max_gaussians = 4000 }
training = { seconds = 600.0 }
upload = { folder = "upload" }
[[aircraft]]
id = "one"
link = "udpout:127.0.0.1:%d"
camera = { folder = "camera" }
region_enu = [[-20.0, -20.0], [20.0, -20.0], [20.0, 20.0], [-20.0, 20.0]]
""" % PORTS[1]


class Station:
    """A router between vehicle, job and ourselves, as MAVProxy is one: every frame goes to the others."""

    def __init__(self):
        self.vehicle = mavutil.mavlink_connection("udpin:127.0.0.1:%d" % PORTS[0], source_system=255, source_component=190)
        self.job = mavutil.mavlink_connection("udpin:127.0.0.1:%d" % PORTS[1], source_system=255, source_component=190)
        self.mav, self.source_system, self.source_component = self.job.mav, 255, 190
        self.values, self.counts, self.acks, self.heard = {}, {}, [], []
        self.texts = []

    def route(self):
        """One round; what the job said."""
        said = []
        for here, there in ((self.vehicle, self.job), (self.job, self.vehicle)):
            while True:
                m = here.recv_msg()
                if m is None:
                    break
                if m.get_type() == "BAD_DATA":
                    continue
                try:
                    there.write(m.get_msgbuf())
                except (OSError, TypeError):
                    pass  # nobody is there yet
                if here is self.job:
                    said.append(m)
        for m in said:
            if m.get_srcComponent() != 100:
                continue
            if m.get_type() == "PARAM_EXT_VALUE":
                raw = field(m, "param_value", 128)
                kind = "<f" if m.param_type == REAL else "<I"
                self.values[name(m)] = struct.unpack(kind, raw[:4])[0]
                self.counts[name(m)] = self.counts.get(name(m), 0) + 1
            elif m.get_type() == "PARAM_EXT_ACK":
                self.acks.append((name(m), m.param_result, struct.unpack("<f", field(m, "param_value", 128)[:4])[0]))
            elif m.get_type() == "STATUSTEXT":
                self.texts.append(m.text)
        return said

    def recv_match(self, type=None, blocking=False, timeout=0.1, **_):
        """What pymavlink's own FTP client asks of a connection."""
        kinds = [type] if isinstance(type, str) else type
        until = time.time() + (timeout or 0)
        while True:
            while self.heard:
                m = self.heard.pop(0)
                if kinds is None or m.get_type() in kinds:
                    return m
            self.heard = self.route()
            if not self.heard and time.time() > until:
                return None
            if not self.heard:
                time.sleep(0.002)

    def until(self, what, holds, seconds=60.0):
        end = time.time() + seconds
        while not holds():
            self.route()
            assert time.time() < end, "%s did not happen within %.0f s; %r %r" % (what, seconds, self.values, self.acks)
            time.sleep(0.002)

    def set(self, parameter, value, kind=REAL):
        """Result and value of the acknowledgement."""
        before = len(self.acks)
        raw = struct.pack("<f" if kind == REAL else "<I", value)
        self.mav.param_ext_set_send(1, 100, parameter.encode(), raw.ljust(128, b"\0"), kind)
        self.until("an answer for %s" % parameter, lambda: len(self.acks) > before, 5.0)
        assert self.acks[-1][0] == parameter, self.acks[-1]
        return self.acks[-1][1:]


def field(m, which, size):
    """Bytes of a char array, which pymavlink hands out as text cut at the first zero: out of the frame itself."""
    payload = bytes(m.get_msgbuf())[10:-2].ljust(255, b"\0")
    offset = {"PARAM_EXT_VALUE": 4 + 16, "PARAM_EXT_ACK": 16}[m.get_type()]
    assert which == "param_value"
    return payload[offset : offset + size]


def name(m):
    return m.param_id if isinstance(m.param_id, str) else m.param_id.decode().rstrip("\0")


def definition(station, folder):
    """The file that CAMERA_INFORMATION names, read as QGroundControl does: open, burst, close."""
    got = []

    def information():
        station.mav.command_long_send(1, 100, 512, 0, 259, 0, 0, 0, 0, 0, 0)
        end = time.time() + 1.0
        while time.time() < end and not got:
            got.extend(m for m in station.route() if m.get_type() == "CAMERA_INFORMATION")
        return got

    station.until("CAMERA_INFORMATION", information)
    uri, version = got[0].cam_definition_uri, got[0].cam_definition_version
    assert uri.startswith("mftp://") and version > 0, (uri, version)
    path = uri[len("mftp://") :]
    # Its own, but that it waits a third as long for whatever else might come after an answer.
    defaults = dict(debug=0, pkt_loss_tx=0, pkt_loss_rx=0, max_backlog=5, burst_read_size=80, write_size=80, write_qsize=5)
    times = dict(idle_detection_time=1.2, read_retry_time=1.0, retry_time=0.5)
    every = [(k, int, v) for k, v in defaults.items()] + [(k, float, v) for k, v in times.items()]
    ftp = mavftp.MAVFTP(station, 1, 100, settings=mavftp.MAVFTPSettings(every))
    ftp.temp_filename = os.path.join(folder, "temporary")
    os.chdir(folder)
    text = ftp.read("definition.xml", 1 << 20)
    assert text, "pymavlink's FTP client read nothing"
    listed = ftp.cmd_ftp(["list", "/"])
    station_files = [(e.name, e.size_b) for e in ftp.list_result]
    assert listed.error_code == 0 and station_files == [("definition.xml", len(text))], station_files
    refused = ftp.cmd_ftp(["crc", "/etc/passwd"])
    assert refused.error_code != 0, "a path of the file system is answered"
    assert ftp.cmd_ftp(["crc", path]).error_code == 0
    for arguments in (["rm", "definition.xml"], ["mkdir", "a"]):
        ftp.cmd_ftp(arguments)
    tree = xml.fromstring(text)
    assert tree.tag == "mavlinkcamera" and tree.find("definition").get("version") == "%05d" % version
    assert tree.find("definition/model").text and tree.find("definition/vendor").text
    rows = {}
    for p in tree.find("parameters").findall("parameter"):
        # What QGroundControl's reader knows and demands (VehicleCameraControl::_loadSettings).
        known = {"name", "type", "default", "control", "readonly", "writeonly", "min", "max", "step", "decimalPlaces", "unit"}
        assert set(p.attrib) <= known and p.get("type") in ("float", "uint32") and p.find("description").text, p.attrib
        assert {child.tag for child in p} <= {"description", "options", "updates"}, p.attrib
        options = {int(o.get("value")): o.get("name") for o in p.iter("option")}
        rows[p.get("name")] = (REAL if p.get("type") == "float" else COUNT, p.get("readonly") == "1", options)
    return rows, len(text), version


def recorded(path, run):
    """What Foxglove's own reader finds in the recording: every message as its schema says, as many as there were."""
    counts, texts, states, pictures, times = {}, [], [], 0, []
    with open(path, "rb") as file:
        reader = make_reader(file)
        assert reader.get_summary().statistics.message_count > 0, "no summary"
        for schema, channel, message in reader.iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json"), channel
            content = json.loads(message.data)
            jsonschema.validate(content, json.loads(schema.data))
            assert set(content) == set(json.loads(schema.data)["properties"]), (schema.name, content)
            stamp = content["timestamp"]
            assert stamp["sec"] * 10**9 + stamp["nsec"] == message.log_time
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            times.append(message.log_time)
            if channel.topic == "/keyframe/image":
                pictures += base64.b64decode(content["data"])[:2] in (b"\xff\xd8", b"\x89P")
            elif channel.topic == "/log":
                texts.append(content["message"])
            elif channel.topic == "/state":
                states.append(content)
    assert abs(max(times) * 1e-9 - time.time()) < 600, "Unix time"
    assert counts["/aircraft/pose"] == counts["/aircraft/fix"] > 50, counts
    assert counts["/exposure"] == run["hal"]["triggers"], (counts, run["hal"])
    assert counts["/keyframe/pose"] == counts["/keyframe/image"] == pictures == run["views"], (counts, run["views"])
    assert any("covered" in text for text in texts) and any(s["gaussians"] > 0 for s in states), (texts, states[-1:])
    print("flight.mcap: %d bytes, %s" % (os.path.getsize(path), ", ".join("%s %d" % c for c in sorted(counts.items()))))


def main(program, out):
    shutil.rmtree(out, ignore_errors=True)
    os.makedirs(os.path.join(out, "camera"))
    with open(os.path.join(out, "mission.toml"), "w") as file:
        file.write(MISSION)
    station = Station()
    environment = dict(os.environ, DGTR_KERNELS="default")
    log = open(os.path.join(out, "fly.log"), "w")
    sim = subprocess.Popen(
        [program, "sim", "--mission", "mission.toml", "--link", "udpout:127.0.0.1:%d" % PORTS[0], "--speed", "1.5", "--linger", "6"],
        cwd=out, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )
    fly = subprocess.Popen(
        [program, "fly", "--mission", "mission.toml", "--out", "out", "--silence", "4", "--record", "flight.mcap"],
        cwd=out, env=environment, stdout=log, stderr=log,
    )
    try:
        rows, size, version = definition(station, out)
        print("definition.xml: %d bytes, version %d, %d parameters" % (size, version, len(rows)))
        station.mav.param_ext_request_list_send(1, 100)
        station.until("all parameters", lambda: set(station.values) >= set(rows), 10.0)
        assert set(station.values) == set(rows), station.values
        assert (station.values["KF_DISTANCE"], station.values["TRAIN_SECONDS"]) == (500.0, 600.0), station.values
        assert station.set("KF_DISTANCE", 4.5) == (ACCEPTED, 4.5)
        assert station.set("KF_DISTANCE", 4.5) == (ACCEPTED, 4.5), "repeated"
        assert station.set("TRAIN_SECONDS", 2.0) == (ACCEPTED, 2.0)
        for wrong in (float("nan"), -1.0, 1e30):
            assert station.set("KF_DISTANCE", wrong) == (UNSUPPORTED, 4.5), wrong
        assert station.set("STATE", 3, COUNT)[0] == UNSUPPORTED, "what is read only is not set"
        assert station.set("NO_SUCH_NAME", 1.0)[0] == FAILED
        station.until("key frames", lambda: station.values["KEY_FRAMES"] >= 3)
        assert 0 < station.values["KF_OVERLAP"] <= 100 and station.values["PICTURES"] >= 3, station.values
        training = [value for value, word in rows["STATE"][2].items() if "training" in word]
        station.until("training", lambda: station.values["STATE"] in training)
        station.until("Gaussians", lambda: station.values["GAUSSIANS"] > 100)
        station.until("covered ground", lambda: station.values["COVERED"] > 0)
        assert max(station.counts.values()) < 60, "told more often than anybody reads: %r" % station.counts
        assert (station.values["KF_DISTANCE"], station.values["TRAIN_SECONDS"]) == (4.5, 2.0), "others are told, too"
        print("in flight: %s" % ", ".join("%s %g" % item for item in sorted(station.values.items())))
        end = time.time() + 120
        while fly.poll() is None:
            station.route()
            assert time.time() < end, "the flight does not end"
            time.sleep(0.002)
    finally:
        for child in (fly, sim):
            if child.poll() is None:
                child.send_signal(signal.SIGKILL)
            child.wait()
        log.close()
    said = open(os.path.join(out, "fly.log")).read()
    assert fly.returncode == 0, said
    for words in ("set KF_DISTANCE to 4.5", "set TRAIN_SECONDS to 2"):
        assert words in said, said
    # By the mission alone there would be one key frame, and ten minutes of training.
    with open(os.path.join(out, "out", "run.json")) as file:
        run = json.load(file)
    assert run["views"] >= 3 and run["stage_ms"]["train"] < 20e3, run
    recorded(os.path.join(out, "flight.mcap"), run)
    print("passed")


main(*(os.path.abspath(a) for a in sys.argv[1:]))
