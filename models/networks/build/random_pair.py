"""Builds a pair network of Splatt3R's signature with random weights and of a few kilobytes: what a real export must look
like, and what the tests run through the whole unposed path.

Its pointmaps are a plane one unit away with a little relief from the picture, each pixel on its own viewing ray (for the
first view), the second view's shifted by BASELINE (in units of the depth) as if its camera stood there, so that the
alignment has something sensible to align; everything else is random.

    python random_pair.py OUT.onnx WIDTH HEIGHT FOCAL BASELINE
"""

import sys

import numpy as np
import onnx

from graph import Graph


def build(width, height, focal, baseline, seed=1):
    g, rng = Graph(), np.random.default_rng(seed)
    outputs = []
    ramp_x = ((np.arange(width) + 0.5 - width / 2) / focal).astype(np.float32)
    ramp_y = ((np.arange(height) + 0.5 - height / 2) / focal).astype(np.float32)
    xs, ys = np.meshgrid(ramp_x, ramp_y)
    rays = np.stack([xs, ys, np.ones_like(xs)], -1)[None]

    def head(features, channels, name, gain=0.1):
        kernel = (rng.standard_normal((channels, 8, 1, 1)) * gain).astype(np.float32)
        return g.op("Transpose", g.op("Conv", features, kernel), perm=[0, 2, 3, 1])

    for n, image in ((1, "img1"), (2, "img2")):
        f = g.op("Relu", g.op("Conv", image, (rng.standard_normal((8, 3, 3, 3)) * 0.3).astype(np.float32), pads=[1, 1, 1, 1]))
        depth = g.add(g.mul(g.op("Sigmoid", head(f, 1, "depth")), np.float32(0.02)), np.float32(1.0))
        final = {
            f"pts3d_{n}": (g.add(g.mul(depth, rays), np.array([baseline * (n - 1), 0, 0], np.float32)), [1, height, width, 3]),
            f"conf_{n}": (g.reshape(g.add(g.op("Exp", head(f, 1, "conf")), np.float32(1)), [1, height, width]), [1, height, width]),
            f"scales_{n}": (g.mul(g.op("Exp", head(f, 3, "scales")), np.float32(0.5 / focal)), [1, height, width, 3]),
            f"rotations_{n}": (g.add(head(f, 4, "rotations"), np.array([0, 0, 0, 1], np.float32)), [1, height, width, 4]),
            f"sh_{n}": (g.reshape(g.mul(head(f, 3, "sh"), np.float32(0.1)), [1, height, width, 3, 1]), [1, height, width, 3, 1]),
            f"opacities_{n}": (g.op("Sigmoid", head(f, 1, "opacity")), [1, height, width, 1]),
        }
        for name, (value, shape) in final.items():
            g.nodes.append(onnx.helper.make_node("Identity", [value], [name]))
            outputs.append((name, shape))
    shape = [1, 3, height, width]
    return g.model("random_pair", [("img1", shape), ("img2", shape)], outputs, "Splatt3R's signature, random weights")


if __name__ == "__main__":
    model = build(int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4]), float(sys.argv[5]))
    onnx.checker.check_model(model)
    onnx.save(model, sys.argv[1])
