"""Occupied voxels as a PLY point cloud."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np

from jaxmap.export.voxels import OccupiedVoxels
from jaxmap.host.files import atomic_path
from jaxmap.labels import IGNORE, class_colours

_PLY_TYPES = {"f8": "double", "f4": "float", "u1": "uchar"}


def write_ply(
    path: str | os.PathLike[str], voxels: OccupiedVoxels, classes: Sequence[str], site_origin: np.ndarray
) -> None:
    """Writes voxel centres with colour, label and probability, binary little-endian.

    Coordinates are metres, x east, y north, z up. A `site_origin` that is not zero is added to them,
    and they are then doubles; otherwise they are floats.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    site_origin = np.asarray(site_origin, np.float64)
    real = "<f8" if site_origin.any() else "<f4"
    fields = [(axis, real) for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue", "label")]
    vertices = np.empty(len(voxels.label), np.dtype([*fields, ("probability", "<f4")]))
    for axis, name in enumerate("xyz"):
        vertices[name] = voxels.centres_world[:, axis].astype(np.float64) + site_origin[axis]
    colours = class_colours(classes)[voxels.label]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = colours[:, channel]
    vertices["label"], vertices["probability"] = voxels.label, voxels.probability
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        stream.write(_header(vertices, voxels, classes, site_origin))
        stream.write(vertices.tobytes())


def _header(vertices: np.ndarray, voxels: OccupiedVoxels, classes: Sequence[str], site_origin: np.ndarray) -> bytes:
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment jaxmap: centres of occupied voxels, metres, x east y north z up",
        f"comment voxel_size_m {' '.join(map(str, voxels.voxel_size_m))}",
        f"comment site_origin {' '.join(map(str, site_origin.tolist()))} (already added)",
        *(f"comment class {index} {' '.join(name.split())}" for index, name in enumerate(classes)),
        f"comment class {IGNORE} without a label",
        f"element vertex {len(vertices)}",
        *(f"property {_PLY_TYPES[vertices.dtype[name].str[1:]]} {name}" for name in vertices.dtype.names or ()),
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode("ascii", "backslashreplace")
