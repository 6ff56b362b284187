#!/usr/bin/env python3
"""Reads an exact `.dgtr` model with numpy; `models/FORMATS.md` describes the file.

    model = dgtr.read("model.dgtr")
    model.means          # (N, 3) float32, metres East-North-Up around model.origin
    model.log_scales     # (N, 3), natural logarithms of metres
    model.rotations      # (N, 4), quaternions w x y z
    model.logits         # (N,), logits of the opacities
    model.sh             # (N, D, 3), D = (degree + 1)^2, red green blue

The checksum is not verified here. A delivered model (version 4) is entropy-coded: `dgtr export MODEL --to ply` makes it readable elsewhere.
"""
import struct
import sys
from types import SimpleNamespace

import numpy as np

MAGIC = b"dgtr\r\n\x1a\n"
FIXED = struct.Struct("<8sIIQI")
HASH_BYTES = 32


class Header:
    """The fields of a postcard header that come first: varints, length-prefixed strings, little-endian f64."""

    def __init__(self, data):
        self.data, self.at = data, 0

    def varint(self):
        value = shift = 0
        while True:
            byte = self.data[self.at]
            self.at, value, shift = self.at + 1, value | (byte & 0x7F) << shift, shift + 7
            if byte < 0x80:
                return value

    def string(self):
        length = self.varint()
        self.at += length
        return self.data[self.at - length : self.at].decode()

    def floats(self, count):
        self.at += 8 * count
        return struct.unpack_from(f"<{count}d", self.data, self.at - 8 * count)


def read(path):
    """Returns the model at `path`; raises ValueError for what is no exact model or is cut short."""
    with open(path, "rb") as file:
        data = file.read()
    if len(data) < FIXED.size or data[:8] != MAGIC:
        raise ValueError(f"{path}: not a .dgtr model")
    _, version, header_bytes, count, degree = FIXED.unpack_from(data)
    if version != 1:
        raise ValueError(f"{path}: version {version}, not 1: write an exact model with `dgtr export --to ply`")
    coefficients = (degree + 1) ** 2
    widths = (3, 3, 4, 1, 3 * coefficients)
    if len(data) != FIXED.size + header_bytes + 4 * count * sum(widths) + HASH_BYTES:
        raise ValueError(f"{path}: {len(data)} bytes do not hold {count} Gaussians of degree {degree}")
    header = Header(data[FIXED.size : FIXED.size + header_bytes])
    mission, aircraft = header.string(), header.string()
    origin = header.floats(3) if header.varint() else None
    region = np.array(header.floats(2 * header.varint())).reshape(-1, 2)
    floats = np.frombuffer(data, "<f4", count * sum(widths), FIXED.size + header_bytes)
    means, log_scales, rotations, logits, sh = np.split(floats, np.cumsum(widths)[:-1] * count)
    return SimpleNamespace(
        mission=mission, aircraft=aircraft, origin=origin, region=region, degree=degree,
        means=means.reshape(-1, 3), log_scales=log_scales.reshape(-1, 3), rotations=rotations.reshape(-1, 4),
        logits=logits, sh=sh.reshape(-1, coefficients, 3),
    )


if __name__ == "__main__":
    for name in sys.argv[1:]:
        model = read(name)
        print(f"{name}: {len(model.means)} Gaussians of degree {model.degree}, origin {model.origin}")
