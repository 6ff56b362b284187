"""MAVSDK's client of a camera, as a ground station's program uses it: lists cameras, settings and their options, sets one, takes a
photo and a series, lists what was taken. Prints what it saw as JSON; ends by itself after two minutes, whatever it waits for.
  python mavsdk_client.py PORT    (where a router listens, which hands everything on)"""
import json
import signal
import sys
import time

from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.camera import camera as cc

signal.alarm(120)
seen = {"steps": [], "captured": []}


def step(name, what, tries=60):
    """What `what` gives once it gives something; a client asks again."""
    last = None
    for _ in range(tries):
        try:
            last = what()
            if last:
                seen["steps"].append(name)
                return last
        except Exception as e:
            last = str(e)
        time.sleep(0.5)
    print(json.dumps({**seen, "failed": f"{name}: {last}"}), flush=True)
    sys.exit(1)


client = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
client.add_any_connection(f"udpout://127.0.0.1:{sys.argv[1]}")
camera = cc.Camera(client.first_autopilot(30.0))
camera.subscribe_capture_info(lambda info, _: seen["captured"].append([info.index, info.time_utc_us > 0, info.is_success]))
found = step("list", lambda: camera.camera_list().cameras)
one = found[0].component_id
seen["camera"] = [one, found[0].horizontal_resolution_px, found[0].vertical_resolution_px]
settings = step("settings", lambda: (lambda all: all if len(all) > 5 else None)(camera.get_current_settings(one)))
seen["settings"] = sorted(s.setting_id for s in settings)
options = step("options", lambda: camera.get_possible_setting_options(one))
seen["options"] = sorted(o.setting_id for o in options)
wanted = cc.Setting(setting_id="KF_DISTANCE", option=cc.Option(option_id="5.5"))
step("set", lambda: str(camera.set_setting(one, wanted)))
seen["set"] = step("get", lambda: camera.get_setting(one, wanted).option.option_id)
before = len(seen["captured"])
# One picture alone could belong to another exposure: it is told with the next.
for _ in range(2):
    step("photo", lambda: str(camera.take_photo(one)), tries=1)
    time.sleep(1.5)
step("captured", lambda: len(seen["captured"]) > before)
before = len(seen["captured"])
step("interval", lambda: str(camera.start_photo_interval(one, 1.0)), tries=1)
step("series", lambda: len(seen["captured"]) >= before + 3)
step("stop", lambda: str(camera.stop_photo_interval(one)), tries=1)
time.sleep(1.0)
photos = step("photos", lambda: camera.list_photos(one, 0))
seen["photos"] = sorted(p.index for p in photos)
print(json.dumps(seen), flush=True)
client.destroy()
