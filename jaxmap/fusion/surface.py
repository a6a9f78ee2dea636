"""The height of the surface in each column, finer than voxels: statistics of its points, fused beside the map.

A voxel says no more of a height than its own edge. What each column keeps is what rovers keep of the cells of their
maps (Goldberg, Maimone and Matthies 2002, "Stereo vision and rover navigation software for planetary exploration"):
how many points there were, and the mean of their heights and the scatter about it. They add up over frames, maps and
processes like all evidence, by the formulas of Chan, Golub and LeVeque (1983, "Algorithms for computing the sample
variance"), which lose no digits however high the ground lies.

They are kept apart in layers as high as a tile, so that a tile of a large map holds all that its own points say,
whoever fused it; the height of a column is that of all its layers.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmap.fusion.params import FusionParams
from jaxmap.fusion.query import occupied
from jaxmap.geometry.cloud import PointCloud
from jaxmap.geometry.grid import flat_voxel_index
from jaxmap.types import LAYER, GridSpec, VoxelMap, layer_count

POSE_SIGMA_M = 0.01
"""Heights of the camera are no better than this, however many pixels there are."""
_SHARED_PIXELS = 25.0
"""Neighbours that were matched together err together: a block of five by five counts as one."""
_FEWEST_POINTS = 2.0
_LEAST_WEIGHT = 1e-12


AnyArray = Array | np.ndarray
"""Of JAX or of NumPy."""


class ColumnHeights(NamedTuple):
    """What a map knows of the heights of its columns, each for itself.

    Attributes:
        statistics: of all points of the column, as in `gather_heights`; None where the map keeps none.
        lowest: the first voxel that is occupied, counted from the floor of the grid; its height where none is.
        highest: the last one; -1 where none is.
    """

    statistics: Float[AnyArray, "4 X Y"] | None
    lowest: Int[AnyArray, "X Y"]
    highest: Int[AnyArray, "X Y"]


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
    grid: GridSpec,
    window: GridSpec,
    points_world: Float[Array, "N 3"],
    sigma_m: Float[Array, "N"],
    keep: Bool[Array, "N"],
) -> Float[Array, "4 X Y L"]:
    """The statistics of the points of one frame, by scatter-add.

    Args:
        grid: that of the map.
        window: the part of it that holds all the points.
        points_world: metres; those outside the window do not count.
        sigma_m: standard deviation of the height of each.
        keep: which points count.

    Returns:
        Of each column and layer of the window (`layer_count`, from `_first_layer` on) the number of points, their
        weight (the sum of inverse variances), and the weighted mean of their heights (world z) and sum of squares about
        it; zeros where there is no point.
    """
    with jax.named_scope("gather_heights"):
        keep = keep & jnp.isfinite(sigma_m) & jnp.isfinite(points_world[:, 2])
        x, y, z = window.shape
        layers, lowest = layer_count(z), grid.first[2] // LAYER + _first_layer(grid, window)
        voxel = flat_voxel_index(window, points_world, keep)
        layer = (voxel % z + window.first[2]) // LAYER - lowest
        cell = jnp.where(voxel < x * y * z, voxel // z * layers + layer, x * y * layers)
        weight = jnp.where(keep, 1.0 / (sigma_m**2 + POSE_SIGMA_M**2), 0.0)
        height_m = jnp.where(keep, points_world[:, 2], 0.0)

        def total(values: Array) -> Array:
            # One flat scatter each is thrice as fast as scattering rows.
            return jnp.zeros(x * y * layers, weight.dtype).at[cell].add(values, mode="drop")

        # From a height of the frame, so that sums lose no digits.
        base_m = jnp.where(keep, height_m, 0.0).sum() / jnp.maximum(keep.sum(), 1)
        count, mass = total(jnp.ones_like(weight)), total(weight)
        mean_m = total(weight * (height_m - base_m)) / jnp.maximum(mass, _LEAST_WEIGHT) + base_m
        off_m = height_m - jnp.take(mean_m, cell, mode="clip")
        mean_m = jnp.where(mass > 0, mean_m, 0.0)
        return jnp.stack([count, mass, mean_m, total(weight * off_m**2)]).reshape(4, x, y, layers)


def _first_layer(grid: GridSpec, window: GridSpec) -> Int[Array, ""]:
    """Where the layers of a window begin among those of the grid: there must be room for as many as it may touch."""
    apart = window.first[2] // LAYER - grid.first[2] // LAYER
    return jnp.minimum(apart, layer_count(grid.shape[2]) - layer_count(window.shape[2]))


def combine(one: Float[AnyArray, "4 *s"], other: Float[AnyArray, "4 *s"]) -> Float[AnyArray, "4 *s"]:
    """The statistics of all the points of two frames, or of two maps on the same columns; with none, the same bits."""
    (count, mass, mean_m, square), (more, weight, height_m, scatter) = one, other
    xp: Any = np if isinstance(one, np.ndarray) else jnp
    share = weight / xp.maximum(mass + weight, _LEAST_WEIGHT)
    apart_m = height_m - mean_m
    square = square + scatter + apart_m**2 * (mass * share)
    return xp.stack([count + more, mass + weight, mean_m + apart_m * share, square])


def over_layers(surface: Float[Array, "4 X Y L"]) -> Float[Array, "4 X Y"]:
    """The statistics of whole columns."""

    def add(total: Array, layer: Array) -> tuple[Array, None]:
        return jnp.asarray(combine(total, layer)), None

    return jax.lax.scan(add, jnp.zeros(surface.shape[:3], surface.dtype), jnp.moveaxis(surface, 3, 0))[0]


def add_heights(voxel_map: VoxelMap, heights: Float[Array, "4 X Y L"], window: GridSpec) -> Float[Array, "4 X Y L"]:
    """The map's statistics with those of a frame, whose columns are a window's."""
    assert voxel_map.surface is not None
    start = window.first - voxel_map.grid.first
    corner = (jnp.zeros((), jnp.int32), start[0], start[1], _first_layer(voxel_map.grid, window))
    here = jax.lax.dynamic_slice(voxel_map.surface, corner, heights.shape)
    return jax.lax.dynamic_update_slice(voxel_map.surface, combine(here, heights), corner)


@jax.jit
def column_heights(voxel_map: VoxelMap, params: FusionParams) -> ColumnHeights:
    """What a map knows of the heights of its columns, where its voxels are read with these numbers."""
    solid, level = occupied(voxel_map, params), jnp.arange(voxel_map.grid.shape[2])
    statistics = None if voxel_map.surface is None else over_layers(voxel_map.surface)
    lowest = jnp.where(solid, level, len(level)).min(axis=-1)
    return ColumnHeights(statistics, lowest, jnp.where(solid, level, -1).max(axis=-1))


def read_surface(voxel_map: VoxelMap, params: FusionParams, most_sigma_m: float = 0.05, reach: int = 0) -> Surface:
    """The heights of a map's columns (`surface_of`), where its voxels are read with these numbers."""
    return surface_of(column_heights(voxel_map, params), voxel_map.grid, most_sigma_m, reach)


@partial(jax.jit, static_argnames=("most_sigma_m", "reach"))
def surface_of(columns: ColumnHeights, grid: GridSpec, most_sigma_m: float = 0.05, reach: int = 0) -> Surface:
    """The heights of columns.

    The height is the mean of the points, each weighted by the inverse of its variance. Its variance is that of the
    camera's height, and the points' over their number, with blocks of pixels as one; where points scatter by more than
    they should, as at edges and false matches, by how they scatter (Birge 1932, "The calculation of errors by the
    method of least squares").

    A height is known where its sigma is small enough and it lies within a voxel of the occupied ones of its column.
    Without statistics, as in maps of other origin, it is the middle of the highest occupied voxel, whose sigma is that
    of a uniform distribution over the voxel.

    Args:
        columns: what is known of each.
        grid: whose columns they are.
        most_sigma_m: heights of greater sigma are not known.
        reach: columns to either side whose points count, too, where those of the column are not enough: the fewest that
            are. Far ground, of which each column holds a few pixels, is known so, less sharply; errors that neighbours
            share are not in its sigma.
    """
    statistics, lowest, highest = columns
    seen, size_m, floor_m = highest >= 0, grid.voxel_size_m[2], grid.origin_m[2]
    if statistics is None:
        sigma = jnp.full(seen.shape, 1.0) * size_m / jnp.sqrt(12.0)
        return Surface(floor_m + (highest + 0.5) * size_m, sigma, seen)
    height_m, variance, known = jnp.zeros(seen.shape), jnp.zeros(seen.shape), jnp.zeros(seen.shape, bool)
    for width in range(reach + 1):
        mean_m, wider, count = _heights_around(jnp.asarray(statistics), width)
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
            there = jax.lax.dynamic_slice(padded, (0, *offset), statistics.shape)
            return jnp.asarray(combine(total, there)), None

        total, _ = jax.lax.scan(add, statistics, jnp.array(offsets))
    count, weight, mean_m, square = total
    weight = jnp.maximum(weight, _LEAST_WEIGHT)
    scatter = jnp.maximum(square, count) / weight
    variance = POSE_SIGMA_M**2 + scatter * _SHARED_PIXELS / jnp.maximum(count, 1.0)
    return mean_m, variance, count
