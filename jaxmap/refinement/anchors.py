"""What ties a map to the ground: heights of an elevation model, and rocks of a labelled orthomosaic.

Frames that agree with each other say nothing of where all of them are. An elevation model does: a point's height above it
is a residual of its own. So does an orthomosaic in which rocks are labelled: points that rise from their surroundings
belong inside its rocks, and points of the flat outside. How far they are off is their distance from the nearest edge,
which is zero, without slope, for all points that lie where they belong.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates, percentile_filter

from jaxmap.fusion.splat import splat_columns
from jaxmap.refinement.rig import Rig
from jaxmap.refinement.solve import Term
from jaxmap.refinement.terms import Surface, linearise, make_setting
from jaxmap.refinement.views import Pinhole, View, smooth_pixels, to_points
from jaxmap.types import GridSpec, make_grid

MAX_CELLS = 4_000_000
GROUND_WINDOW_M = 1.2
"""The ground around a point: the lower quarter of the heights within such a square."""

ROCK_RISES_M, GROUND_RISES_M = 0.1, 0.03
"""A point that rises more than the first above the ground is rock, less than the second ground; between, neither."""

NEAR_EDGE_M = 0.6
"""Only points so near the edge of a labelled rock tell anything."""

EDGE_PLAY_M = 0.03
"""Points may lie on the wrong side of an edge by so much: steep faces come out of stereo a little too near."""

HEIGHT_SIGMA_M, EDGE_SIGMA_M = 0.03, 0.05
FRAME_WORTH = 30.0
"""Errors within a frame are alike: its points count as so many independent ones, at most."""


class Points(NamedTuple):
    """Points drawn from the frames: which frame, and column, row and disparity."""

    frames: Int[np.ndarray, "P"]
    seen_px: Float64[np.ndarray, "P 3"]


def draw_points(
    views: Sequence[View], camera: Pinhole, depth_range_m: tuple[float, float], per_frame: int
) -> Points:
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


def _surface(raster: Raster, values: np.ndarray, origin_m: np.ndarray, rises: float) -> Surface:
    """A raster as the residuals take it: relative to an origin, known where the values are finite."""
    known = np.isfinite(values)
    lower = np.append(raster.lower_m - origin_m[:2], -1e4)
    upper = np.append(lower[:2] + np.array(values.shape) * raster.cell_m, 1e4)
    grid = make_grid(lower.tolist(), upper.tolist(), [raster.cell_m, raster.cell_m, 2e4])
    grid = GridSpec(grid.origin_m, grid.voxel_size_m, (*values.shape, 1))
    fields = np.stack([np.where(known, values, 0.0), known.astype(np.float64)])
    return Surface(grid, jnp.asarray(fields, jnp.float32), jnp.asarray(rises, jnp.float32))


def _term(
    points: Points, camera: Pinhole, surface: Surface, origin_m: np.ndarray, sigma_m: float, noise: float, adapts: bool
) -> Term:
    frames, seen = points.frames[:, None], points.seen_px[:, None]
    return Term(
        lambda rig: linearise(make_setting(rig, camera, origin_m), frames, seen, surface),
        frames,
        np.array([sigma_m]),
        noise,
        points.frames,
        FRAME_WORTH,
        adapts,
    )


def height_term(
    points: Points, camera: Pinhole, heights: Raster, origin_m: np.ndarray, disparity_sigma_px: float, blur_m: float = 0.0
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
    values = heights.values - origin_m[2]
    if blur_m:
        known = np.isfinite(values)
        weight = gaussian_filter(known.astype(np.float64), blur_m / heights.cell_m)
        smooth = gaussian_filter(np.where(known, values, 0.0), blur_m / heights.cell_m)
        values = np.where(known, smooth / np.maximum(weight, 1e-3), np.nan)
    surface = _surface(heights, -values, origin_m, 1.0)
    return _term(points, camera, surface, origin_m, HEIGHT_SIGMA_M + 0.2 * blur_m, disparity_sigma_px, True)


def rises_m(xyz: Float64[np.ndarray, "P 3"], cell_m: float = 0.05) -> Float64[np.ndarray, "P"]:
    """How far points rise above the ground around them, as all points together show it."""
    lower = np.floor(xyz.min(axis=0) / cell_m) * cell_m - cell_m
    cell_m = max(cell_m, float(np.sqrt(np.prod(np.ptp(xyz[:, :2], axis=0)) / MAX_CELLS)))
    upper = xyz.max(axis=0) + cell_m
    local = np.append(lower[:2], 0.0)
    grid = make_grid([0.0, 0.0, lower[2]], [*(upper - lower)[:2], upper[2]], [cell_m, cell_m, upper[2] - lower[2]])
    values = jnp.asarray(np.stack([np.ones(len(xyz)), xyz[:, 2] - lower[2]]), jnp.float32)
    weight, total = np.asarray(
        splat_columns(grid, jnp.asarray(xyz - local, jnp.float32), values, jnp.ones(len(xyz), bool)), np.float64
    )
    height = np.where(weight > 0.2, total / np.maximum(weight, 0.2), np.nan)
    nearest = distance_transform_edt(~np.isfinite(height), return_distances=False, return_indices=True)
    assert isinstance(nearest, np.ndarray)
    # Coarser for the filter, whose time grows with the window.
    step = max(1, int(round(0.15 / cell_m)))
    coarse = height[tuple(nearest)][::step, ::step]
    window = max(3, int(GROUND_WINDOW_M / cell_m / step) | 1)
    ground = gaussian_filter(percentile_filter(coarse, 25, size=window), 1.0)
    at = [(xyz[:, axis] - lower[axis]) / (cell_m * step) for axis in (0, 1)]
    return xyz[:, 2] - lower[2] - map_coordinates(ground, at, order=1, mode="nearest")


def edge_terms(
    rig: Rig,
    points: Points,
    camera: Pinhole,
    is_rock: Raster,
    origin_m: np.ndarray,
    disparity_sigma_px: float,
) -> list[Term]:
    """Rocks and ground against labels from above.

    Args:
        rig: where the points are so far.
        points: of all frames, densely.
        camera: of all frames.
        is_rock: 1 rock, 0 no rock, NaN unlabelled.
        origin_m: what float32 positions are relative to.
        disparity_sigma_px: of the points' disparity.
    """
    xyz = points_world(rig, camera, points)
    rises = rises_m(xyz)
    rock = is_rock.values > 0.5
    if not rock.any() or rock.all():
        return []
    outside_m = distance_transform_edt(~rock) * is_rock.cell_m
    inside_m = distance_transform_edt(rock) * is_rock.cell_m
    assert isinstance(outside_m, np.ndarray) and isinstance(inside_m, np.ndarray)
    signed = is_rock._replace(values=np.where(rock, 0.5 * is_rock.cell_m - inside_m, outside_m - 0.5 * is_rock.cell_m))
    at = sample_raster(signed, xyz[:, 0], xyz[:, 1])
    near = np.abs(at) < NEAR_EDGE_M
    terms = []
    for chosen, sign in ((near & (rises > ROCK_RISES_M), 1.0), (near & (np.abs(rises) < GROUND_RISES_M), -1.0)):
        kept = _one_in_each_cell(points, xyz, chosen, is_rock.cell_m)
        if len(kept.frames):
            field = np.where(np.isfinite(is_rock.values), np.maximum(sign * signed.values - EDGE_PLAY_M, 0.0), np.nan)
            surface = _surface(signed, field, origin_m, 0.0)
            terms.append(_term(kept, camera, surface, origin_m, EDGE_SIGMA_M, disparity_sigma_px, False))
    return terms


def _one_in_each_cell(points: Points, xyz: np.ndarray, chosen: Bool[np.ndarray, "P"], cell_m: float) -> Points:
    """Of the chosen points in a cell, the one of the greatest disparity: area is compared, not pixels.

    A steep face fills many pixels and hardly a cell.
    """
    rows = np.flatnonzero(chosen)
    rows = rows[np.argsort(-points.seen_px[rows, 2], kind="stable")]
    cells = np.floor(xyz[rows, :2] / cell_m).astype(np.int64)
    _, first = np.unique(cells, axis=0, return_index=True)
    index = rows[np.sort(first)]
    return Points(points.frames[index], points.seen_px[index])
