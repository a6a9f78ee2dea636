"""Which frames are compared, and what they show in common: from neighbours far apart to all that overlap."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int

from jaxmap.refinement.matching import PairMatches, Search, match_pair
from jaxmap.refinement.views import Pinhole, View, to_points

GAPS = (1, 2, 3, 5, 8)
"""A frame is compared with those so many frames before it, where they overlap,"""

RETURNS = 2
"""and with so many of those from longer ago that show the same place."""

MIN_OVERLAP = 0.3
"""Share of a view's points that the other one must show."""

PATCHES = 150
WORKING_WIDTH_PX = 512
"""Images are shrunk to about so many columns: their noise is in the finer detail."""

Advance = Callable[[int], None]


class MatchTable(NamedTuple):
    """Matches of all pairs.

    Attributes:
        frames: (M, 2) source and target.
        seen_px: (M, 2, 3) column, row and disparity in both.
        pairs: (M,) which pair of frames, from 0.
    """

    frames: Int[np.ndarray, "M 2"]
    seen_px: Float64[np.ndarray, "M 2 3"]
    pairs: Int[np.ndarray, "M"]


def table(found: dict[tuple[int, int], PairMatches]) -> MatchTable:
    """Joins the matches of pairs (source, target)."""
    counts = [len(matches.seen_px) for matches in found.values()]
    return MatchTable(
        np.repeat(np.array(list(found), int).reshape(-1, 2), counts, axis=0),
        np.concatenate([np.zeros((0, 2, 3)), *(matches.seen_px for matches in found.values())]),
        np.repeat(np.arange(len(found)), counts),
    )


class Reach(NamedTuple):
    """How far poses may be off, one sigma, and which depths are compared."""

    position_m: float
    angle_rad: float
    depth_range_m: tuple[float, float]


def match_chain(
    views: Sequence[View], T_world_camera: np.ndarray, camera: Pinhole, reach: Reach, advance: Advance
) -> dict[tuple[int, int], PairMatches]:
    """Matches each frame with the one before it, from windows as large as the poses may be off down to a few pixels.

    Where two neighbours share nothing, the frame is compared with the one before those.
    """
    found: dict[tuple[int, int], PairMatches] = {}
    for source in range(1, len(views)):
        for target in range(source - 1, max(source - 3, -1), -1):
            T = np.linalg.inv(T_world_camera[target]) @ T_world_camera[source]
            if matches := _from_afar(views[source], views[target], T, camera, reach):
                found[source, target] = matches
                break
        advance(source)
    return found


def _from_afar(
    source: View, target: View, T_target_source: np.ndarray, camera: Pinhole, reach: Reach
) -> PairMatches | None:
    scale = working_scale(source)
    near_m = float(np.nanmedian(camera.baseline_m * camera.fx_px / (source.disparity_px + camera.doffs_px)))
    # Two poses err, and 2.5 sigma of their difference is enough for most patches.
    off_px = 2.5 * np.sqrt(2) * camera.fx_px * (reach.position_m / near_m + reach.angle_rad)
    for coarse in (2 * scale, scale):
        radius = int(np.clip(off_px / coarse, 4, max(source.image.shape) / coarse / 3))
        search = Search(coarse, radius, PATCHES, reach.depth_range_m)
        rough = match_pair(source, target, T_target_source, camera, search)
        if rough is None:
            continue
        fine = Search(scale, 12, PATCHES, reach.depth_range_m)
        return match_pair(source, target, rough.T_target_source, camera, fine) or rough
    return None


def match_overlapping(
    views: Sequence[View],
    T_world_camera: np.ndarray,
    camera: Pinhole,
    depth_range_m: tuple[float, float],
    radius_px: int,
    advance: Advance,
) -> dict[tuple[int, int], PairMatches]:
    """Matches all pairs that overlap, within so many pixels of where the poses say."""
    search = Search(working_scale(views[0]), radius_px, PATCHES, depth_range_m)
    found: dict[tuple[int, int], PairMatches] = {}
    seen = [_some_points(view, camera, depth_range_m) for view in views]
    for source in range(1, len(views)):
        for target in _partners(source, seen[source], T_world_camera, camera, views[source].image.shape):
            T = np.linalg.inv(T_world_camera[target]) @ T_world_camera[source]
            if matches := match_pair(views[source], views[target], T, camera, search):
                found[source, target] = matches
        advance(source)
    return found


def working_scale(view: View) -> int:
    """What images are shrunk by."""
    return max(1, round(view.image.shape[1] / WORKING_WIDTH_PX))


def _some_points(view: View, camera: Pinhole, depth_range_m: tuple[float, float]) -> Float64[np.ndarray, "P 3"]:
    """A few hundred points in range, spread over the image, in the camera frame."""
    height, width = view.image.shape
    rows, columns = np.mgrid[height // 48 : height : max(height // 24, 1), width // 64 : width : max(width // 32, 1)]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=-1).astype(np.float64)
    disparity = view.disparity_px[rows.ravel(), columns.ravel()].astype(np.float64)
    points = to_points(camera, pixels, np.nan_to_num(disparity, nan=-camera.doffs_px))
    return points[(points[:, 2] > depth_range_m[0]) & (points[:, 2] < depth_range_m[1])]


def _partners(
    source: int, points: np.ndarray, T_world_camera: np.ndarray, camera: Pinhole, shape: tuple[int, ...]
) -> list[int]:
    """Earlier frames that show enough of what a frame shows."""
    if not len(points):
        return []
    T_target_source = np.linalg.inv(T_world_camera[:source]) @ T_world_camera[source]
    moved = np.einsum("tij,pj->tpi", T_target_source[:, :3, :3], points) + T_target_source[:, None, :3, 3]
    depth = np.where(moved[..., 2] > 0.1, moved[..., 2], np.nan)
    column = camera.fx_px * moved[..., 0] / depth + camera.cx_px
    row = camera.fy_px * moved[..., 1] / depth + camera.cy_px
    inside = (column > 0) & (column < shape[1] - 1) & (row > 0) & (row < shape[0] - 1)
    overlap = inside.mean(axis=1)
    recent = [source - gap for gap in GAPS if gap <= source]
    before = [target for target in np.argsort(-overlap).tolist() if target < source - GAPS[-1]][:RETURNS]
    return [target for target in recent + before if overlap[target] >= MIN_OVERLAP]
