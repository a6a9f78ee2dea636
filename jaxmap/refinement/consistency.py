"""Consistency of a map: how much frames that see the same column differ in its height and its brightness."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmap.fusion.splat import splat_columns
from jaxmap.types import GridSpec, make_grid

CELL_M = 0.1
MAX_CELLS = 1_000_000
ENOUGH_POINTS = 0.5
"""A frame sees a column where the shares of its points sum to this."""


class Consistency(NamedTuple):
    """Standard deviations between the frames that see a column, over the columns that two or more see.

    Attributes:
        height_m, brightness: the median over the columns; the mean would be dominated by the edges of rocks.
        spread_m: (X, Y) of the height in each column, NaN where fewer than two frames see it.
        grid: the columns, one voxel high.
    """

    height_m: float
    brightness: float
    spread_m: Float[np.ndarray, "X Y"]
    grid: GridSpec


def between_frames(
    grid: GridSpec, points_world: Float[Array, "N P 3"], values: Float[Array, "C N P"]
) -> tuple[Float[Array, "C X Y"], Float[Array, "X Y"]]:
    """Variance between frames of the mean value of each column, by the soft splat.

    Differentiable in points and values: descent on its mean makes the frames agree.

    Args:
        grid: the columns.
        points_world: of N frames, NaN where a frame has fewer.
        values: channels, likewise.

    Returns:
        The variance, 0 where fewer than two frames see the column; and how many do.
    """
    channels = values.shape[0]

    def frame(sums: tuple[Array, Array, Array], seen: tuple[Array, Array]) -> tuple[tuple[Array, Array, Array], None]:
        points, own = seen
        rows = jnp.concatenate([jnp.ones((1, points.shape[0]), points.dtype), own])
        splatted = splat_columns(grid, points, rows, jnp.isfinite(points).all(axis=-1))
        enough = splatted[0] > ENOUGH_POINTS
        mean = jnp.where(enough, splatted[1:] / jnp.where(enough, splatted[0], 1.0), 0.0)
        count, total, squares = sums
        return (count + enough, total + mean, squares + mean * mean), None

    zero = jnp.zeros((channels, *grid.shape[:2]), points_world.dtype)
    start = (jnp.zeros(grid.shape[:2], points_world.dtype), zero, zero)
    (count, total, squares), _ = jax.lax.scan(frame, start, (points_world, jnp.moveaxis(values, 1, 0)))
    several = count > 1
    safe = jnp.where(several, count, 2.0)
    variance = jnp.where(several, (squares - total * total / safe) / (safe - 1), 0.0)
    return jnp.maximum(variance, 0.0), count


def consistency_of(
    points_world: Float[np.ndarray, "P 3"], brightness: Float[np.ndarray, "P"], frames: Int[np.ndarray, "P"]
) -> Consistency:
    """Consistency of frames, from their points in the world.

    Args:
        points_world: of all frames.
        brightness: of the pixel of each.
        frames: index of the frame of each.
    """
    lower, upper = points_world.min(axis=0), points_world.max(axis=0)
    cell_m = max(CELL_M, float(np.sqrt(np.prod((upper - lower)[:2]) / MAX_CELLS)))
    lower = np.floor(lower / cell_m) * cell_m
    grid = make_grid(lower.tolist(), (upper + cell_m).tolist(), [cell_m, cell_m, float(upper[2] - lower[2] + cell_m)])
    local = grid.__class__(jnp.zeros(3), grid.voxel_size_m, grid.shape)
    most = int(np.bincount(frames).max())
    points = np.full((int(frames.max()) + 1, most, 3), np.nan)
    values = np.zeros((2, *points.shape[:2]))
    for frame in np.unique(frames):
        own = frames == frame
        points[frame, : own.sum()] = points_world[own] - lower
        values[:, frame, : own.sum()] = points[frame, : own.sum(), 2], brightness[own]
    # Heights are centred: their squares are subtracted from each other in float32.
    values[0] -= np.nanmedian(points[..., 2])
    variance, count = (
        np.asarray(part, np.float64)
        for part in jax.jit(between_frames)(local, jnp.asarray(points, jnp.float32), jnp.asarray(values, jnp.float32))
    )
    several = count > 1
    middle = np.median(variance[:, several], axis=1) if several.any() else np.full(2, np.nan)
    return Consistency(
        float(np.sqrt(middle[0])), float(np.sqrt(middle[1])), np.where(several, np.sqrt(variance[0]), np.nan), grid
    )
