"""Free space by casting rays, as OctoMap does: the other way to find what projective carving finds."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from reference import f64, scaled_points


class Cast(NamedTuple):
    """What the rays of one frame say, each bool (X, Y, Z): voxels that hold a point, and those only crossed."""

    hit: np.ndarray
    free: np.ndarray


def walk(grid, origin_world, points_world) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Follows rays from voxel to voxel up to, but not into, that of their point (Amanatides and Woo 1987).

    All rays take their steps together.

    Yields:
        The rays that are still under way, and the index of the voxel that each is in, within the grid or not.
    """
    start = scaled_points(grid, np.asarray(origin_world))
    way = scaled_points(grid, points_world) - start
    index = np.tile(np.floor(start), (len(way), 1)).astype(int)
    last = np.floor(start + way).astype(int)
    step = np.sign(way).astype(int)
    with np.errstate(divide="ignore", invalid="ignore"):
        # As shares of the way: when the next face of each axis is reached, and from one face to the next.
        reached = np.where(step != 0, (index + (step > 0) - start) / way, np.inf)
        between = np.where(step != 0, 1 / np.abs(way), np.inf)
    rays = np.arange(len(way))
    while True:
        # A ray that grazes the edge of its last voxel may pass it by: it ends with its length.
        rays = rays[(index[rays] != last[rays]).any(axis=1) & (reached[rays].min(axis=1) <= 1)]
        if not len(rays):
            return
        yield rays, index[rays]
        axis = reached[rays].argmin(axis=1)
        index[rays, axis] += step[rays, axis]
        reached[rays, axis] += between[rays, axis]


def cast_rays(grid, origin_world, points_world) -> Cast:
    """One frame: a voxel that is hit and crossed counts as hit."""
    crossed, hit = np.zeros(grid.shape, bool), np.zeros(grid.shape, bool)
    for _, index in walk(grid, origin_world, points_world):
        crossed[_inside(index, grid)] = True
    hit[_inside(np.floor(scaled_points(grid, f64(points_world))).astype(int), grid)] = True
    return Cast(hit, crossed & ~hit)


def _inside(index: np.ndarray, grid) -> tuple[np.ndarray, ...]:
    return tuple(index[((index >= 0) & (index < np.array(grid.shape))).all(axis=1)].T)
