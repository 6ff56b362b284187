"""An autopilot as pymavlink understands the protocol, for hal/tests/pymavlink_peer.rs.

Usage: peer.py DEVICE [KEY_HEX]. Talks for a few seconds, then prints what it heard as one line of JSON.
"""
import json
import os
import sys
import time

os.environ["MAVLINK20"] = "1"
from pymavlink import mavutil  # noqa: E402

device, key = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None
link = mavutil.mavlink_connection(device, baud=921600, source_system=1, source_component=1, dialect="ardupilotmega")
if key:
    link.setup_signing(bytes.fromhex(key), sign_outgoing=True, initial_timestamp=None, link_id=1)
mav = link.mav
m = mavutil.mavlink
start = time.time()
heard = {"cameras": 0, "signed": 0, "unsigned": 0, "timesync_answers": 0, "acks": {}, "information": None, "texts": [],
         "captured": 0, "bad": 0}


def boot_ms():
    return int((time.time() - start) * 1000) + 5000


def receive():
    while True:
        msg = link.recv_msg()
        if msg is None:
            return
        kind = msg.get_type()
        if kind == "BAD_DATA":
            heard["bad"] += 1
            continue
        heard["signed" if msg.get_signed() else "unsigned"] += 1
        if kind == "HEARTBEAT" and msg.type == m.MAV_TYPE_CAMERA and msg.get_srcComponent() == 100:
            heard["cameras"] += 1
        elif kind == "TIMESYNC" and msg.tc1 == 0:
            mav.timesync_send(boot_ms() * 1000000, msg.ts1)
        elif kind == "TIMESYNC" and msg.ts1 == 424242:
            heard["timesync_answers"] += 1
        elif kind == "COMMAND_ACK":
            heard["acks"][str(msg.command)] = msg.result
        elif kind == "CAMERA_INFORMATION":
            heard["information"] = [msg.resolution_h, msg.resolution_v]
        elif kind == "CAMERA_IMAGE_CAPTURED":
            heard["captured"] += 1
        elif kind == "STATUSTEXT":
            heard["texts"].append([msg.id, msg.chunk_seq, msg.text])


tick, shots = 0, 0
while time.time() - start < 4.0:
    now = boot_ms()
    if tick % 20 == 0:
        mav.heartbeat_send(m.MAV_TYPE_QUADROTOR, m.MAV_AUTOPILOT_ARDUPILOTMEGA, 128, 0, m.MAV_STATE_ACTIVE)
        mav.system_time_send(int((start - 5.0) * 1e6) + now * 1000, now)
        mav.timesync_send(0, 424242)
    mav.attitude_quaternion_send(now, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if tick % 2 == 0:
        lat = 468426500 + int((now - 5000) * 0.05)
        mav.global_position_int_send(now, lat, -919939000, 198600, 40000, 556, 0, 0, 0)
    if tick == 20:
        for command, p1 in ((512, 259.0), (521, 1.0), (203, 0.0), (2501, 0.0), (511, 262.0)):
            mav.command_long_send(1, 100, command, 0, p1, 500000.0, 0, 0, 0, 0, 0)
        mav.command_long_send(1, 100, 2000, 0, 0, 0, 2, 0, 0, 0, 0)
    if tick in (30, 45, 60):
        shots += 1
        unix = int((start - 5.0) * 1e6) + now * 1000
        mav.camera_feedback_send(unix, 0, 0, shots, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0)
    receive()
    tick += 1
    time.sleep(max(0.0, start + tick * 0.05 - time.time()))
print(json.dumps(heard))
