"""What other programs' readers make of `dgtr export`, as a PLY that `dgtr import` takes; see viewers.sh.
viewers.py glb IN.glb OUT.ply: by pygltflib.  viewers.py move IN.ply FILE.georef.json OUT.ply: into the model's own place."""
import json
import struct
import sys

import numpy as np


def write(path, names, columns):
    header = "ply\nformat binary_little_endian 1.0\nelement vertex %d\n" % len(columns[0])
    with open(path, "wb") as out:
        out.write((header + "".join("property float %s\n" % n for n in names) + "end_header\n").encode())
        out.write(np.stack(columns, 1).astype("<f4").tobytes())


def glb(source, target):
    from pygltflib import GLTF2

    file = GLTF2().load_binary(source)
    blob, primitive = file.binary_blob(), file.meshes[0].primitives[0]
    splats = primitive.extensions["KHR_gaussian_splatting"]
    assert primitive.mode == 0 and splats["kernel"] == "ellipse", splats
    # pygltflib's own attributes leave out names with a colon.
    with open(source, "rb") as whole:
        length = struct.unpack("<I", whole.read(16)[12:])[0]
        whole.seek(20)
        attributes = json.loads(whole.read(length))["meshes"][0]["primitives"][0]["attributes"]

    def column(name):
        accessor = file.accessors[attributes[name]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        start = file.bufferViews[accessor.bufferView].byteOffset
        return np.frombuffer(blob, "<f4", accessor.count * width, start).reshape(-1, width)

    own = "KHR_gaussian_splatting:"
    mean, turn, scale = column("POSITION"), column(own + "ROTATION"), np.log(column(own + "SCALE"))
    opacity = column(own + "OPACITY")[:, 0].astype("f8").clip(1e-7, 1 - 1e-7)
    names = [own + "SH_DEGREE_%d_COEF_%d" % (d, n) for d in range(4) for n in range(2 * d + 1)]
    sh = [column(n) for n in names if n in attributes]
    rest = [c[:, channel] for channel in range(3) for c in sh[1:]]
    labels = ["x", "y", "z"] + ["f_dc_%d" % i for i in range(3)] + ["f_rest_%d" % i for i in range(len(rest))]
    labels += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    x, y, z, w = turn.T
    write(target, labels, [*mean.T, *sh[0].T, *rest, np.log(opacity / (1 - opacity)), *scale.T, w, x, y, z])


def move(source, georef, target):
    with open(source, "rb") as file:
        header = []
        while not header or header[-1] != b"end_header\n":
            header.append(file.readline())
        names = [line.split()[2].decode() for line in header if line.startswith(b"property")]
        rows = np.frombuffer(file.read(), "<f4").reshape(-1, len(names)).copy()
    with open(georef) as file:
        rows[:, :3] += [row[3] for row in json.load(file)["to_enu"]]
    write(target, names, list(rows.T))


{"glb": glb, "move": move}[sys.argv[1]](*sys.argv[2:])
