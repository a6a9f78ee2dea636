"""A slow, readable twin of the soft splat, in NumPy and float64."""

from __future__ import annotations

from itertools import product

import numpy as np

from jaxmap.types import GridSpec


def shares(grid: GridSpec, point: np.ndarray, axes: tuple[int, ...]) -> dict[tuple[int, ...], float]:
    """How a point of the grid is shared out among cells, by their indices along the axes."""
    origin, size = np.asarray(grid.origin_m, np.float64), np.asarray(grid.voxel_size_m, np.float64)
    found: dict[tuple[int, ...], float] = {}
    for sides in product((0, 1), repeat=len(axes)):
        cell, share = [], 1.0
        for axis, side in zip(axes, sides, strict=True):
            scaled = (point[axis] - origin[axis]) / size[axis] - 0.5
            below = int(np.floor(scaled))
            share *= 1 - abs(scaled - (below + side))
            # What would fall outside goes to the outer cell.
            cell.append(min(max(below + side, 0), grid.shape[axis] - 1))
        found[tuple(cell)] = found.get(tuple(cell), 0.0) + share
    return found


def splat(grid: GridSpec, points, values, keep, axes: tuple[int, ...]) -> np.ndarray:
    """Sums of values in cells; one row for each channel."""
    points, values = np.asarray(points, np.float64), np.asarray(values, np.float64)
    lower = np.asarray(grid.origin_m, np.float64)
    upper = lower + np.asarray(grid.voxel_size_m, np.float64) * grid.shape
    total = np.zeros((len(values), *(grid.shape[axis] for axis in axes)))
    for index, point in enumerate(points):
        if not (keep[index] and np.isfinite(point).all() and np.isfinite(values[:, index]).all()):
            continue
        if ((point < lower) | (point >= upper)).any():
            continue
        for cell, share in shares(grid, point, axes).items():
            total[(slice(None), *cell)] += share * values[:, index]
    return total
