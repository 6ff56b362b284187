"""Builds the two small networks that the tests run through contracts `depth` and `metric`, and that a real export of such a
network must resemble:

    random_depth.onnx       image [1,3,h,w] → depth [1,h,w]: two random convolutions, positive
    mean_square.onnx        a, b [1,3,h,w] → dist [1]: the mean squared difference (its tensors carry other names than the
                            contract's, as exports of others do: the manifest's [names] says which is which)

    python tiny.py FOLDER
"""

import pathlib
import sys

import numpy as np
import onnx

from graph import Graph


def random_depth(seed=3):
    g, rng = Graph(), np.random.default_rng(seed)
    kernel = lambda o, i: (rng.standard_normal((o, i, 3, 3)) * (2.0 / (9 * i)) ** 0.5).astype(np.float32)
    x = g.op("Relu", g.op("Conv", "image", kernel(8, 3), pads=[1, 1, 1, 1]))
    x = g.op("Softplus", g.op("Conv", x, kernel(1, 8), pads=[1, 1, 1, 1]))
    g.nodes.append(onnx.helper.make_node("Squeeze", [x, g.const(np.array([1], np.int64))], ["depth"]))
    return g.model("random_depth", [("image", [1, 3, "h", "w"])], [("depth", [1, "h", "w"])], "Random weights, for tests")


def mean_square():
    g = Graph()
    d = g.sub("a", "b")
    mean = g.op("ReduceMean", g.mul(d, d), axes=[1, 2, 3], keepdims=0)
    g.nodes.append(onnx.helper.make_node("Identity", [mean], ["dist"]))
    shape = [1, 3, "h", "w"]
    return g.model("mean_square", [("a", shape), ("b", shape)], [("dist", [1])], "Mean squared difference, for tests")


if __name__ == "__main__":
    for name, model in (("random_depth", random_depth()), ("mean_square", mean_square())):
        onnx.checker.check_model(model)
        onnx.save(model, pathlib.Path(sys.argv[1]) / f"{name}.onnx")
