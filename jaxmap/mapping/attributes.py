"""What is stored beside the voxels of a map, as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxmap.errors import JaxmapError
from jaxmap.types import MOST_VOXELS_ALONG, GridSpec, to_device

FORMAT_VERSION = 1

_MOST_FRAMES, _MOST_CLASSES = 2**31 - 1, 254
_VOXEL_M, _FARTHEST = (1e-6, 1e3), float(2**31)


@dataclass(frozen=True, eq=False)
class MapAttributes:
    """What a map folder holds beside the map itself.

    Attributes:
        crs: name of the coordinate reference system of `site_origin`, such as "EPSG:32631".
        site_origin: where the world's origin lies in that system, metres.
        T_world_source: turns the world of the poses' source into the map's z-up world.
        fusion: the parameters and the rule the map was fused with; JSON values only.
        progress: how far the run got; `{"complete": True}` once it has ended.
        layers: other layers of the top-down map, by name; NaN where nothing is known.
    """

    crs: str | None = None
    site_origin: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    T_world_source: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    fusion: dict[str, Any] = field(default_factory=dict)
    progress: dict[str, Any] = field(default_factory=lambda: {"complete": True})
    layers: dict[str, Float[np.ndarray, "X Y"]] = field(default_factory=dict)


def to_json(grid: GridSpec, classes: Sequence[str], frames_fused: int, attributes: MapAttributes) -> dict[str, Any]:
    """The attributes of the stored group."""
    # float32 numbers are exact as float64, and JSON keeps every digit of those.
    stored = {
        "format_version": FORMAT_VERSION,
        "classes": list(classes),
        "voxel_size_m": np.asarray(grid.voxel_size_m, np.float64).tolist(),
        "origin_m": np.asarray(grid.origin_m, np.float64).tolist(),
        "lattice_m": np.asarray(grid.lattice_m, np.float64).tolist(),
        "first_voxel": np.asarray(grid.first).tolist(),
        "shape": list(grid.shape),
        "crs": attributes.crs,
        "site_origin": np.asarray(attributes.site_origin, np.float64).tolist(),
        "T_world_source": np.asarray(attributes.T_world_source, np.float64).tolist(),
        "frames_fused": frames_fused,
        "fusion": attributes.fusion,
        "progress": attributes.progress,
        **({"layers": list(attributes.layers)} if attributes.layers else {}),
    }
    return json.loads(json.dumps(stored))


def from_json(stored: dict[str, Any], where: Path) -> tuple[GridSpec, tuple[str, ...], int, MapAttributes]:
    """Grid, classes, number of frames and the rest, of `to_json`; the layers are still empty.

    Raises:
        JaxmapError: an attribute is missing or damaged.
    """
    try:
        classes = stored["classes"]
        names = isinstance(classes, list) and all(isinstance(name, str) for name in classes)
        if not names or len(classes) > _MOST_CLASSES:
            raise bad_attribute("classes", classes, where)
        size_m = _numbers(stored, "voxel_size_m", (3,), where)
        shape = _numbers(stored, "shape", (3,), where)
        if not _within(size_m, *_VOXEL_M) or not _within(shape, 1, 2**31) or (shape % 1).any():
            raise bad_attribute("voxel_size_m or shape", [size_m.tolist(), shape.tolist()], where)
        # Maps of older versions have a lattice that begins at their corner.
        lattice, first = ("lattice_m", "first_voxel") if "first_voxel" in stored else ("origin_m", None)
        first_voxel = np.zeros(3) if first is None else _numbers(stored, first, (3,), where)
        if (first_voxel % 1).any() or not _within(first_voxel, -MOST_VOXELS_ALONG, MOST_VOXELS_ALONG):
            raise bad_attribute("first_voxel", first_voxel.tolist(), where)
        grid = GridSpec(
            lattice_m=to_device(_numbers(stored, lattice, (3,), where), np.float32),
            voxel_size_m=to_device(size_m, np.float32),
            shape=(int(shape[0]), int(shape[1]), int(shape[2])),
            first=to_device(first_voxel, np.int32),
        )
        frames_fused = _numbers(stored, "frames_fused", (), where)
        if not _within(frames_fused, 0, _MOST_FRAMES) or frames_fused % 1:
            raise bad_attribute("frames_fused", stored["frames_fused"], where)
        crs, fusion, progress = stored["crs"], stored["fusion"], stored.get("progress", {"complete": True})
        for name, value, kind in (("crs", crs, str | None), ("fusion", fusion, dict), ("progress", progress, dict)):
            if not isinstance(value, kind):
                raise bad_attribute(name, value, where)
        attributes = MapAttributes(
            crs=crs,
            site_origin=_numbers(stored, "site_origin", (3,), where),
            T_world_source=_numbers(stored, "T_world_source", (4, 4), where),
            fusion=fusion,
            progress=progress,
            layers=dict.fromkeys(_layer_names(stored, where), np.zeros((0, 0), np.float32)),
        )
        return grid, tuple(classes), int(frames_fused), attributes
    except KeyError as missing:
        raise JaxmapError(f"the attribute {missing} is missing", where=where, fix="make the map again") from missing


def _within(numbers: np.ndarray, least: float, most: float) -> bool:
    return bool(((numbers >= least) & (numbers <= most)).all())


def _layer_names(stored: dict[str, Any], where: Path) -> list[str]:
    names = stored.get("layers", [])
    if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
        raise bad_attribute("layers", names, where)
    return names


def _numbers(stored: dict[str, Any], name: str, shape: tuple[int, ...], where: Path) -> np.ndarray:
    value = stored[name]
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise bad_attribute(name, value, where) from error
    if numbers.shape != shape or not _within(numbers, -_FARTHEST, _FARTHEST):
        raise bad_attribute(name, value, where)
    return numbers


def bad_attribute(name: str, value: object, where: Path) -> JaxmapError:
    """An error for an attribute that cannot be."""
    return JaxmapError(f"the attribute {name} is {value!r:.100}", where=where, fix="make the map again")
