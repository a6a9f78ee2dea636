"""Who is right where two maps differ: voxels held against the true heights of the ground."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int8

from jaxmap.datasets.crs import Extent, transform_between
from jaxmap.datasets.rasters import read_heights
from jaxmap.geometry.grid import exact_corner
from jaxmap.types import GridSpec

ABOVE, SURFACE, BELOW, NO_TRUTH = 0, 1, 2, -1
TRUTH_NAMES = ("above the ground", "holds its surface", "below it")

_SAMPLES = 5
"""Heights looked up along each side of a voxel."""


def true_voxels(
    path: Path, grid: GridSpec, site_origin: Float64[np.ndarray, "3"], crs: str | None
) -> Int8[np.ndarray, "X Y Z"]:
    """Whether each voxel lies above the true ground (rocks included), holds its surface, or lies below.

    Args:
        path: the digital elevation model.
        grid: of the map.
        site_origin: what the positions of the map are relative to.
        crs: the coordinate reference system of that.

    Raises:
        JaxmapError: the model cannot be read, or does not lie there.
    """
    origin_m, size_m = exact_corner(grid)
    low = origin_m[:2] + site_origin[:2]
    high = low + size_m[:2] * grid.shape[:2]
    raster = read_heights(path, Extent(low[0], low[1], high[0], high[1], crs))
    axes_m = (low[i] + (np.arange(grid.shape[i] * _SAMPLES) + 0.5) * size_m[i] / _SAMPLES for i in (0, 1))
    to_raster = transform_between(crs, raster.crs, "the heights")
    x, y = to_raster(*np.meshgrid(*axes_m, indexing="ij"))
    column, row, _ = np.einsum("ij,jxy->ixy", np.linalg.inv(raster.T_crs_pixel), np.stack([x, y, np.ones_like(x)]))
    column, row = np.floor(column).astype(int), np.floor(row).astype(int)
    rows, columns = raster.height_m.shape
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    height_m = np.where(inside, raster.height_m[row.clip(0, rows - 1), column.clip(0, columns - 1)], np.nan)
    cells = height_m.reshape(grid.shape[0], _SAMPLES, grid.shape[1], _SAMPLES) - site_origin[2]
    return _against(cells.min(axis=(1, 3)), cells.max(axis=(1, 3)), grid)


def _against(lowest_m: np.ndarray, highest_m: np.ndarray, grid: GridSpec) -> Int8[np.ndarray, "X Y Z"]:
    """Each voxel of a column against the lowest and highest ground in it."""
    origin_m, size_m = exact_corner(grid)
    bottom_m = origin_m[2] + np.arange(grid.shape[2]) * size_m[2]
    above = bottom_m > highest_m[..., None]
    below = bottom_m + size_m[2] < lowest_m[..., None]
    known = np.isfinite(lowest_m)[..., None]
    return np.where(known, np.where(above, ABOVE, np.where(below, BELOW, SURFACE)), NO_TRUTH).astype(np.int8)
