"""Ground truth in cells: how much of each cell's labelled area is of the class, and how the truth is registered."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8

from jaxmap.datasets.crs import transform_between
from jaxmap.datasets.label_raster import TARGET, UNLABELLED, LabelRaster, sample_nearest
from jaxmap.evaluation.cells import CellGrid

_LEAST_SAMPLES, _MOST_SAMPLES = 16, 64
_CHUNK_SAMPLES = 2**21
_MOST_IN_ALL = 2**27
_SNAP = 1e-9

MAX_SHIFT_M, MAX_HEADING_RAD = 0.5, float(np.deg2rad(2.0))
_SHIFT_STEPS, _HEADING_STEPS, _REFINEMENTS = 4, 2, 4
_LEAST_GAIN = 1e-6


@dataclass(frozen=True)
class Alignment:
    """A small rigid motion of the ground truth over the map: turned about a pivot, then shifted.

    `heading_rad` turns counter-clockwise about z; shift and pivot are x and y, world, metres.
    """

    shift_m: tuple[float, float] = (0.0, 0.0)
    heading_rad: float = 0.0
    pivot_m: tuple[float, float] = (0.0, 0.0)

    def undone(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The points of the unmoved truth that lie at points of the map."""
        dx, dy = x - self.shift_m[0] - self.pivot_m[0], y - self.shift_m[1] - self.pivot_m[1]
        cos, sin = np.cos(self.heading_rad), np.sin(self.heading_rad)
        return self.pivot_m[0] + cos * dx + sin * dy, self.pivot_m[1] - sin * dx + cos * dy


class TruthCells(NamedTuple):
    """The ground truth in cells.

    `fine` holds `per_cell` x `per_cell` samples of each cell (`LabelRaster`'s codes, x first); `share` is that of the
    class in the labelled ones, 0 where there is none; `labelled` cells have some.
    """

    share: Float64[np.ndarray, "I J"]
    labelled: Bool[np.ndarray, "I J"]
    fine: UInt8[np.ndarray, "FI FJ"]
    per_cell: int

    def truly(self, fraction: float = 0.5) -> Bool[np.ndarray, "I J"]:
        """Cells that are of the class: it covers at least `fraction` of their labelled area."""
        return self.labelled & (self.share >= fraction - _SNAP)


def truth_cells(
    raster: LabelRaster,
    cells: CellGrid,
    site_origin: Float64[np.ndarray, "3"] | None = None,
    crs: str | None = None,
    *,
    alignment: Alignment | None = None,
    per_cell: int | None = None,
) -> TruthCells:
    """Aggregates a raster of truth, of any coordinate system and affine transform, into cells.

    Each cell is sampled on a regular lattice, finer than the pixels where they are coarse: on pixels that fill cells
    in whole numbers the shares are exact. Between the corners of a cell coordinates are interpolated, which is exact
    for affine maps and off by micrometres for any projection.

    Args:
        raster: the truth.
        cells: in the world of the map.
        site_origin: where the world's origin lies in `crs`.
        crs: the map's system; None takes that of the raster.
        alignment: moves the truth first.
        per_cell: samples along each side of a cell; chosen by the size of the pixels by default.
    """
    corners = pixel_corners(raster.T_crs_pixel, raster.crs, cells, site_origin, crs, alignment)
    count = per_cell or _samples_per_cell(corners)
    fine = sample_between(raster.labels, corners, count)
    labelled = cell_counts(fine != UNLABELLED, count)
    target = cell_counts(fine == TARGET, count)
    return TruthCells(target / np.maximum(labelled, 1), labelled > 0, fine, count)


def cell_counts(fine: Bool[np.ndarray, "FI FJ"], per_cell: int) -> Float64[np.ndarray, "I J"]:
    """How many samples of each cell are true."""
    rows, columns = fine.shape[0] // per_cell, fine.shape[1] // per_cell
    return fine.reshape(rows, per_cell, columns, per_cell).sum(axis=(1, 3), dtype=np.int64).astype(np.float64)


def samples_of(cells: np.ndarray, per_cell: int) -> np.ndarray:
    """The value of each cell at each of its samples."""
    return cells.repeat(per_cell, axis=0).repeat(per_cell, axis=1)


class PixelCorners(NamedTuple):
    """Where the corners of cells lie in an image, in pixels (`[0, 1)` is the first)."""

    column: Float64[np.ndarray, "I1 J1"]
    row: Float64[np.ndarray, "I1 J1"]


def pixel_corners(
    T_crs_pixel: Float64[np.ndarray, "3 3"],
    image_crs: str | None,
    cells: CellGrid,
    site_origin: Float64[np.ndarray, "3"] | None,
    crs: str | None,
    alignment: Alignment | None = None,
) -> PixelCorners:
    """Finds the corners of cells in an image; the arguments are those of `truth_cells`.

    Raises:
        JaxmapError: no transformation between the two systems is known.
    """
    origin = np.zeros(2) if site_origin is None else np.asarray(site_origin, np.float64)[:2]
    x, y = np.meshgrid(*cells.corners(), indexing="ij")
    if alignment is not None:
        x, y = alignment.undone(x, y)
    x, y = transform_between(crs, image_crs, "ground truth")(x + origin[0], y + origin[1])
    T_pixel_crs = np.linalg.inv(T_crs_pixel)
    column, row = (T_pixel_crs[axis, 0] * x + T_pixel_crs[axis, 1] * y + T_pixel_crs[axis, 2] for axis in (0, 1))
    return PixelCorners(column, row)


def sample_between(image: UInt8[np.ndarray, "H W *c"], corners: PixelCorners, count: int) -> np.ndarray:
    """Samples an image `count` x `count` times between the corners of each cell; 0 outside it.

    Returns:
        uint8 (I * count, J * count, *c).
    """
    cells_x, cells_y = corners.row.shape[0] - 1, corners.row.shape[1] - 1
    fine = np.empty((cells_x * count, cells_y * count, *image.shape[2:]), np.uint8)
    step = max(1, _CHUNK_SAMPLES // (cells_y * count * count))
    for first in range(0, cells_x, step):
        last = min(first + step, cells_x)
        column, row = (_between(edges[first : last + 1], count) for edges in corners)
        fine[first * count : last * count] = sample_nearest(image, column, row)
    return fine


def _samples_per_cell(corners: PixelCorners) -> int:
    """At least 16 along a side, and a whole number for each pixel where pixels fill cells in whole numbers."""
    sides = np.hypot(*(np.diff(edges, axis=0) for edges in corners))
    sides = sides[np.isfinite(sides)]
    pixels = max(float(np.median(sides)), 1e-3) if sides.size else 1.0
    count = int(np.ceil(pixels * np.ceil(_LEAST_SAMPLES / pixels) - 1e-3))
    most = int(np.sqrt(_MOST_IN_ALL / corners.row.size))
    return max(1, min(count, _MOST_SAMPLES, max(most, 4)))


def _between(corners: np.ndarray, count: int) -> np.ndarray:
    """Bilinear interpolation between the corners of cells, at the centres of `count` x `count` parts of each."""
    part = (np.arange(count) + 0.5) / count
    with np.errstate(invalid="ignore"):
        along_x = corners[:-1, None] * (1 - part[:, None]) + corners[1:, None] * part[:, None]
        along_x = along_x.reshape(-1, corners.shape[1])
        both = along_x[:, :-1, None] * (1 - part) + along_x[:, 1:, None] * part
    return both.reshape(len(along_x), -1)


def soft_iou(
    map_share: Float[np.ndarray, "*s"], truth_share: Float[np.ndarray, "*s"], counted: Bool[np.ndarray, "*s"]
) -> float:
    """Intersection over union of shares of cells, `sum min / sum max` (Ruzicka 1958): IoU where they are 0 or 1.

    It changes with every sample of the truth, where the IoU of cells changes in steps.
    """
    low = np.minimum(map_share, truth_share)[counted].sum()
    high = np.maximum(map_share, truth_share)[counted].sum()
    return float(low / high) if high > 0 else 0.0


def register(overlap: Callable[[Alignment], float], pivot_m: tuple[float, float]) -> Alignment:
    """The motion of the truth, within +-0.5 m and +-2 degrees, at which it overlaps the map best; coarse to fine.

    A motion must gain: of equals the smallest is kept, and no motion at all before any other.

    Args:
        overlap: how well the truth fits the map when it is moved; the more the better.
        pivot_m: what the truth turns about: x and y, world.
    """
    best = np.zeros(3)
    best_overlap = overlap(Alignment(pivot_m=pivot_m))
    reach = np.array([MAX_SHIFT_M, MAX_SHIFT_M, MAX_HEADING_RAD])
    steps = np.array([_SHIFT_STEPS, _SHIFT_STEPS, _HEADING_STEPS])
    for level in range(_REFINEMENTS + 1):
        around = [range(-count, count + 1) for count in (steps if level == 0 else (1, 1, 1))]
        offsets = sorted(itertools.product(*around), key=lambda offset: float(np.square(offset).sum()))
        middle = best
        for offset in offsets[1:]:
            state = middle + np.array(offset) * reach / steps / 2**level
            if (np.abs(state) > reach + 1e-9).any():
                continue
            alignment = Alignment((float(state[0]), float(state[1])), float(state[2]), pivot_m)
            if (reached := overlap(alignment)) > best_overlap + _LEAST_GAIN:
                best, best_overlap = state, reached
    return Alignment((float(best[0]), float(best[1])), float(best[2]), pivot_m)
