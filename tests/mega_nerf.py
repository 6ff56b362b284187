"""Writes a data set (nerfstudio's transforms.json, pinhole lenses) in the form in which Mega-NeRF publishes Mill-19, by PyTorch itself:
coordinates.pt, {train,val}/metadata/NNNNNN.pt, {train,val}/rgbs/NNNNNN.jpg. Every fifth picture is held out.

    pip install torch pillow
    tests/mega_nerf.py DATASET OUT [--scale 0.2] [--pictures N]

models/tests/data/mega_nerf was made by it from the truth of `dgtr demo`'s western aircraft, with --scale 0.2 --pictures 6."""
import argparse
import json
import pathlib

import torch
from PIL import Image

# From x east, y north, z up to x down, y right, z back.
TO_DRB = torch.tensor([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)

parser = argparse.ArgumentParser()
parser.add_argument("dataset", type=pathlib.Path)
parser.add_argument("out", type=pathlib.Path)
parser.add_argument("--scale", type=float, default=1.0)
parser.add_argument("--pictures", type=int)
asked = parser.parse_args()

described = json.loads((asked.dataset / "transforms.json").read_text())
frames = sorted(described["frames"], key=lambda f: f["file_path"])[: asked.pictures]
poses = torch.tensor([f["transform_matrix"] for f in frames], dtype=torch.float64)[:, :3]
poses = TO_DRB @ poses
low, high = poses[:, :, 3].amin(0), poses[:, :, 3].amax(0)
origin, metres = (low + high) / 2, float((high - low).max())
poses[:, :, 3] = (poses[:, :, 3] - origin) / metres

asked.out.mkdir(parents=True)
torch.save({"origin_drb": origin.float(), "pose_scale_factor": metres}, asked.out / "coordinates.pt")
for i, (frame, pose) in enumerate(zip(frames, poses)):
    folder = asked.out / ("val" if i % 5 == 0 else "train")
    for kind in ("rgbs", "metadata"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    picture = Image.open(asked.dataset / frame["file_path"]).convert("RGB")
    width, height = (round(side * asked.scale) for side in picture.size)
    picture.resize((width, height), Image.LANCZOS).save(folder / "rgbs" / f"{i:06}.jpg", quality=80)
    lens = [frame.get(name, described.get(name)) for name in ("fl_x", "fl_y", "cx", "cy")]
    ratio = [width / picture.width, height / picture.height] * 2
    torch.save(
        {
            "H": height,
            "W": width,
            "c2w": pose.float(),
            "intrinsics": torch.tensor([v * r for v, r in zip(lens, ratio)], dtype=torch.float32),
            "distortion": torch.zeros(4),
        },
        folder / "metadata" / f"{i:06}.pt",
    )
