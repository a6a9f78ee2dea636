"""Occupied voxels as a PLY point cloud, block by block."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxmap.export.source import Source
from jaxmap.host.files import atomic_path
from jaxmap.labels import IGNORE

_TYPES = {"f8": "double", "f4": "float", "u1": "uchar"}
COUNT_DIGITS = 12


def write_ply(source: Source, path: Path) -> None:
    """Writes voxel centres with colour, label and probability, binary little-endian.

    Coordinates are metres, x east, y north, z up. A site origin that is not zero is added to them,
    and they are then doubles; otherwise they are floats.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    site_origin = source.site_origin
    real = "<f8" if site_origin.any() else "<f4"
    fields = [(axis, real) for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue", "label")]
    form = np.dtype([*fields, ("probability", "<f4")])
    comments = [
        "jaxmap: centres of occupied voxels, metres, x east y north z up",
        f"voxel_size_m {' '.join(map(str, np.asarray(source.reader.grid.voxel_size_m)))}",
        f"site_origin {' '.join(map(str, site_origin.tolist()))} (already added)",
        *(f"class {index} {' '.join(name.split())}" for index, name in enumerate(source.classes)),
        f"class {IGNORE} without a label",
    ]
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        stream.write(header([("vertex", 0, vertex_lines(form))], comments))
        count = 0
        for voxels in source.voxels():
            vertices = np.empty(len(voxels.label), form)
            for axis, name in enumerate("xyz"):
                vertices[name] = voxels.centres_world[:, axis].astype(np.float64) + site_origin[axis]
            colours = source.colours_of(voxels.centres_world, voxels.label)
            for channel, name in enumerate(("red", "green", "blue")):
                vertices[name] = colours[:, channel]
            vertices["label"], vertices["probability"] = voxels.label, voxels.probability
            stream.write(vertices.tobytes())
            count += len(vertices)
        stream.seek(0)
        stream.write(header([("vertex", count, vertex_lines(form))], comments))


def vertex_lines(form: np.dtype) -> list[str]:
    """The properties of an element that is stored as this structured type."""
    return [f"property {_TYPES[form[name].str[1:]]} {name}" for name in form.names or ()]


def header(elements: Sequence[tuple[str, int, Sequence[str]]], comments: Sequence[str]) -> bytes:
    """The header of a binary PLY of elements (name, number, properties), as long whatever their numbers.

    So it can be written anew once they are known.
    """
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    digits = sum(len(str(number)) for _, number, _ in elements)
    lines[2] += " " * (COUNT_DIGITS * len(elements) - digits)
    for name, number, properties in elements:
        lines += [f"element {name} {number}", *properties]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii", "backslashreplace")
