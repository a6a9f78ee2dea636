"""What ties a map to the ground: heights of an elevation model.

Frames that agree with each other say nothing of where all of them are. An elevation model does: a point's height above
it is a residual of its own. It tells height, roll and pitch, and by the relief of the ground place and heading too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64, Int
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import KDTree

from jaxmap.refinement.rig import Rig
from jaxmap.refinement.solve import Term
from jaxmap.refinement.terms import Surface, linearise, make_setting
from jaxmap.refinement.views import Pinhole, View, smooth_pixels, to_points
from jaxmap.types import GridSpec

CONTACT_RADIUS_M = 0.4
"""Ground so near a place of the camera, seen from above, is as high as that below it."""

HEIGHT_SIGMA_M = 0.03
FRAME_WORTH = 30.0
"""Errors within a frame are alike: its points count as so many independent ones, at most."""


class Points(NamedTuple):
    """Points drawn from the frames: which frame, and column, row and disparity."""

    frames: Int[np.ndarray, "P"]
    seen_px: Float64[np.ndarray, "P 3"]


def draw_points(views: Sequence[View], camera: Pinhole, depth_range_m: tuple[float, float], per_frame: int) -> Points:
    """Points of a regular raster of pixels in each frame, within a range of depths."""
    frames, seen = [], []
    for index, view in enumerate(views):
        height, width = view.image.shape
        step = max(1, int(np.sqrt(height * width / per_frame)))
        rows, columns = (part.ravel() for part in np.mgrid[step // 2 : height : step, step // 2 : width : step])
        disparity = view.disparity_px[rows, columns].astype(np.float64)
        depth_m = camera.baseline_m * camera.fx_px / np.maximum(disparity + camera.doffs_px, 1e-6)
        good = smooth_pixels(view)[rows, columns] & (depth_m > depth_range_m[0]) & (depth_m < depth_range_m[1])
        seen.append(np.column_stack([columns, rows, disparity])[good])
        frames.append(np.full(int(good.sum()), index))
    return Points(np.concatenate(frames), np.concatenate(seen))


def points_world(rig: Rig, camera: Pinhole, points: Points) -> Float64[np.ndarray, "P 3"]:
    """Where points are in the world, by a rig."""
    calibrated = camera._replace(
        baseline_m=camera.baseline_m * float(np.exp(rig.log_baseline_scale)), doffs_px=camera.doffs_px + rig.offset_px
    )
    local = to_points(calibrated, points.seen_px[:, :2], points.seen_px[:, 2])
    T = rig.T_world_camera[points.frames]
    return np.einsum("pij,pj->pi", T[:, :3, :3], local) + T[:, :3, 3]


class Raster(NamedTuple):
    """Values on a regular grid of the world, x first, NaN where unknown: cell `i` spans `[i, i + 1) * cell_m`."""

    values: Float64[np.ndarray, "X Y"]
    lower_m: Float64[np.ndarray, "2"]
    cell_m: float


def sample_raster(raster: Raster, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values between cell centres, NaN outside or beside an unknown cell."""
    at = [(x - raster.lower_m[0]) / raster.cell_m - 0.5, (y - raster.lower_m[1]) / raster.cell_m - 0.5]
    return map_coordinates(raster.values, at, order=1, cval=np.nan)


def _surface(heights: Raster, values: np.ndarray, origin_m: np.ndarray) -> Surface:
    """Heights as the residuals take them: relative to an origin, known where they are finite."""
    known = np.isfinite(values)
    lower = np.append(heights.lower_m - origin_m[:2], -1.0)
    size = [heights.cell_m, heights.cell_m, 2.0]
    grid = GridSpec(jnp.asarray(lower, jnp.float32), jnp.asarray(size, jnp.float32), (*values.shape, 1))
    fields = np.stack([np.where(known, values - origin_m[2], 0.0), known.astype(np.float64)])
    return Surface(grid, jnp.asarray(fields, jnp.float32))


def height_term(
    points: Points,
    camera: Pinhole,
    heights: Raster,
    origin_m: np.ndarray,
    disparity_sigma_px: float,
    blur_m: float = 0.0,
) -> Term:
    """Points on an elevation model.

    Args:
        points: of all frames.
        camera: of all frames.
        heights: the model.
        origin_m: what float32 positions are relative to.
        disparity_sigma_px: of the points' disparity.
        blur_m: the model is smoothed over so much, to find the way from afar.
    """
    values = heights.values
    if blur_m:
        known = np.isfinite(values)
        weight = gaussian_filter(known.astype(np.float64), blur_m / heights.cell_m)
        smooth = gaussian_filter(np.where(known, values, 0.0), blur_m / heights.cell_m)
        values = np.where(known, smooth / np.maximum(weight, 1e-3), np.nan)
    surface = _surface(heights, values, origin_m)
    frames, seen = points.frames[:, None], points.seen_px[:, None]
    return Term(
        lambda rig: linearise(make_setting(rig, camera, origin_m), frames, seen, surface),
        frames,
        np.array([HEIGHT_SIGMA_M + 0.2 * blur_m]),
        disparity_sigma_px,
        points.frames,
        FRAME_WORTH,
    )


def ground_contact(track_m: Float64[np.ndarray, "N 3"], below_m: float) -> Raster:
    """The ground that a rover drives over, as its given poses tell it: so far below the camera, around each of them."""
    lower = track_m[:, :2].min(axis=0) - CONTACT_RADIUS_M
    cell_m = CONTACT_RADIUS_M / 4
    shape = np.ceil((track_m[:, :2].max(axis=0) + CONTACT_RADIUS_M - lower) / cell_m).astype(int)
    x, y = (lower[axis] + (np.arange(shape[axis]) + 0.5) * cell_m for axis in (0, 1))
    # Near a camera, the height of the nearest one; elsewhere nothing is known.
    distance, nearest = KDTree(track_m[:, :2]).query(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1))
    return Raster(np.where(distance < CONTACT_RADIUS_M, track_m[nearest, 2] - below_m, np.nan), lower, cell_m)
