"""Poses of a card of pictures, by structure from motion (pycolmap) and by `dgtr train`: the same JPEG files with what EXIF says of GPS
and lens, the same machine, two threads each.

    python peers.py card DATASET OUT --pictures N       the first N pictures of a data set as a card, and their reference poses
    python peers.py colmap CARD REPORT --mapper incremental|global [--features N] [--neighbours N]
    python peers.py ours RUN REPORT                     of a finished `dgtr train CARD --out RUN`
    python peers.py compare CARD REPORT...              a Markdown table
    python peers.py lens DATASET                        the focal length that COLMAP's own tracks of the key frames give, by camera model

COLMAP matches what GPS says is near (its fastest matching that finds all pictures here), and maps with positions as priors.
"""

import argparse
import json
import pathlib
import shutil
import time

import numpy as np

OPENGL = np.diag([1.0, -1.0, -1.0])


def stem(name):
    return pathlib.Path(name).stem


def card(source, out, pictures):
    world = json.loads((source / "transforms.json").read_text())
    split = json.loads((source / "split.json").read_text()) if (source / "split.json").exists() else {}
    key = {stem(n) for n in split.get("train", [])}
    frames = world["frames"]
    chosen = [f for f in frames if stem(f["file_path"]) in key] if pictures == len(key) else frames[:pictures]
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    reference = {}
    for frame in chosen:
        path = source / frame["file_path"]
        shutil.copy(path, out / path.name)
        reference[path.stem] = frame["transform_matrix"]
    out.with_suffix(".reference.json").write_text(json.dumps(reference))
    print(f"{out}: {len(chosen)} pictures")


def colmap(folder, report, mapper, features, neighbours, threads):
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value if hasattr(pycolmap.logging, "Level") else 2
    work = report.with_suffix("")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    database, start, laps = work / "database.db", time.monotonic(), {}

    def lap(name):
        laps[name] = time.monotonic() - start - sum(laps.values())

    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.use_gpu = threads, False
    extraction.sift.max_num_features = features
    pycolmap.extract_features(database, folder, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader, extraction_options=extraction)
    lap("features_s")
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.use_gpu = threads, False
    pairing = pycolmap.SpatialPairingOptions()
    pairing.max_num_neighbors, pairing.num_threads = neighbours, threads
    pycolmap.match_spatial(database, matching_options=matching, pairing_options=pairing)
    lap("match_s")
    if mapper == "global":
        options = pycolmap.GlobalPipelineOptions() if hasattr(pycolmap, "GlobalPipelineOptions") else None
        models = pycolmap.global_mapping(database, folder, work, options) if options else pycolmap.global_mapping(database, folder, work)
    else:
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads, options.use_prior_position = threads, True
        models = pycolmap.incremental_mapping(database, folder, work, options)
    lap("map_s")
    found = max(models.values(), key=lambda m: m.num_reg_images())
    camera = next(iter(found.cameras.values()))
    errors = [p.error for p in found.points3D.values() if p.error >= 0]
    poses = {}
    for image in found.images.values():
        if image.has_pose:
            pose = image.cam_from_world().inverse()
            poses[stem(image.name)] = np.column_stack([pose.rotation.matrix(), pose.translation]).tolist()
    name = f"pycolmap {pycolmap.__version__}, {mapper}, at most {features} SIFT"
    save(report, name, laps, poses, len(poses), float(np.median(errors)), camera.mean_focal_length() / camera.width)


def ours(run, report):
    told = json.loads((run / "run.json").read_text())
    world = json.loads((run / "transforms.json").read_text())
    laps = {k: v / 1e3 for k, v in told["stage_ms"].items() if k == "poses"}
    poses, refined = {}, told["refine"]
    for frame in world["frames"]:
        matrix = np.array(frame["transform_matrix"])
        poses[stem(frame["file_path"])] = np.column_stack([matrix[:3, :3] @ OPENGL, matrix[:3, 3]]).tolist()
    lens = {**world, **world["frames"][0]}
    save(report, "dgtr", laps, poses, refined["frames_tied"], refined["reprojection_median_px"], lens["fl_x"] / lens["w"])


def save(report, name, laps, poses, registered, error, focal):
    told = {"name": name, "laps": laps, "poses": poses, "registered": registered, "error_px": error, "focal": focal}
    report.write_text(json.dumps(told))
    print(f"{name}: {({k: round(v, 1) for k, v in laps.items()})}")


def agreement(poses, reference):
    """Root mean square of positions and angles after the similarity that brings the positions together."""
    names = sorted(set(poses) & set(reference))
    a = np.array([np.array(poses[n])[:, 3] for n in names])
    b = np.array([np.array(reference[n])[:3, 3] for n in names])
    ma, mb = a.mean(0), b.mean(0)
    u, d, vt = np.linalg.svd((b - mb).T @ (a - ma))
    s = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u @ s @ vt
    scale = np.trace(np.diag(d) @ s) / ((a - ma) ** 2).sum()
    off = scale * (a - ma) @ turn.T + mb - b
    angles = []
    for n in names:
        r = turn @ np.array(poses[n])[:, :3]
        t = np.array(reference[n])[:3, :3] @ OPENGL
        angles.append(np.degrees(np.arccos(np.clip((np.trace(r @ t.T) - 1) / 2, -1, 1))))
    return np.sqrt((off**2).sum(1).mean()), np.sqrt(np.mean(np.square(angles)))


def compare(folder, reports):
    if (folder / "truth.json").exists():
        frames = json.loads((folder / "truth.json").read_text())["frames"]
        reference = {stem(f["file_path"]): f["transform_matrix"] for f in frames}
    else:
        reference = json.loads(folder.with_suffix(".reference.json").read_text())
    print("| | s | pictures | median error, px | position, angle against the reference | focal length, widths |\n|---|---|---|---|---|---|")
    for report in reports:
        r = json.loads(report.read_text())
        p, a = agreement(r["poses"], reference)
        print(f"| {r['name']} | {sum(r['laps'].values()):.1f} | {r['registered']} of {len(reference)} | {r['error_px']:.2f} | {p:.3f} m, {a:.3f}° | {r['focal']:.4f} |")


def lens(source):
    """Bundle adjustment of DATASET/sparse/0, its key frames only, from a focal length 2 % long."""
    import pycolmap

    key = {stem(n) for n in json.loads((source / "split.json").read_text())["train"]}
    for what, model, higher in [("two focal lengths", "PINHOLE", 0.0), ("one", "SIMPLE_PINHOLE", 0.0), ("one, principal point half a pixel higher", "SIMPLE_PINHOLE", 0.5),
                                ("one and two radial terms, principal point half a pixel higher", "RADIAL", 0.5)]:
        scene = pycolmap.Reconstruction(source / "sparse/0")
        for image in list(scene.images.values()):
            if stem(image.name) not in key:
                scene.deregister_frame(image.frame_id)
        camera = next(iter(scene.cameras.values()))
        fx, fy, cx, cy = camera.params
        place = [cx, cy - higher]
        camera.model = getattr(pycolmap.CameraModelId, model)
        camera.params = {"PINHOLE": [1.02 * fx, 1.02 * fy, *place], "SIMPLE_PINHOLE": [1.02 * fx, *place], "RADIAL": [1.02 * fx, *place, 0, 0]}[model]
        options = pycolmap.BundleAdjustmentOptions()
        options.refine_focal_length, options.refine_principal_point, options.refine_extra_params = True, False, model == "RADIAL"
        options.print_summary = False
        pycolmap.bundle_adjustment(scene, options)
        print(f"{what}: focal length {100 * (next(iter(scene.cameras.values())).params[0] / fx - 1):+.2f} %, {scene.compute_mean_reprojection_error():.3f} px")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    path = pathlib.Path
    c = commands.add_parser("card")
    c.add_argument("source", type=path), c.add_argument("out", type=path), c.add_argument("--pictures", type=int, required=True)
    c = commands.add_parser("colmap")
    c.add_argument("card", type=path), c.add_argument("report", type=path)
    c.add_argument("--mapper", choices=["incremental", "global"], default="incremental")
    c.add_argument("--features", type=int, default=4000), c.add_argument("--neighbours", type=int, default=20)
    c.add_argument("--threads", type=int, default=2)
    c = commands.add_parser("ours")
    c.add_argument("run", type=path), c.add_argument("report", type=path)
    c = commands.add_parser("compare")
    c.add_argument("card", type=path), c.add_argument("reports", type=path, nargs="+")
    c = commands.add_parser("lens")
    c.add_argument("source", type=path)
    a = parser.parse_args()
    match a.command:
        case "card":
            card(a.source, a.out, a.pictures)
        case "colmap":
            colmap(a.card, a.report, a.mapper, a.features, a.neighbours, a.threads)
        case "ours":
            ours(a.run, a.report)
        case "lens":
            lens(a.source)
        case _:
            compare(a.card, a.reports)


if __name__ == "__main__":
    main()
