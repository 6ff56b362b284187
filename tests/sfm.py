"""Structure from motion for comparison, with pycolmap: prepares a data set of a given number and size of pictures, runs
SIFT → exhaustive matching → incremental mapping over its training pictures, and writes points and seconds.

    python sfm.py prepare DATASET OUT --pictures N --scale S
    python sfm.py run OUT [--threads 2]

`prepare` writes OUT/images, transforms.json and split.json (held-out pictures of the source stay held out). `run` writes OUT/sfm.json
and, for the largest reconstruction brought onto the reference poses, OUT/sparse/0, which `dgtr train --init sfm` reads.
"""

import argparse
import json
import pathlib
import shutil
import time

import numpy as np
from PIL import Image, ImageOps

# Scenes beside the first one: pictures of these match none of the others (SIFT knows rotations, but neither mirrors nor negatives).
VARIANTS = [(False, False), (True, False), (False, True), (True, True)]


def prepare(source, out, pictures, scale):
    source, out = pathlib.Path(source), pathlib.Path(out)
    world = json.loads((source / "transforms.json").read_text())
    split = json.loads((source / "split.json").read_text()) if (source / "split.json").exists() else {}
    stem = lambda name: pathlib.Path(name).stem
    held_out = {stem(n) for n in split.get("test", [])}
    key_frames = {stem(n) for n in split.get("train", [])}
    frames = world["frames"]
    first = [f for f in frames if stem(f["file_path"]) in key_frames]
    if not first:
        first = [f for f in frames if stem(f["file_path"]) not in held_out]
    scenes = []
    if pictures <= len(first):
        scenes.append((VARIANTS[0], first[:pictures]))
        tests = [f for f in frames if stem(f["file_path"]) in held_out]
    else:
        tests = []
        for variant in VARIANTS:
            left = pictures - sum(len(s[1]) for s in scenes)
            if left > 0:
                scenes.append((variant, frames[:left]))
        if sum(len(s[1]) for s in scenes) < pictures:
            raise SystemExit(f"sfm.py: {source} has {len(frames)} pictures, at most {len(frames) * len(VARIANTS)} can be made of them")
    centres = np.array([np.array(f["transform_matrix"])[:3, 3] for f in frames])
    pitch = 2.0 * float(np.ptp(centres[:, 0])) + 100.0
    shutil.rmtree(out, ignore_errors=True)
    (out / "images").mkdir(parents=True)
    lens = {k: world[k] for k in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    size = (round(lens["w"] * scale), round(lens["h"] * scale))
    sx, sy = size[0] / lens["w"], size[1] / lens["h"]
    made, names = [], {"train": [], "test": []}

    def take(frame, kind, number, mirror, negative):
        picture = Image.open(source / frame["file_path"]).convert("RGB")
        if picture.size != size:
            picture = picture.resize(size, Image.Resampling.LANCZOS)
        matrix = np.array(frame["transform_matrix"], float)
        if mirror:
            # A mirrored picture is a picture of the mirrored world, if the principal point is in the middle.
            picture = ImageOps.mirror(picture)
            m = np.diag([-1.0, 1.0, 1.0, 1.0])
            matrix = m @ matrix @ m
        if negative:
            picture = ImageOps.invert(picture)
        matrix[0, 3] += number * pitch
        name = f"{number}_{stem(frame['file_path'])}.jpg"
        picture.save(out / "images" / name, quality=92)
        made.append({"file_path": f"images/{name}", "transform_matrix": matrix.tolist()})
        names[kind].append(name)

    for number, ((mirror, negative), chosen) in enumerate(scenes):
        for frame in chosen:
            take(frame, "train", number, mirror, negative)
    for frame in tests:
        take(frame, "test", 0, False, False)
    scaled = {"fl_x": lens["fl_x"] * sx, "fl_y": lens["fl_y"] * sy, "cx": lens["cx"] * sx, "cy": lens["cy"] * sy, "w": size[0], "h": size[1]}
    (out / "transforms.json").write_text(json.dumps({**scaled, "frames": made}))
    (out / "split.json").write_text(json.dumps(names))
    print(f"{out}: {len(names['train'])} training and {len(names['test'])} held-out pictures of {size[0]}×{size[1]}")


def run(folder, threads):
    import pycolmap

    folder = pathlib.Path(folder)
    world = json.loads((folder / "transforms.json").read_text())
    names = json.loads((folder / "split.json").read_text())["train"]
    work = folder / "sfm"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    database, images = work / "database.db", folder / "images"
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value if hasattr(pycolmap.logging, "Level") else 2
    seconds, since = {}, time.monotonic()

    def lap(name):
        nonlocal since
        now = time.monotonic()
        seconds[name], since = now - since, now

    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    reader.camera_params = ",".join(str(world[k]) for k in ("fl_x", "fl_y", "cx", "cy"))
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = threads
    extraction.use_gpu = False
    pycolmap.extract_features(database, images, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE,
                              reader_options=reader, extraction_options=extraction)
    lap("extract_s")
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    matching.use_gpu = False
    pycolmap.match_exhaustive(database, matching_options=matching)
    lap("match_s")
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads = threads
    mapping.ba_refine_focal_length = mapping.ba_refine_extra_params = False
    models = pycolmap.incremental_mapping(database, images, work, mapping)
    lap("map_s")
    found = sorted(models.values(), key=lambda m: -m.num_reg_images())
    # Incremental mapping may begin several models over the same pictures.
    registered = {m.images[i].name for m in found for i in m.reg_image_ids()}
    report = {**seconds, "total_s": sum(seconds.values()), "pictures": len(names), "width": world["w"], "height": world["h"],
              "threads": threads, "registered": len(registered), "points": sum(m.num_points3D() for m in found)}
    if found:
        report["alignment_rms_m"] = write_points(pycolmap, found[0], world, folder)
    (folder / "sfm.json").write_text(json.dumps(report, indent=2))
    print(json.dumps(report))


def write_points(pycolmap, model, world, folder):
    """Brings a reconstruction onto the reference camera positions and writes it; returns the rms of what remains, metres."""
    reference = {pathlib.Path(f["file_path"]).name: np.array(f["transform_matrix"])[:3, 3] for f in world["frames"]}
    pairs = [(i.projection_center(), reference[i.name]) for i in model.images.values() if i.has_pose and i.name in reference]
    a, b = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    if len(pairs) < 3:
        return None
    sim = pycolmap.estimate_sim3d(a, b)
    sim = sim.inverse() if np.linalg.norm(sim * a[0] - b[0]) > np.linalg.norm(sim.inverse() * a[0] - b[0]) else sim
    model.transform(sim)
    (folder / "sparse/0").mkdir(parents=True, exist_ok=True)
    model.write(folder / "sparse/0")
    moved = np.array([sim * p for p in a])
    return float(np.sqrt(((moved - b) ** 2).sum(1).mean()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    p = commands.add_parser("prepare")
    p.add_argument("source")
    p.add_argument("out")
    p.add_argument("--pictures", type=int, required=True)
    p.add_argument("--scale", type=float, default=1.0)
    r = commands.add_parser("run")
    r.add_argument("folder")
    r.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    if args.command == "prepare":
        prepare(args.source, args.out, args.pictures, args.scale)
    else:
        run(args.folder, args.threads)
