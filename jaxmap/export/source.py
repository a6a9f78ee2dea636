"""What an exporter is given: a map of any size, gone through block by block, and what the run knows beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Float64, Int, UInt8

from jaxmap.errors import JaxmapError
from jaxmap.export.voxels import OccupiedVoxels, occupied_voxels
from jaxmap.fusion.neighbours import kernel_margin
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams, stored_fusion
from jaxmap.fusion.query import TopDown, top_down
from jaxmap.geometry.grid import exact_corner
from jaxmap.labels import IGNORE, class_colours
from jaxmap.mapping.arrays import TILE
from jaxmap.mapping.store import MapReader

Colours = Callable[[Float[np.ndarray, "N 3"], UInt8[np.ndarray, "N"]], UInt8[np.ndarray, "N 3"]]
"""Colours of points, from where they are (world, relative to the site origin) and their labels."""


SURFACE = "surface_m"
"""The layer of a map that holds the height of the surface, more finely than the voxels."""


class TopDownPart(NamedTuple):
    """A part of the top-down map.

    Attributes:
        corner: where it begins in the whole grid.
        top: its columns, NumPy.
        layers: the map's other layers there; NaN where nothing is known.
        own: rows along x and y that are this part's alone; what is around them is other parts', too.
    """

    corner: tuple[int, int]
    top: TopDown
    layers: Mapping[str, Float[np.ndarray, "X Y"]]
    own: tuple[slice, slice]

    @property
    def height_m(self) -> Float[np.ndarray, "X Y"]:
        """Height of the surface where it was observed: that of the layer `SURFACE`, or else of the highest voxel."""
        surface = self.layers.get(SURFACE)
        height_m = np.asarray(self.top.height_m)
        return height_m if surface is None else np.where(self.top.observed & ~np.isnan(surface), surface, height_m)

    def moved(self, x: Int[np.ndarray, "N"], y: Int[np.ndarray, "N"], corner: tuple[int, int]) -> tuple[Any, Any]:
        """Indices of this part's cells in an array that begins at a corner of the grid."""
        return x + self.corner[0] - corner[0], y + self.corner[1] - corner[1]


class Camera(NamedTuple):
    """A rectified camera: focal lengths, principal point and size of its image, in pixels."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width_px: int
    height_px: int


class KeyFrame(NamedTuple):
    """A frame of which the run kept a picture.

    Attributes:
        timestamp_s: its time.
        T_world_camera: pose of the rectified left camera, relative to the site origin.
        camera: of the picture.
        image: the content of its file.
        form: `png` or `webp`.
    """

    timestamp_s: float
    T_world_camera: Float64[np.ndarray, "4 4"]
    camera: Camera
    image: bytes
    form: str


@dataclass(frozen=True)
class Track:
    """Where the rectified left camera was, relative to the site origin, and its key frames."""

    timestamps_s: Float64[np.ndarray, "N"] = field(default_factory=lambda: np.zeros(0))
    T_world_camera: Float64[np.ndarray, "N 4 4"] = field(default_factory=lambda: np.zeros((0, 4, 4)))
    key_frames: Sequence[KeyFrame] = ()

    @property
    def quaternions(self) -> Float64[np.ndarray, "N 4"]:
        """The rotations of the poses as x, y, z, w."""
        from scipy.spatial.transform import Rotation

        rotations = self.T_world_camera[:, :3, :3]
        return Rotation.from_matrix(rotations).as_quat(canonical=True) if len(rotations) else np.zeros((0, 4))


@dataclass(frozen=True, eq=False)
class Source:
    """A map to be written in another form. Exporters go through `voxels` or `parts` and never hold it whole.

    Attributes:
        reader: the map.
        where: its path, for messages.
        track: of the camera; empty where the run has lost it.
        colours: of points; by class where it is None.
        notify: takes lines for the user.
    """

    reader: MapReader
    where: object = "map"
    track: Track = field(default_factory=Track)
    colours: Colours | None = None
    notify: Callable[[str], None] = lambda line: None

    @property
    def classes(self) -> tuple[str, ...]:
        """Those of the map."""
        return self.reader.classes

    @property
    def site_origin(self) -> Float64[np.ndarray, "3"]:
        """What is added to coordinates for those of the map's coordinate reference system, metres."""
        return np.asarray(self.reader.attributes.site_origin, np.float64)

    @cached_property
    def fusion(self) -> tuple[FusionParams, FusionRule]:
        """How the map is read."""
        return stored_fusion(self.reader.attributes.fusion, self.classes, self.where)

    @cached_property
    def corner_m(self) -> Float64[np.ndarray, "3"]:
        """Lower corner of the grid, relative to the site origin."""
        return exact_corner(self.reader.grid)[0]

    @cached_property
    def size_m(self) -> Float64[np.ndarray, "3"]:
        """Edges of a voxel."""
        return exact_corner(self.reader.grid)[1]

    @cached_property
    def target(self) -> int | None:
        """The class that cells are asked about first (rock), as an index; None where the map has none."""
        name = self.fusion[1].target(self.classes)
        return None if name is None else self.classes.index(name)

    def square_cells(self, form: str) -> float:
        """The edge of a column along x and y, for forms that know but one.

        Raises:
            JaxmapError: they differ.
        """
        x_m, y_m, z_m = self.size_m.tolist()
        if abs(x_m - y_m) > 1e-6 * x_m:
            raise JaxmapError(
                f"{form} has square cells, the columns of the map are {x_m:g} x {y_m:g} m",
                where=self.where,
                fix=f"map with --grid.voxel-size-m {x_m:g} {x_m:g} {z_m:g}",
            )
        return x_m

    def colours_of(self, points_world: Float[np.ndarray, "N 3"], label: UInt8[np.ndarray, "N"]) -> np.ndarray:
        """uint8 (N, 3), RGB."""
        return class_colours(self.classes)[label] if self.colours is None else self.colours(points_world, label)

    def voxels(self) -> Iterator[OccupiedVoxels]:
        """The occupied voxels, block by block; indices are those of the whole grid."""
        params, rule = self.fusion
        margin = kernel_margin(params.class_kernel)
        for voxel_map, own, corner in self.reader.blocks(margin):
            voxels = occupied_voxels(voxel_map, params, rule)
            sides = [side.indices(size)[:2] for side, size in zip(own, voxel_map.grid.shape[:2], strict=True)]
            low, high = np.array(sides).T
            at = voxels.index[:, :2]
            keep = ((at >= low) & (at < high)).all(axis=-1)
            if keep.any():
                index = voxels.index + np.array([*(corner - low), 0], np.int32)
                # In the order of the tiles: a map in memory is written as it is from disk.
                tile = index[:, :2] // TILE[:2]
                order = np.lexsort((tile[:, 1], tile[:, 0]))
                order = order[keep[order]]
                centres, label, probability = (leaf[order] for leaf in voxels[1:4])
                yield OccupiedVoxels(index[order], centres, label, probability, voxels.voxel_size_m)

    def parts(self, margin: int = 0) -> Iterator[TopDownPart]:
        """The top-down map, block by block, with as many columns around each as there are."""
        params, rule = self.fusion
        reach = kernel_margin(params.class_kernel)
        for voxel_map, own, corner in self.reader.blocks(margin + reach):
            top: TopDown = jax.tree.map(np.asarray, top_down(voxel_map, params, rule))
            sides = [side.indices(size)[:2] for side, size in zip(own, top.observed.shape, strict=True)]
            lows = [max(low - margin, 0) for low, _ in sides]
            part = tuple(slice(low, high + margin) for low, (_, high) in zip(lows, sides, strict=True))
            top = TopDown(top.probability[:, *part], *(leaf[part] for leaf in top[1:]))
            x, y = (start - (side[0] - low) for start, side, low in zip(corner, sides, lows, strict=True))
            width, depth = top.observed.shape
            place = (slice(x, x + width), slice(y, y + depth))
            layers = self.reader.layers(place)
            inner = tuple(slice(low - a, high - a) for a, (low, high) in zip(lows, sides, strict=True))
            yield TopDownPart((x, y), top, layers, (inner[0], inner[1]))

    def observed_box(self, most_cells: int, form: str) -> tuple[tuple[int, int], tuple[int, int]] | None:
        """Corner and size of the observed part of the top-down map, in columns; None where nothing was observed.

        Args:
            most_cells: that a form holds.
            form: its name, for the message.

        Raises:
            JaxmapError: it has more cells.
        """
        low, high = np.full(2, 2**62), np.zeros(2, np.int64)
        for corner, top, *_ in self.parts():
            if len(cells := np.argwhere(top.observed)):
                low, high = np.minimum(low, cells.min(0) + corner), np.maximum(high, cells.max(0) + 1 + corner)
        if (high <= low).any():
            return None
        (x, y), (width, depth) = low.tolist(), (high - low).tolist()
        if width * depth > most_cells:
            raise JaxmapError(
                f"{width} x {depth} cells are more than the {most_cells:,} that one map of {form} holds",
                where=self.where,
                fix="map with larger voxels, or within --grid.lower-m and --grid.upper-m",
            )
        return (x, y), (width, depth)

    def whole(self, most_cells: int, form: str) -> TopDownPart | None:
        """The observed part of the top-down map as one, for forms that are one array; see `observed_box`."""
        box = self.observed_box(most_cells, form)
        if box is None:
            return None
        corner, (width, depth) = box
        whole: Any = unknown_top(len(self.classes), (width, depth))
        layers = {name: np.full((width, depth), np.nan, np.float32) for name in self.reader.attributes.layers}
        for part in self.parts():
            x, y = np.argwhere(part.top.observed).T
            to = part.moved(x, y, corner)
            whole.probability[:, *to] = part.top.probability[:, x, y]
            for into, values in zip(whole[1:], part.top[1:], strict=True):
                into[to] = values[x, y]
            for name, values in part.layers.items():
                layers[name][to] = values[x, y]
        return TopDownPart(corner, whole, layers, (slice(0, width), slice(0, depth)))

    def nothing_observed(self, form: str) -> JaxmapError:
        """The error of a form that needs something."""
        return JaxmapError(
            f"nothing was observed: there is no map of {form}", where=self.where, fix="see the notes of its report"
        )


def unknown_top(classes: int, shape: tuple[int, int]) -> TopDown:
    """A top-down map of which nothing is known yet, NumPy."""
    probability: Any = np.full((classes, *shape), np.nan, np.float32)
    label: Any = np.full(shape, IGNORE, np.uint8)
    height_m: Any = np.full(shape, np.nan, np.float32)
    observed: Any = np.zeros(shape, bool)
    return TopDown(probability, label, height_m, observed)


def absolute(layers: Mapping[str, Float[np.ndarray, "X Y"]], site_z_m: float) -> dict[str, Float[np.ndarray, "X Y"]]:
    """The layers of a map with heights in the coordinate reference system of its site."""
    return {name: values + site_z_m if name == SURFACE else values for name, values in layers.items()}


def stamp_ns(time_s: float) -> int:
    """A time in whole nanoseconds, as logs count them.

    Raises:
        JaxmapError: it is negative, which a log cannot hold.
    """
    if time_s < 0:
        raise JaxmapError(f"a frame has the time {time_s:g} s, logs begin at 0", fix="give times from 0 on")
    return round(time_s * 1e9)


def optional(module: str, package: str, what: str) -> ModuleType:
    """Imports a library that not every installation has.

    Raises:
        JaxmapError: it is missing.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise JaxmapError(
            f"{what} needs the package {package}, which is not installed", fix="pip install 'jaxmap[formats]'"
        ) from error
