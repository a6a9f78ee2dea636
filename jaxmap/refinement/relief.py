"""Where a map lies to an orthomosaic in which rocks are labelled: what rises from the ground belongs on the rocks.

The points of all frames give the ground's relief in columns (by the soft splat). The labels are moved over it, shifted
and turned, to where most that rises is labelled rock, and most that does not is not. Only columns that were seen count,
so that the far sides of rocks, which no camera saw, pull nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates, percentile_filter

from jaxmap.evaluation.truth_cells import Alignment, register
from jaxmap.fusion.splat import splat_columns
from jaxmap.refinement.anchors import Raster, sample_raster
from jaxmap.refinement.rig import PER_FRAME, SHARED, Rig
from jaxmap.refinement.solve import Term
from jaxmap.refinement.terms import Linearised
from jaxmap.types import make_grid

MAX_CELLS = 4_000_000
CELL_M = 0.05

GROUND_WINDOW_M = 1.2
"""The ground around a column: the lower quarter of the heights within such a square."""

ROCK_RISES_M = 0.15
"""What rises so much or more is rock for certain; half of it, as likely as not."""

LEAST_SIGMA_M, LEAST_SIGMA_RAD = 0.08, float(np.radians(0.5))
"""However many rocks there are: stereo lets rocks lean towards the camera, which sees them from one side only."""

BLOCK_M, RESAMPLES = 1.0, 6

MIN_ROCK_COLUMNS = 20


class Relief(NamedTuple):
    """Columns that were seen: where they are, and how likely they are rock by how they rise."""

    x: Float64[np.ndarray, "K"]
    y: Float64[np.ndarray, "K"]
    rockness: Float64[np.ndarray, "K"]


def relief_of(xyz: Float64[np.ndarray, "P 3"]) -> Relief:
    """The relief that points show."""
    cell_m = max(CELL_M, float(np.sqrt(np.prod(np.ptp(xyz[:, :2], axis=0)) / MAX_CELLS)))
    lower = np.floor(xyz.min(axis=0) / cell_m) * cell_m - cell_m
    span = xyz.max(axis=0) - lower + cell_m
    grid = make_grid([0.0, 0.0, 0.0], span.tolist(), [cell_m, cell_m, float(span[2])])
    local = jnp.asarray(xyz - lower, jnp.float32)
    values = jnp.stack([jnp.ones(len(xyz)), local[:, 2]])
    weight, total = np.asarray(splat_columns(grid, local, values, jnp.ones(len(xyz), bool)), np.float64)
    seen = weight > 0.5
    height = np.where(seen, total / np.maximum(weight, 0.5), np.nan)
    rises = height - _ground(height, cell_m)
    column = np.argwhere(seen)
    x, y = ((column[:, axis] + 0.5) * cell_m + lower[axis] for axis in (0, 1))
    return Relief(x, y, np.clip(rises[seen] / ROCK_RISES_M, 0.0, 1.0))


def _ground(height: np.ndarray, cell_m: float) -> np.ndarray:
    """The ground under a relief: the lower part of the heights around."""
    nearest = distance_transform_edt(~np.isfinite(height), return_distances=False, return_indices=True)
    assert isinstance(nearest, np.ndarray)
    # Coarser for the filter, whose time grows with its window.
    step = max(1, round(0.15 / cell_m))
    coarse = height[tuple(nearest)][::step, ::step]
    size = max(3, int(GROUND_WINDOW_M / cell_m / step) | 1)
    # Of what is left without the trend: else the upper side of a slope would rise above its ground.
    trend = gaussian_filter(coarse, size)
    low = trend + gaussian_filter(percentile_filter(coarse - trend, 25, size=size), 1.0)
    return map_coordinates(low, np.indices(height.shape) / step, order=1, mode="nearest")


def place(
    relief: Relief, is_rock: Raster, pivot_m: tuple[float, float]
) -> tuple[Alignment, Float64[np.ndarray, "3"]] | None:
    """How the labels must be moved to fit the relief; None where too little of rock and ground is in view.

    Args:
        relief: of the map.
        is_rock: 1 rock, 0 no rock, NaN unlabelled.
        pivot_m: what is turned about.

    Returns:
        The motion, and its standard deviations: east and north (m), heading (rad), by resampling blocks of the ground.
    """
    share = sample_raster(is_rock, relief.x, relief.y)
    seen = share[np.isfinite(share)]
    if min(seen.sum(), (1 - seen).sum()) < MIN_ROCK_COLUMNS:
        return None
    blocks = np.floor(np.stack([relief.x, relief.y]) / BLOCK_M).astype(np.int64)
    _, block = np.unique(blocks, axis=1, return_inverse=True)
    block, rng = block.ravel(), np.random.default_rng(0)
    placed = []
    for _ in range(RESAMPLES):
        count = np.bincount(rng.integers(0, block.max() + 1, block.max() + 1), minlength=block.max() + 1)
        again = _placed_by(relief, is_rock, pivot_m, count[block].astype(np.float64))
        placed.append([*again.shift_m, again.heading_rad])
    least = np.array([LEAST_SIGMA_M, LEAST_SIGMA_M, LEAST_SIGMA_RAD])
    best = _placed_by(relief, is_rock, pivot_m, np.ones(len(block)))
    return best, np.hypot(np.std(placed, axis=0, ddof=1), least)


def _placed_by(relief: Relief, is_rock: Raster, pivot_m: tuple[float, float], weight: np.ndarray) -> Alignment:
    """Where the labels fit best; each column counts by its weight."""
    used = weight > 0
    x, y, worth = relief.x[used], relief.y[used], (weight * (relief.rockness - 0.5))[used]

    def gain(alignment: Alignment) -> float:
        # Summed over columns that were seen: labels gain nothing by hiding where no camera looked.
        return float(np.nansum(sample_raster(is_rock, *alignment.undone(x, y)) * worth))

    return register(gain, pivot_m)


def place_term(rig: Rig, alignment: Alignment, sigma: Float64[np.ndarray, "3"]) -> Term:
    """Frames belong where they come when the map is moved onto the labels, all together as well as that is known."""
    T = rig.T_world_camera
    x, y = alignment.undone(T[:, 0, 3], T[:, 1, 3])
    target, frames = np.stack([x, y], axis=-1), len(T)

    def linearised(moved: Rig) -> Linearised:
        return _placed(moved, target, T[:, :3, :3], alignment.heading_rad)

    index = np.arange(frames)
    return Term(linearised, index[:, None], sigma * np.sqrt(frames), 0.0, index, 1.0, adapts=False)


def _placed(rig: Rig, target: np.ndarray, R_before: np.ndarray, heading_rad: float) -> Linearised:
    """Place (east, north) and heading of each frame, less what they should be."""
    T, R_nominal = rig.T_world_camera, rig.T_world_nominal[:, :3, :3]
    turned = T[:, :3, :3] @ R_before.transpose(0, 2, 1)
    turn = np.arctan2(turned[:, 1, 0] - turned[:, 0, 1], turned[:, 0, 0] + turned[:, 1, 1])
    residual = np.concatenate([T[:, :2, 3] - target, (turn + heading_rad)[:, None]], axis=1)
    by_frames, by_shared = np.zeros((len(T), 3, 1, PER_FRAME)), np.zeros((len(T), 3, SHARED))
    by_frames[:, (0, 1), 0, (0, 1)] = 1.0
    by_shared[:, :2, :3] = R_nominal[:, :2]
    by_frames[:, 2, 0, 3:] = R_nominal[:, 2]
    by_shared[:, 2, 3:6] = T[:, 2, :3]
    return Linearised(residual, by_frames, by_shared, np.zeros(residual.shape))
