"""Ties of a map to the ground: an elevation model, the ground under the rover, labelled rocks.

Frames that agree with each other leave the pose of the map as a whole unobservable. Points on an elevation model
determine height, roll and pitch, and by the relief of the ground position and heading too. Labelled rocks determine
position and heading: the points of all frames give the relief in columns (by the soft splat), and the labels are
shifted and turned over it until most of what rises is labelled rock, and most of what does not is not. Only columns
that were seen count, so that the far sides of rocks, which no camera saw, do not bias the result.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates, percentile_filter
from scipy.spatial import KDTree

from jaxmap.evaluation.truth_cells import Alignment, register
from jaxmap.fusion.splat import splat_columns
from jaxmap.refinement.frames import PixelSamples
from jaxmap.refinement.residuals import HeightField, Linearised, linearise, make_device_rig
from jaxmap.refinement.rig import PER_FRAME, SHARED, Rig
from jaxmap.refinement.solver import ResidualTerm
from jaxmap.types import GridSpec, Pinhole, make_grid

HEIGHT_SIGMA_M = 0.03
FRAME_WEIGHT = 30.0
"""Errors within a frame are correlated: its points count as so many independent ones, at most."""

CONTACT_RADIUS_M = 0.4
"""The ground is taken as level so far around each position of the rover."""

MAX_CELLS = 4_000_000
CELL_M = 0.05

GROUND_WINDOW_M = 1.2
"""The ground around a column: the lower quarter of the heights within such a square."""

ROCK_RISES_M = 0.15
"""A column that rises so much is certainly rock; half of it, as likely as not."""

LEAST_SIGMA_M, LEAST_SIGMA_RAD = 0.08, float(np.radians(0.5))
"""However many rocks there are: in stereo, rocks lean towards the camera, which sees them from one side only."""

BLOCK_M, RESAMPLES = 1.0, 6

MIN_ROCK_COLUMNS = 20


class GroundRaster(NamedTuple):
    """Values on a regular grid of the world, x first, NaN where unknown: cell `i` spans `[i, i + 1) * cell_m`."""

    values: Float64[np.ndarray, "X Y"]
    lower_m: Float64[np.ndarray, "2"]
    cell_m: float


def sample_raster(raster: GroundRaster, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values between cell centres, NaN outside or beside an unknown cell."""
    at = [(x - raster.lower_m[0]) / raster.cell_m - 0.5, (y - raster.lower_m[1]) / raster.cell_m - 0.5]
    return map_coordinates(raster.values, at, order=1, cval=np.nan)


def height_term(
    samples: PixelSamples,
    camera: Pinhole,
    heights: GroundRaster,
    origin_m: np.ndarray,
    disparity_sigma_px: float,
    blur_m: float = 0.0,
) -> ResidualTerm:
    """Sampled points lie on an elevation model.

    Args:
        samples: of all frames.
        camera: of all frames.
        heights: the model.
        origin_m: what float32 positions are relative to.
        disparity_sigma_px: standard deviation of the disparity.
        blur_m: the model is smoothed over so much, which widens the basin of convergence.
    """
    values = heights.values
    if blur_m:
        known = np.isfinite(values)
        weight = gaussian_filter(known.astype(np.float64), blur_m / heights.cell_m)
        smooth = gaussian_filter(np.where(known, values, 0.0), blur_m / heights.cell_m)
        values = np.where(known, smooth / np.maximum(weight, 1e-3), np.nan)
    known = np.isfinite(values)
    lower = np.append(heights.lower_m - origin_m[:2], -1.0)
    size = [heights.cell_m, heights.cell_m, 2.0]
    grid = GridSpec(jnp.asarray(lower, jnp.float32), jnp.asarray(size, jnp.float32), (*values.shape, 1))
    channels = np.stack([np.where(known, values - origin_m[2], 0.0), known.astype(np.float64)])
    field = HeightField(grid, jnp.asarray(channels, jnp.float32))
    frames, uvd_px = samples.frames[:, None], samples.uvd_px[:, None]
    return ResidualTerm(
        lambda rig: linearise(make_device_rig(rig, camera, origin_m), frames, uvd_px, field),
        frames,
        np.array([HEIGHT_SIGMA_M + 0.2 * blur_m]),
        disparity_sigma_px,
        samples.frames,
        FRAME_WEIGHT,
    )


def ground_contact(track_m: Float64[np.ndarray, "N 3"], below_m: float) -> GroundRaster:
    """The ground that a rover drives over, from its given poses: so far below the camera, around each of them."""
    lower = track_m[:, :2].min(axis=0) - CONTACT_RADIUS_M
    cell_m = CONTACT_RADIUS_M / 4
    shape = np.ceil((track_m[:, :2].max(axis=0) + CONTACT_RADIUS_M - lower) / cell_m).astype(int)
    x, y = (lower[axis] + (np.arange(shape[axis]) + 0.5) * cell_m for axis in (0, 1))
    distance, nearest = KDTree(track_m[:, :2]).query(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1))
    return GroundRaster(np.where(distance < CONTACT_RADIUS_M, track_m[nearest, 2] - below_m, np.nan), lower, cell_m)


class RockRelief(NamedTuple):
    """Columns that were seen: where they are, and how likely they are rock, from their height above the ground."""

    x: Float64[np.ndarray, "K"]
    y: Float64[np.ndarray, "K"]
    rockness: Float64[np.ndarray, "K"]


def rock_relief(xyz: Float64[np.ndarray, "P 3"]) -> RockRelief:
    """The relief of points in the world."""
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
    return RockRelief(x, y, np.clip(rises[seen] / ROCK_RISES_M, 0.0, 1.0))


def _ground(height: np.ndarray, cell_m: float) -> np.ndarray:
    """The ground under a relief: a low percentile of the heights around."""
    nearest = distance_transform_edt(~np.isfinite(height), return_distances=False, return_indices=True)
    assert isinstance(nearest, np.ndarray)
    # Coarser for the filter, whose time grows with its window.
    step = max(1, round(0.15 / cell_m))
    coarse = height[tuple(nearest)][::step, ::step]
    size = max(3, int(GROUND_WINDOW_M / cell_m / step) | 1)
    # After subtracting the trend: else the upper side of a slope would rise above its ground.
    trend = gaussian_filter(coarse, size)
    low = trend + gaussian_filter(percentile_filter(coarse - trend, 25, size=size), 1.0)
    return map_coordinates(low, np.indices(height.shape) / step, order=1, mode="nearest")


def register_labels(
    relief: RockRelief, is_rock: GroundRaster, pivot_m: tuple[float, float]
) -> tuple[Alignment, Float64[np.ndarray, "3"]] | None:
    """The motion of the labels that fits them to the relief; None where too little rock or ground is in view.

    Args:
        relief: of the map.
        is_rock: 1 rock, 0 no rock, NaN unlabelled.
        pivot_m: the centre of rotation: x and y, world.

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
    resampled = []
    for _ in range(RESAMPLES):
        count = np.bincount(rng.integers(0, block.max() + 1, block.max() + 1), minlength=block.max() + 1)
        again = _best_alignment(relief, is_rock, pivot_m, count[block].astype(np.float64))
        resampled.append([*again.shift_m, again.heading_rad])
    least = np.array([LEAST_SIGMA_M, LEAST_SIGMA_M, LEAST_SIGMA_RAD])
    best = _best_alignment(relief, is_rock, pivot_m, np.ones(len(block)))
    return best, np.hypot(np.std(resampled, axis=0, ddof=1), least)


def _best_alignment(
    relief: RockRelief, is_rock: GroundRaster, pivot_m: tuple[float, float], weight: np.ndarray
) -> Alignment:
    """Where the labels fit best, with a weight for each column."""
    used = weight > 0
    x, y, worth = relief.x[used], relief.y[used], (weight * (relief.rockness - 0.5))[used]

    def gain(alignment: Alignment) -> float:
        # A sum over columns that were seen: moving labels to where no camera looked gains nothing.
        return float(np.nansum(sample_raster(is_rock, *alignment.undone(x, y)) * worth))

    return register(gain, pivot_m)


def placement_term(rig: Rig, alignment: Alignment, sigma: Float64[np.ndarray, "3"]) -> ResidualTerm:
    """Frames lie where they come when the map is moved onto the labels, jointly as certain as that motion."""
    T = rig.T_world_camera
    x, y = alignment.undone(T[:, 0, 3], T[:, 1, 3])
    target, frames = np.stack([x, y], axis=-1), len(T)

    def linearised(moved: Rig) -> Linearised:
        return _placement(moved, target, T[:, :3, :3], alignment.heading_rad)

    index = np.arange(frames)
    return ResidualTerm(linearised, index[:, None], sigma * np.sqrt(frames), 0.0, index, 1.0, estimate_noise=False)


def _placement(rig: Rig, target: np.ndarray, R_before: np.ndarray, heading_rad: float) -> Linearised:
    """Position (east, north) and heading of each frame, less their targets."""
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
