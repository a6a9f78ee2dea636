"""The height of the surface in each column, finer than voxels: weighted sums over its points, fused beside the map.

A voxel says no more of a height than its own edge. The sums that each column keeps are those that rovers keep of the
cells of their maps (Goldberg, Maimone and Matthies 2002, "Stereo vision and rover navigation software for planetary
exploration"): from them follow the mean and how the points scatter about it. They add up over frames, maps and
processes like all evidence.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxmap.fusion.params import FusionParams
from jaxmap.fusion.query import occupied
from jaxmap.geometry.cloud import PointCloud
from jaxmap.geometry.grid import Window, flat_voxel_index
from jaxmap.types import GridSpec, VoxelMap

SUMS = 4
"""Of each column: the number of points, and the sums of w, w z and w z^2, with z above the floor of the grid."""

POSE_SIGMA_M = 0.01
"""Heights of the camera are no better than this, however many pixels there are."""
_SHARED_PIXELS = 25.0
"""Neighbours that were matched together err together: a block of five by five counts as one."""
_FEWEST_POINTS = 2.0


class Surface(NamedTuple):
    """Heights of the surface, world z, and their standard deviations; both mean nothing where not `known`."""

    height_m: Float[Array, "X Y"]
    sigma_m: Float[Array, "X Y"]
    known: Bool[Array, "X Y"]


def height_sigma(cloud: PointCloud, camera_z_m: Float[Array, ""]) -> Float[Array, "N"]:
    """Standard deviation of the height of each point: an error of depth moves it along its ray."""
    fall = jnp.abs(cloud.points_world[:, 2] - camera_z_m) / cloud.depth_m.reshape(-1)
    return fall * cloud.sigma_m.reshape(-1)


def sum_heights(
    grid: GridSpec,
    points_world: Float[Array, "N 3"],
    sigma_m: Float[Array, "N"],
    keep: Bool[Array, "N"],
    window: Window,
) -> Float[Array, "4 X Y"]:
    """What the points of one frame add to the columns of a window, by scatter-add.

    Args:
        grid: of the map.
        points_world: metres.
        sigma_m: standard deviation of the height of each.
        keep: which points count; those outside the grid do not.
        window: the part of the grid that holds all the points.
    """
    with jax.named_scope("sum_heights"):
        keep = keep & jnp.isfinite(sigma_m)
        x, y, z = window.grid.shape
        column = flat_voxel_index(grid, points_world, keep, window) // z
        weight = jnp.where(keep, 1.0 / (sigma_m**2 + POSE_SIGMA_M**2), 0.0)
        above_m = points_world[:, 2] - grid.origin_m[2]
        addends = (jnp.ones_like(weight), weight, weight * above_m, weight * above_m**2)
        # One flat scatter each is thrice as fast as scattering rows.
        empty = jnp.zeros(x * y, weight.dtype)
        return jnp.stack([empty.at[column].add(values, mode="drop") for values in addends]).reshape(SUMS, x, y)


def add_heights(surface: Float[Array, "4 X Y"], added: Float[Array, "4 x y"], window: Window) -> Float[Array, "4 X Y"]:
    """Adds what a frame says of the columns of a window."""
    corner = (jnp.zeros((), jnp.int32), window.start[0], window.start[1])
    here = jax.lax.dynamic_slice(surface, corner, added.shape)
    return jax.lax.dynamic_update_slice(surface, here + added, corner)


@partial(jax.jit, static_argnames=("most_sigma_m", "reach"))
def read_surface(voxel_map: VoxelMap, params: FusionParams, most_sigma_m: float = 0.05, reach: int = 0) -> Surface:
    """The heights of a map's columns.

    The height is the mean of the points, each weighted by the inverse of its variance. Its variance is that of the
    camera's height, and the points' over their number, with blocks of pixels as one; where points scatter by more than
    they should, as at edges and false matches, by how they scatter (Birge 1932, "The calculation of errors by the
    method of least squares").

    A height is known where its sigma is small enough and it lies within a voxel of the occupied ones of its column.
    Without sums, as in maps of other origin, it is the middle of the highest occupied voxel, whose sigma is that
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
    above_m, variance, known = jnp.zeros(seen.shape), jnp.zeros(seen.shape), jnp.zeros(seen.shape, bool)
    for width in range(reach + 1):
        mean_m, wider, count = _mean_heights(_box_sums(voxel_map.surface, width))
        inside = (mean_m > (lowest - 1) * size_m) & (mean_m < (highest + 2) * size_m)
        more = ~known & seen & inside & (count >= _FEWEST_POINTS) & (wider < most_sigma_m**2)
        above_m, variance, known = jnp.where(more, mean_m, above_m), jnp.where(more, wider, variance), known | more
    return Surface(floor_m + above_m, jnp.sqrt(variance), known)


def _mean_heights(sums: Float[Array, "4 X Y"]) -> tuple[Array, Array, Array]:
    """Mean height above the floor of the grid, its variance, and the number of points."""
    count, weight, first, second = sums
    weight = jnp.maximum(weight, 1e-12)
    mean_m = first / weight
    scatter = jnp.maximum(second / weight - mean_m**2, 0.0)
    variance = POSE_SIGMA_M**2 + jnp.maximum(scatter, count / weight) * _SHARED_PIXELS / jnp.maximum(count, 1.0)
    return mean_m, variance, count


def _box_sums(sums: Float[Array, "4 X Y"], reach: int) -> Float[Array, "4 X Y"]:
    size = (1, 2 * reach + 1, 2 * reach + 1)
    return jax.lax.reduce_window(sums, 0.0, jax.lax.add, size, (1, 1, 1), "SAME") if reach else sums
