#!/usr/bin/env python3
"""How far the camera places of several aircraft are off against a data set's own, after one similarity over all of them: what
registration is worth. Needs numpy.
    tests/places.py DATASET LOCAL.dgtr… [--global MODEL.dgtr]    (DGTR: the program, else target/release/dgtr)
With --global the places are those of the merged model, told apart by who has the picture in LOCAL; without, those of the LOCAL models,
each where its own GPS put it. Last column: each by itself."""
import json
import os
import subprocess
import sys
import tempfile

import numpy as np

HERE = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
DGTR = os.environ.get("DGTR", os.path.join(HERE, "target/release/dgtr"))


def places(path):
    """Camera places by stem of a nerfstudio file."""
    with open(path) as file:
        frames = json.load(file)["frames"]
    stem = lambda frame: os.path.splitext(os.path.basename(frame["file_path"]))[0]
    return {stem(frame): np.array(frame["transform_matrix"])[:3, 3] for frame in frames}


def of_model(path):
    with tempfile.TemporaryDirectory() as folder:
        to = os.path.join(folder, "transforms.json")
        subprocess.run([DGTR, "-q", "export", path, "--to", "nerfstudio", "--out", to], check=True, stdout=subprocess.DEVNULL)
        return places(to)


def similarity(a, b):
    """a onto b by least squares (Umeyama 1991)."""
    ca, cb = a.mean(0), b.mean(0)
    u, s, vt = np.linalg.svd((b - cb).T @ (a - ca) / len(a))
    d = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    r = u @ d @ vt
    scale = (s * np.diag(d)).sum() / ((a - ca) ** 2).sum(1).mean()
    return lambda p: scale * (p - ca) @ r.T + cb


def main(arguments):
    merged = None
    if "--global" in arguments:
        at = arguments.index("--global")
        merged = of_model(arguments[at + 1])
        del arguments[at : at + 2]
    if len(arguments) < 2:
        sys.exit(__doc__)
    truth = places(os.path.join(arguments[0], "transforms.json"))
    local = [of_model(path) for path in arguments[1:]]
    names = [sorted(set(model) & set(truth)) for model in local]
    own = [np.array([(merged or model)[name] for name in of]) for model, of in zip(local, names)]
    true = [np.array([truth[name] for name in of]) for of in names]
    rms = lambda off: np.sqrt((off**2).sum(1).mean())
    together = similarity(np.concatenate(own), np.concatenate(true))
    for i, (a, b) in enumerate(zip(own, true)):
        print(f"{arguments[1 + i]}: {len(a)} cameras, {rms(together(a) - b):.3f} m off, by itself {rms(similarity(a, b)(a) - b):.3f}")


main(sys.argv[1:])
