"""Soft splatting: points shared out among the nearest voxel centres, so that sums over voxels have gradients to points.

The hard splat (`fusion.integrate`) gives a point to the voxel that holds it: right for a map, but flat everywhere, as a
point may move within its voxel and nothing changes. Here a point at `p` gives the voxel centred at `c` the share
`prod_axis max(0, 1 - |p - c| / size)`, which is linear between centres. Sampling a field by the same shares is the
transpose: `<splat(points, values), field> = <values, sample(field, points)>`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmap.types import GridSpec

_COLUMN_AXES, _VOXEL_AXES = (0, 1), (0, 1, 2)


def splat_trilinear(
    grid: GridSpec, points_world: Float[Array, "N 3"], values: Float[Array, "C N"], keep: Bool[Array, "N"]
) -> Float[Array, "C X Y Z"]:
    """Sums of values in voxels, each point shared out among the eight nearest centres.

    The shares of a point in the grid sum to 1; within half a voxel of the grid's faces the outer voxels take what would
    fall outside. Points that are not kept, not finite or outside, and values that are not finite, are left out exactly.
    A point at a voxel's centre is given to that voxel alone, as by the hard splat.

    Args:
        grid: the voxels.
        points_world: metres.
        values: one row for each channel.
        keep: which points count.
    """
    return _splat(grid, points_world, values, keep, _VOXEL_AXES)


def splat_columns(
    grid: GridSpec, points_world: Float[Array, "N 3"], values: Float[Array, "C N"], keep: Bool[Array, "N"]
) -> Float[Array, "C X Y"]:
    """The same in columns of voxels, each point shared out among the four nearest; z decides only whether it counts."""
    return _splat(grid, points_world, values, keep, _COLUMN_AXES)


def sample_trilinear(
    grid: GridSpec, field: Float[Array, "C X Y Z"], points_world: Float[Array, "N 3"]
) -> Float[Array, "C N"]:
    """A field between voxel centres, by the shares of `splat_trilinear`; 0 at points that are not in the grid."""
    return _sample(grid, field, points_world, _VOXEL_AXES)


def sample_columns(
    grid: GridSpec, field: Float[Array, "C X Y"], points_world: Float[Array, "N 3"]
) -> Float[Array, "C N"]:
    """A field over columns between their centres, by the shares of `splat_columns`."""
    return _sample(grid, field, points_world, _COLUMN_AXES)


def inside_grid(grid: GridSpec, points_world: Float[Array, "N 3"]) -> Bool[Array, "N"]:
    """Which points are finite and in the grid."""
    inside = jnp.ones(points_world.shape[0], bool)
    for axis in _VOXEL_AXES:
        scaled = (points_world[:, axis] - grid.origin_m[axis]) / grid.voxel_size_m[axis]
        # Of a number that is not finite both comparisons are false.
        inside &= (scaled >= 0) & (scaled < grid.shape[axis])
    return inside


def _splat(
    grid: GridSpec,
    points: Float[Array, "N 3"],
    values: Float[Array, "C N"],
    keep: Bool[Array, "N"],
    axes: Sequence[int],
) -> Float[Array, "C *cells"]:
    with jax.named_scope("soft_splat"):
        keep = keep & inside_grid(grid, points) & jnp.isfinite(values).all(axis=0)
        # Zero before they are multiplied: the gradient of NaN times nothing would be NaN.
        values = jnp.where(keep, values, 0.0)
        safe = jnp.where(keep[:, None], points, grid.origin_m)
        shape = tuple(grid.shape[axis] for axis in axes)
        cells = int(np.prod(shape))
        rows = [jnp.zeros(cells, values.dtype) for _ in range(values.shape[0])]
        for cell, share in _corners(grid, safe, axes):
            target = jnp.where(keep, cell, cells)
            # Unrolled over channels: one flat scatter each is faster than scattering rows.
            rows = [row.at[target].add(share * values[c], mode="drop") for c, row in enumerate(rows)]
        return jnp.stack(rows).reshape(len(rows), *shape)


def _sample(
    grid: GridSpec, field: Float[Array, "C *cells"], points: Float[Array, "N 3"], axes: Sequence[int]
) -> Float[Array, "C N"]:
    with jax.named_scope("soft_sample"):
        inside = inside_grid(grid, points)
        safe = jnp.where(inside[:, None], points, grid.origin_m)
        flat = field.reshape(field.shape[0], -1)
        total = jnp.zeros((field.shape[0], points.shape[0]), field.dtype)
        for cell, share in _corners(grid, safe, axes):
            total = total + share * flat[:, cell]
        return jnp.where(inside, total, 0.0)


def _corners(
    grid: GridSpec, points: Float[Array, "N 3"], axes: Sequence[int]
) -> Iterator[tuple[Int[Array, "N"], Float[Array, "N"]]]:
    """The flat index of each nearest cell, and the share of every point that falls to it."""
    lower, fraction = [], []
    for axis in axes:
        scaled = (points[:, axis] - grid.origin_m[axis]) / grid.voxel_size_m[axis] - 0.5
        # Held within the outer centres: what would fall outside goes to the outer cells.
        scaled = jnp.clip(scaled, 0.0, grid.shape[axis] - 1.0)
        first = jnp.minimum(jnp.floor(scaled), max(grid.shape[axis] - 2, 0))
        lower.append(first.astype(jnp.int32))
        fraction.append(scaled - first)
    for sides in product((0, 1), repeat=len(axes)):
        cell, share = jnp.zeros((), jnp.int32), jnp.ones((), points.dtype)
        for place, (axis, side) in enumerate(zip(axes, sides, strict=True)):
            # A grid one cell wide has no second centre; the share there is zero.
            index = jnp.minimum(lower[place] + side, grid.shape[axis] - 1)
            cell = cell * grid.shape[axis] + index
            share = share * (fraction[place] if side else 1.0 - fraction[place])
        yield cell, share
