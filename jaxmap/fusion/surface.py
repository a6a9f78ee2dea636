"""The height of the surface in each column, finer than voxels: statistics of its points, fused beside the map.

A voxel says no more of a height than its own edge. What each column keeps is what rovers keep of the cells of their
maps (Goldberg, Maimone and Matthies 2002, "Stereo vision and rover navigation software for planetary exploration"):
how many points there were, and the mean of their heights and the scatter about it. They add up over frames, maps and
processes like all evidence, by the formulas of Chan, Golub and LeVeque (1983, "Algorithms for computing the sample
variance"), which lose no digits however high the ground lies.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmap.fusion.params import FusionParams
from jaxmap.fusion.query import occupied
from jaxmap.geometry.cloud import PointCloud
from jaxmap.geometry.grid import flat_voxel_index
from jaxmap.types import GridSpec, VoxelMap

POSE_SIGMA_M = 0.01
"""Heights of the camera are no better than this, however many pixels there are."""
_SHARED_PIXELS = 25.0
"""Neighbours that were matched together err together: a block of five by five counts as one."""
_FEWEST_POINTS = 2.0
_LEAST_WEIGHT = 1e-12


AnyArray = Array | np.ndarray
"""Of JAX or of NumPy."""


class Surface(NamedTuple):
    """Heights of the surface, world z, and their standard deviations; both mean nothing where not `known`."""

    height_m: Float[AnyArray, "X Y"]
    sigma_m: Float[AnyArray, "X Y"]
    known: Bool[AnyArray, "X Y"]


def height_sigma(cloud: PointCloud, camera_z_m: Float[Array, ""]) -> Float[Array, "N"]:
    """Standard deviation of the height of each point: an error of depth moves it along its ray."""
    fall = jnp.abs(cloud.points_world[:, 2] - camera_z_m) / cloud.depth_m.reshape(-1)
    return fall * cloud.sigma_m.reshape(-1)


def gather_heights(
    grid: GridSpec, points_world: Float[Array, "N 3"], sigma_m: Float[Array, "N"], keep: Bool[Array, "N"]
) -> Float[Array, "4 X Y"]:
    """The statistics of the points of one frame, by scatter-add.

    Args:
        grid: the window of the map that holds all the points.
        points_world: metres; those outside the grid do not count.
        sigma_m: standard deviation of the height of each.
        keep: which points count.

    Returns:
        Of each column the number of points, their weight (the sum of inverse variances), and the weighted mean of
        their heights (world z) and sum of squares about it; zeros where there is no point.
    """
    with jax.named_scope("gather_heights"):
        keep = keep & jnp.isfinite(sigma_m) & jnp.isfinite(points_world[:, 2])
        x, y, z = grid.shape
        column = flat_voxel_index(grid, points_world, keep) // z
        weight = jnp.where(keep, 1.0 / (sigma_m**2 + POSE_SIGMA_M**2), 0.0)
        height_m = jnp.where(keep, points_world[:, 2], 0.0)

        def total(values: Array) -> Array:
            # One flat scatter each is thrice as fast as scattering rows.
            return jnp.zeros(x * y, weight.dtype).at[column].add(values, mode="drop")

        # From a height of the frame, so that sums lose no digits.
        base_m = jnp.where(keep, height_m, 0.0).sum() / jnp.maximum(keep.sum(), 1)
        count, mass = total(jnp.ones_like(weight)), total(weight)
        mean_m = total(weight * (height_m - base_m)) / jnp.maximum(mass, _LEAST_WEIGHT) + base_m
        off_m = height_m - jnp.take(mean_m, column, mode="clip")
        return jnp.stack([count, mass, jnp.where(mass > 0, mean_m, 0.0), total(weight * off_m**2)]).reshape(4, x, y)


def combine(one: Float[Array, "4 X Y"], other: Float[Array, "4 X Y"]) -> Float[Array, "4 X Y"]:
    """The statistics of all the points of two frames, or of two maps on the same columns."""
    (count, mass, mean_m, square), (more, weight, height_m, scatter) = one, other
    # Of a column without points before, all is the frame's: to the last bit.
    share = weight / jnp.maximum(mass + weight, _LEAST_WEIGHT)
    apart_m = height_m - mean_m
    mean_m = mean_m + apart_m * share
    return jnp.stack([count + more, mass + weight, mean_m, square + scatter + apart_m**2 * mass * share])


def add_heights(voxel_map: VoxelMap, heights: Float[Array, "4 X Y"], window: GridSpec) -> Float[Array, "4 X Y"]:
    """The map's statistics with those of a frame, whose columns are a window's."""
    assert voxel_map.surface is not None
    start = window.first - voxel_map.grid.first
    corner = (jnp.zeros((), jnp.int32), start[0], start[1])
    here = jax.lax.dynamic_slice(voxel_map.surface, corner, heights.shape)
    return jax.lax.dynamic_update_slice(voxel_map.surface, combine(here, heights), corner)


@partial(jax.jit, static_argnames=("most_sigma_m", "reach"))
def read_surface(voxel_map: VoxelMap, params: FusionParams, most_sigma_m: float = 0.05, reach: int = 0) -> Surface:
    """The heights of a map's columns.

    The height is the mean of the points, each weighted by the inverse of its variance. Its variance is that of the
    camera's height, and the points' over their number, with blocks of pixels as one; where points scatter by more than
    they should, as at edges and false matches, by how they scatter (Birge 1932, "The calculation of errors by the
    method of least squares").

    A height is known where its sigma is small enough and it lies within a voxel of the occupied ones of its column.
    Without statistics, as in maps of other origin, it is the middle of the highest occupied voxel, whose sigma is that
    of a uniform distribution over the voxel.

    Args:
        voxel_map: the map.
        params: how it is read.
        most_sigma_m: heights of greater sigma are not known.
        reach: columns to either side whose points count, too, where those of the column are not enough: the fewest that
            are. Far ground, of which each column holds a few pixels, is known so, less sharply; errors that neighbours
            share are not in its sigma.
    """
    solid, grid = occupied(voxel_map, params), voxel_map.grid
    seen, size_m, floor_m = solid.any(axis=-1), grid.voxel_size_m[2], grid.origin_m[2]
    level = jnp.arange(grid.shape[2])
    highest = jnp.where(solid, level, -1).max(axis=-1)
    if voxel_map.surface is None:
        sigma = jnp.full(seen.shape, 1.0) * size_m / jnp.sqrt(12.0)
        return Surface(floor_m + (highest + 0.5) * size_m, sigma, seen)
    lowest = jnp.where(solid, level, grid.shape[2]).min(axis=-1)
    height_m, variance, known = jnp.zeros(seen.shape), jnp.zeros(seen.shape), jnp.zeros(seen.shape, bool)
    for width in range(reach + 1):
        mean_m, wider, count = _heights_around(voxel_map.surface, width)
        inside = (mean_m > floor_m + (lowest - 1) * size_m) & (mean_m < floor_m + (highest + 2) * size_m)
        more = ~known & seen & inside & (count >= _FEWEST_POINTS) & (wider < most_sigma_m**2)
        height_m, variance, known = jnp.where(more, mean_m, height_m), jnp.where(more, wider, variance), known | more
    return Surface(height_m, jnp.sqrt(variance), known)


def _heights_around(statistics: Float[Array, "4 X Y"], reach: int) -> tuple[Array, Array, Array]:
    """Mean height of the columns up to so far around each, its variance, and the number of points."""
    offsets = [(i, j) for i in range(2 * reach + 1) for j in range(2 * reach + 1) if (i, j) != (reach, reach)]
    total = statistics
    if offsets:
        padded = jnp.pad(statistics, [(0, 0), (reach, reach), (reach, reach)])

        def add(total: Array, offset: Array) -> tuple[Array, None]:
            return combine(total, jax.lax.dynamic_slice(padded, (0, *offset), statistics.shape)), None

        total, _ = jax.lax.scan(add, statistics, jnp.array(offsets))
    count, weight, mean_m, square = total
    weight = jnp.maximum(weight, _LEAST_WEIGHT)
    scatter = jnp.maximum(square, count) / weight
    variance = POSE_SIGMA_M**2 + scatter * _SHARED_PIXELS / jnp.maximum(count, 1.0)
    return mean_m, variance, count
