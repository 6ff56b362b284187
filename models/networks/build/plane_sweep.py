"""Builds plane_sweep.onnx: depth and confidence of a picture from two posed neighbours, without learned weights.

    features      luminance, normalised by its local mean and deviation, at 1/4 and 1/2 of the size
    cost volume   1/4: `planes` inverse depths over the whole range; 1/2: `fine` planes around the first result
    aggregation   Gaussian windows of two sizes over means of small blocks, as products with matrices (what a CPU does best)
    depth         soft-argmax of the normalised correlation over inverse depth
    confidence    correlation at the peak, damped where the picture has no texture or no second view

Warps are nearest-neighbour look-ups (GatherElements) in feature maps of twice the resolution: GridSample costs ONNX Runtime 56 ns a
sample on the machine this was written on, this 2 ns, and half a pixel of the finer map is all it loses.

    python plane_sweep.py OUT.onnx
"""

import sys

import numpy as np
import onnx
from onnx import TensorProto

from graph import Graph

VIEWS = 3
# Tuned by hand on a few pictures against triangulated points; Gaussian widths in cells of the level.
SETTINGS = dict(
    planes=32, fine=7, step=0.3,      # planes over the range; fine planes and their distance in coarse steps
    norm4=1.5, norm2=2.5, eps=4e-4,   # window of the local normalisation; variance of sensor noise (range -1..1)
    small=2.0, large=5.0, large_share=0.6, fine_window=2.0,   # aggregation
    beta4=60.0, beta2=60.0,           # sharpness of the soft-argmax
    pooled=lambda sigma: 2 if sigma >= 2 else 1,   # cells whose mean a window sees
    best=0.3,                         # share of the better source against the mean of both
    seen=4,                           # coarse planes of which one says where a source looks; of the fine ones one says it for all
)


def build(p=None):
    P = dict(SETTINGS, **(p or {}))
    g = Graph()
    S = VIEWS - 1
    shape = g.op("Shape", "images")
    H, W = g.pick(shape, 3), g.pick(shape, 4)
    def sized(div):
        return (g.op("Div", H, np.int64(div)), g.op("Div", W, np.int64(div)))
    H4, W4 = sized(4)
    H2, W2 = sized(2)

    def vec(*parts):
        return g.concat(*[g.reshape(x, [1]) if isinstance(x, str) else g.const(np.array([x], np.int64)) for x in parts])

    def window(n, cells, sigma, pooled):
        """Row-normalised Gaussian windows of n cells over `cells` blocks of `pooled` of them: [n, cells]. A block's cells weigh the same,
        which adds its own spread to the Gaussian's."""
        i = g.arange(n)
        j = g.add(g.mul(g.arange(cells), np.float32(pooled)), np.float32((pooled - 1) / 2))
        d = g.sub(g.unsqueeze(i, 1), g.unsqueeze(j, 0))
        # Cut at four deviations: products with the denormal numbers of a full tail cost a hundred times a plain one.
        near = g.cast(g.op("Less", g.op("Abs", d), np.float32(4 * sigma)), TensorProto.FLOAT)
        spread = sigma**2 - (pooled**2 - 1) / 12
        e = g.mul(near, g.op("Exp", g.mul(g.mul(d, d), np.float32(-0.5 / spread))))
        return g.div(e, g.total(e, 1))

    windows = {}
    def blur(x, level, sigma, weight=1.0):
        """x [N, h, w]; `weight` multiplies the result, at the price of nothing. Windows this smooth need not see single cells: means of
        blocks of about a deviation give the same to a few percent, for a fraction of the products."""
        pooled = P["pooled"](sigma)
        key = (level, sigma, weight)
        if key not in windows:
            h, w = {4: (H4, W4), 2: (H2, W2)}[level]
            ph, pw = (g.op("Div", g.op("Add", n, np.int64(pooled - 1)), np.int64(pooled)) for n in (h, w))
            by = window(h, ph, sigma, pooled)
            windows[key] = (by if weight == 1.0 else g.mul(by, np.float32(weight)), g.op("Transpose", window(w, pw, sigma, pooled), perm=[1, 0]))
        by, bx = windows[key]
        if pooled > 1:
            blocks = g.op("AveragePool", g.unsqueeze(x, 1), kernel_shape=[pooled, pooled], strides=[pooled, pooled], ceil_mode=1)
            x = g.op("Squeeze", blocks, np.array([1], np.int64))
        return g.matmul(by, g.matmul(x, bx))

    # Luminance pyramid, [V, h, w].
    flat = g.reshape("images", vec(VIEWS, 3, -1))
    grey = g.reshape(g.matmul(np.array([[0.299, 0.587, 0.114]], np.float32), flat), vec(VIEWS, 1, H, W))
    half4 = g.op("AveragePool", grey, kernel_shape=[2, 2], strides=[2, 2])
    quarter4 = g.op("AveragePool", half4, kernel_shape=[2, 2], strides=[2, 2])

    def normalise(x, level, sigma):
        h, w = {4: (H4, W4), 2: (H2, W2)}[level]
        x = g.reshape(x, vec(VIEWS, h, w))
        mean = blur(x, level, sigma)
        centred = g.sub(x, mean)
        variance = blur(g.mul(centred, centred), level, sigma)
        return g.div(centred, g.op("Sqrt", g.add(variance, np.float32(P["eps"]))))

    f4 = normalise(quarter4, 4, P["norm4"])
    f2 = normalise(half4, 2, P["norm2"])

    def finer(f, level):
        """Source features at twice the resolution, flat: [S, h*w]."""
        h, w = {4: (H4, W4), 2: (H2, W2)}[level]
        src = g.op("Slice", f, np.array([1], np.int64), np.array([VIEWS], np.int64), np.array([0], np.int64))
        up = g.op("Resize", g.reshape(src, vec(S, 1, h, w)), "", np.array([1, 1, 2, 2], np.float32), mode="linear",
                  coordinate_transformation_mode="half_pixel")
        # Nothing marks what lies outside; within, where there is no texture, a feature is next to nothing.
        rimmed = g.op("Pad", g.add(up, np.float32(1e-9)), np.array([0, 0, 1, 1, 0, 0, 1, 1], np.int64))
        return g.reshape(rimmed, vec(S, -1))

    def pixels(h, w, div):
        """Full-size pixel coordinates (centres at integers) of a level's cells: x [1, w], y [h, 1]."""
        off = (div - 1) / 2
        x = g.add(g.mul(g.arange(w), np.float32(div)), np.float32(off))
        y = g.add(g.mul(g.arange(h), np.float32(div)), np.float32(off))
        return g.unsqueeze(x, 0), g.unsqueeze(y, 1)

    def sweep(level, s, ref, source, center, offsets, seen):
        """Product of reference and warped source feature, [D,h,w], for inverse depths center + offsets, [h,w] or nothing and [D,1,1], and
        for every `seen` planes whether the source looks there at the middle one, [D/seen,1,h,w]."""
        h, w = {4: (H4, W4), 2: (H2, W2)}[level]
        fh, fw = {4: (H2, W2), 2: (H, W)}[level]
        scale = level // 2
        x, y = pixels(h, w, level)
        # Finer map: centre of index k at full-size coordinate scale*k + (scale-1)/2; rounding = floor(. + 1/2), and one more for the rim.
        # Both are affine in the projection's rows, where they cost one small matrix product and not two passes over the volume.
        gain, offset = (0.5, 1.25) if scale == 2 else (1.0, 1.5)
        to_index = np.array([[gain, 0, offset, 0], [0, gain, offset, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float32)
        projection = g.matmul(to_index, g.pick("rel_proj", s))
        def entry(r, c):
            return g.pick(g.pick(projection, r), c)
        rows = []
        for r in range(3):
            base = g.add(g.add(g.mul(x, entry(r, 0)), g.mul(y, entry(r, 1))), entry(r, 2))
            if center is not None:
                base = g.add(base, g.mul(center, entry(r, 3)))
            rows.append(g.add(base, g.mul(offsets, entry(r, 3))))
        z = g.op("Reciprocal", g.op("Max", rows[2], np.float32(1e-6)))
        fwf, fhf = g.cast(fw, TensorProto.FLOAT), g.cast(fh, TensorProto.FLOAT)
        # The rim is outside. What is cut off of the column beyond it is cut off of the index.
        column = g.op("Clip", g.mul(rows[0], z), np.float32(0), g.add(fwf, np.float32(1.25)))
        line = g.op("Floor", g.op("Clip", g.mul(rows[1], z), np.float32(0), g.add(fhf, np.float32(1.25))))
        at = g.cast(g.add(g.mul(line, g.add(fwf, np.float32(2))), column), TensorProto.INT32)
        # GatherElements on flat arrays: a typed loop, where Gather copies every float by itself (three times slower).
        warped = g.op("GatherElements", g.pick(source, s), g.reshape(at, [-1]), axis=0)
        warped = g.reshape(warped, vec(-1, h, w))
        grouped = g.reshape(warped, vec(-1, np.int64(seen), h, w))
        middle = g.op("Slice", grouped, np.array([seen // 2], np.int64), np.array([seen // 2 + 1], np.int64), np.array([1], np.int64))
        return g.mul(ref, warped), g.cast(g.cast(middle, TensorProto.BOOL), TensorProto.FLOAT)

    near, far = g.pick("depth_range", 0), g.pick("depth_range", 1)
    wmax, wmin = g.op("Reciprocal", near), g.op("Reciprocal", far)
    D = P["planes"]
    t = np.linspace(0, 1, D).astype(np.float32)
    dw = g.div(g.sub(wmax, wmin), np.float32(D - 1))
    planes = g.reshape(g.add(wmin, g.mul(g.sub(wmax, wmin), t)), [D, 1, 1])

    def correlate(level, center, offsets, seen, small, large, large_share, beta):
        """`beta` times the correlation, plus `beta` where a source looks: where none does is worse than any match."""
        f = {4: f4, 2: f2}[level]
        src = finer(f, level)
        ref = g.unsqueeze(g.pick(f, 0), 0)
        best = beta * P["best"]
        scores = []
        for s in range(S):
            c, v = sweep(level, s, ref, src, center, offsets, seen)
            a = blur(c, level, small, best * (1 - large_share))
            if large_share > 0:
                a = g.add(a, blur(c, level, large, best * large_share))
            # Where a source does not look, it has no opinion.
            scores.append((g.reshape(a, vec(-1, np.int64(seen), *sized(level))), v))
        (a, va), (b, vb) = scores
        # Partly mean, partly best: a source that is occluded there must not veto.
        look = g.add(va, vb)
        share = g.op("Div", np.float32(1 / P["best"] - 1), g.op("Max", look, np.float32(1)))
        mean = g.add(g.mul(a, g.mul(va, share)), g.mul(b, g.mul(vb, share)))
        looked = g.op("Clip", g.mul(look, np.float32(beta)), np.float32(0), np.float32(beta))
        return g.reshape(g.add(g.add(mean, g.op("Max", a, b)), looked), vec(-1, *sized(level)))

    def soft_argmax(score, values, beta):
        """The values' mean by exp(score), and the greatest correlation."""
        top = g.maximum(score, 0)
        e = g.op("Exp", g.sub(score, top))
        mass = g.total(e, 0)
        value = g.div(g.total(g.mul(e, values), 0), mass)
        return value, g.sub(g.mul(top, np.float32(1 / beta)), np.float32(1))

    score4 = correlate(4, None, planes, P["seen"], P["small"], P["large"], P["large_share"], P["beta4"])
    w4, top4 = soft_argmax(score4, planes, P["beta4"])            # [1,h4,w4]

    def doubled(x):
        return g.op("Resize", g.unsqueeze(x, 0), "", np.array([1, 1, 2, 2], np.float32), mode="linear",
                    coordinate_transformation_mode="half_pixel")

    w2 = g.op("Squeeze", doubled(w4), np.array([0], np.int64))       # [1,h2,w2]
    F = P["fine"]
    offs = ((np.arange(F) - F // 2) * P["step"]).astype(np.float32).reshape(F, 1, 1)
    # Nowhere beyond twice the farthest depth.
    nearest = g.add(g.mul(wmin, np.float32(0.5)), g.mul(dw, np.float32(-offs.min())))
    center, around = g.op("Max", w2, nearest), g.mul(offs, dw)
    score2 = correlate(2, center, around, F, P["fine_window"], None, 0, P["beta2"])
    beyond, top2 = soft_argmax(score2, around, P["beta2"])
    wf = g.add(center, beyond)

    conf4 = g.op("Squeeze", doubled(top4), np.array([0], np.int64))
    # Correlation at both levels: below 0.1 is chance, above 0.8 certain.
    both = g.add(g.mul(top2, np.float32(0.5)), g.mul(conf4, np.float32(0.5)))
    conf2 = g.clip(g.mul(g.sub(both, np.float32(0.1)), np.float32(1 / 0.7)), 0, 1)
    g.nodes.append(onnx.helper.make_node("Reciprocal", [doubled(wf)], ["depth"]))
    g.nodes.append(onnx.helper.make_node("Identity", [doubled(conf2)], ["conf"]))
    # k_ref is part of the contract; a sweep needs only rel_proj.
    return g.model(
        "plane_sweep",
        [("images", [1, VIEWS, 3, "h", "w"]), ("rel_proj", [S, 4, 4]), ("depth_range", [2]), ("k_ref", [3, 3])],
        [("depth", [1, 1, "h", "w"]), ("conf", [1, 1, "h", "w"])],
        "Posed plane sweep without learned weights; see networks/build/plane_sweep.py")


if __name__ == "__main__":
    model = build()
    onnx.checker.check_model(model)
    onnx.save(model, sys.argv[1])
