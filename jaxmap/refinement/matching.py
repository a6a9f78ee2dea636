"""Matches between frames: patches of one image found in another after both are brought to one perspective.

The disparity and the poses so far predict where each pixel of a frame lies in another one. Warped by that prediction,
the other image differs from this one only by the errors of the poses, and by noise: perspective, scale and rotation are
gone. A patch is then found by normalised cross-correlation, in a window as large as the poses may be wrong. Neighbours
are matched first, coarse to fine; then all frames that overlap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64, Int

from jaxmap.refinement.frames import EDGE_PX, DisparityFrame, sample_bilinear, unproject
from jaxmap.types import Pinhole

PATCH_PX = 21
"""Edge of a patch, at the scale of the image it is compared in."""

MIN_CORRELATION = 0.6
MIN_LEAD = 0.05
"""How far the correlation of the best place must exceed that of any other, farther away than a quarter patch."""

RANSAC_PX = 2.5
"""Matches that disagree by more with the motion of most others are dropped, at the scale they were compared in."""

MIN_MATCHES = 12

GAPS = (1, 2, 3, 5, 8)
"""A frame is compared with those so many frames before it, where they overlap,"""

RETURNS = 2
"""and with so many earlier ones that show the same place."""

MIN_OVERLAP = 0.3
"""Share of a frame's points that the other one must show."""

PATCHES = 150
WORKING_WIDTH_PX = 512
"""Images are shrunk to about so many columns: finer detail is mostly noise."""
Advance = Callable[[int], None]


class PairMatches(NamedTuple):
    """Surface points that two frames show.

    Attributes:
        uvd_px: column, row and disparity (at full size) in the source and in the target.
        T_target_source: the motion that explains them, as precise as the scale they were compared in.
    """

    uvd_px: Float64[np.ndarray, "M 2 3"]
    T_target_source: Float64[np.ndarray, "4 4"]


class MatchTable(NamedTuple):
    """Matches of all pairs of frames.

    Attributes:
        frames: (M, 2) source and target.
        uvd_px: (M, 2, 3) column, row and disparity in both.
        pairs: (M,) index of the pair of frames, from 0.
    """

    frames: Int[np.ndarray, "M 2"]
    uvd_px: Float64[np.ndarray, "M 2 3"]
    pairs: Int[np.ndarray, "M"]


def match_table(found: dict[tuple[int, int], PairMatches]) -> MatchTable:
    """Joins the matches of pairs (source, target)."""
    counts = [len(matches.uvd_px) for matches in found.values()]
    return MatchTable(
        np.repeat(np.array(list(found), int).reshape(-1, 2), counts, axis=0),
        np.concatenate([np.zeros((0, 2, 3)), *(matches.uvd_px for matches in found.values())]),
        np.repeat(np.arange(len(found)), counts),
    )


class PoseUncertainty(NamedTuple):
    """How wrong poses may be, as standard deviations of each axis."""

    position_m: float
    angle_rad: float


def match_neighbours(
    frames: Sequence[DisparityFrame],
    T_world_camera: np.ndarray,
    camera: Pinhole,
    uncertainty: PoseUncertainty,
    depth_range_m: tuple[float, float],
    advance: Advance,
) -> dict[tuple[int, int], PairMatches]:
    """Matches each frame with the one before it, or with the one before that where these two share nothing.

    Windows go from as large as the poses may be wrong down to a few pixels.
    """
    scale = _working_scale(frames[0])
    fine = PatchSearch(scale, 12, PATCHES, depth_range_m)

    def coarse_to_fine(source: DisparityFrame, target: DisparityFrame, T: np.ndarray) -> PairMatches | None:
        near_m = float(np.nanmedian(camera.baseline_m * camera.fx_px / (source.disparity_px + camera.doffs_px)))
        # Both poses are wrong; 2.5 sigma of their difference is enough for most patches.
        off_px = 2.5 * np.sqrt(2) * camera.fx_px * (uncertainty.position_m / near_m + uncertainty.angle_rad)
        for coarse in (2 * scale, scale):
            radius = int(np.clip(off_px / coarse, 4, max(source.image.shape) / coarse / 3))
            rough = match_pair(source, target, T, camera, PatchSearch(coarse, radius, PATCHES, depth_range_m))
            if rough is not None:
                return match_pair(source, target, rough.T_target_source, camera, fine) or rough
        return None

    found: dict[tuple[int, int], PairMatches] = {}
    for source in range(1, len(frames)):
        for target in range(source - 1, max(source - 3, -1), -1):
            T = np.linalg.inv(T_world_camera[target]) @ T_world_camera[source]
            if matches := coarse_to_fine(frames[source], frames[target], T):
                found[source, target] = matches
                break
        advance(source)
    return found


def match_overlapping(
    frames: Sequence[DisparityFrame],
    T_world_camera: np.ndarray,
    camera: Pinhole,
    depth_range_m: tuple[float, float],
    radius_px: int,
    advance: Advance,
) -> dict[tuple[int, int], PairMatches]:
    """Matches all pairs that overlap, within so many pixels of where the poses predict."""
    search = PatchSearch(_working_scale(frames[0]), radius_px, PATCHES, depth_range_m)
    found: dict[tuple[int, int], PairMatches] = {}
    for source in range(1, len(frames)):
        points = _coarse_points(frames[source], camera, depth_range_m)
        for target in _overlapping_before(source, points, T_world_camera, camera, frames[source].image.shape):
            T = np.linalg.inv(T_world_camera[target]) @ T_world_camera[source]
            if matches := match_pair(frames[source], frames[target], T, camera, search):
                found[source, target] = matches
        advance(source)
    return found


def _working_scale(frame: DisparityFrame) -> int:
    """What images are shrunk by."""
    return max(1, round(frame.image.shape[1] / WORKING_WIDTH_PX))


def _coarse_points(
    frame: DisparityFrame, camera: Pinhole, depth_range_m: tuple[float, float]
) -> Float64[np.ndarray, "P 3"]:
    """A few hundred points in range, spread over the image, in the camera frame."""
    height, width = frame.image.shape
    rows, columns = np.mgrid[height // 48 : height : max(height // 24, 1), width // 64 : width : max(width // 32, 1)]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=-1).astype(np.float64)
    disparity = frame.disparity_px[rows.ravel(), columns.ravel()].astype(np.float64)
    points = unproject(camera, pixels, np.nan_to_num(disparity, nan=-camera.doffs_px))
    return points[(points[:, 2] > depth_range_m[0]) & (points[:, 2] < depth_range_m[1])]


def _overlapping_before(
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


class PatchSearch(NamedTuple):
    """How patches are searched for.

    Attributes:
        scale: images are shrunk by it.
        radius_px: of the window, at that scale.
        patches: how many in a pair of frames.
        depth_range_m: of the points whose patches are searched for.
    """

    scale: int
    radius_px: int
    patches: int
    depth_range_m: tuple[float, float]


def match_pair(
    source: DisparityFrame,
    target: DisparityFrame,
    T_target_source: Float64[np.ndarray, "4 4"],
    camera: Pinhole,
    search: PatchSearch,
) -> PairMatches | None:
    """Matches patches of a frame in another one.

    Args:
        source: the frame whose patches are searched for.
        target: where they are searched for.
        T_target_source: the motion between them as far as it is known.
        camera: of both.
        search: scale, window and number of patches.

    Returns:
        The matches that one motion of the camera explains; None where there are too few.
    """
    small = [_shrunk(frame.image, search.scale) for frame in (source, target)]
    height, width = small[0].shape
    maps = _warp_maps(source, T_target_source, camera, search.scale, (height, width))
    warped = cv2.remap(small[1], *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(0,))
    inside = (maps[0] >= 0) & (maps[0] <= width - 1) & (maps[1] >= 0) & (maps[1] <= height - 1)
    corners = _corners(source, small[0], inside, camera, search)
    found = [_locate_patch(small[0], warped, inside, corner, search.radius_px) for corner in corners]
    kept = [index for index, place in enumerate(found) if place is not None]
    if len(kept) < MIN_MATCHES:
        return None
    places = np.array([found[index] for index in kept], np.float64)
    source_px = _full_size(corners[kept].astype(np.float64), search.scale)
    at_target = np.stack([sample_bilinear(maps[axis], places) for axis in range(2)], axis=-1)
    target_px = _full_size(at_target, search.scale)
    seen = [
        np.column_stack([pixels, sample_bilinear(frame.disparity_px, pixels)])
        for frame, pixels in ((source, source_px), (target, target_px))
    ]
    uvd_px = np.stack(seen, axis=1)
    return _explained_by_one_motion(uvd_px[np.isfinite(uvd_px).all(axis=(1, 2))], camera, RANSAC_PX * search.scale)


def _shrunk(image: np.ndarray, scale: int) -> np.ndarray:
    if scale == 1:
        return image
    height, width = (length // scale * scale for length in image.shape)
    return cv2.resize(image[:height, :width], None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)


def _full_size(pixels: np.ndarray, scale: int) -> np.ndarray:
    """Pixel centres are whole numbers at every scale."""
    return (pixels + 0.5) * scale - 0.5


def _warp_maps(
    source: DisparityFrame, T_target_source: np.ndarray, camera: Pinhole, scale: int, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Where the pixels of the small source lie in the small target: two float32 maps, -1e6 behind the camera."""
    row, column = np.indices(shape)
    pixels = _full_size(np.stack([column.ravel(), row.ravel()], axis=-1).astype(np.float64), scale)
    nearest = np.clip(np.rint(pixels).astype(int), 0, np.array(source.filled_px.shape)[::-1] - 1)
    points = unproject(camera, pixels, source.filled_px[nearest[:, 1], nearest[:, 0]].astype(np.float64))
    x, y, z = (points @ T_target_source[:3, :3].T + T_target_source[:3, 3]).T
    ahead = z > 0.1
    z = np.where(ahead, z, 1.0)
    found = []
    for focal_px, centre_px, across in ((camera.fx_px, camera.cx_px, x), (camera.fy_px, camera.cy_px, y)):
        full = focal_px * across / z + centre_px
        found.append(np.where(ahead, (full + 0.5) / scale - 0.5, -1e6).astype(np.float32).reshape(shape))
    return found[0], found[1]


def _corners(
    source: DisparityFrame, small: np.ndarray, inside: np.ndarray, camera: Pinhole, search: PatchSearch
) -> np.ndarray:
    """Textured pixels (column, row) on smooth surfaces in range, spread over what both frames show; (N, 2) int."""
    height, width = small.shape
    half, scale = PATCH_PX // 2, search.scale
    disparity = source.disparity_px[scale // 2 :: scale, scale // 2 :: scale][:height, :width]
    filled = np.nan_to_num(disparity, nan=-1e3)
    square = np.ones((5, 5), np.uint8)
    smooth = cv2.dilate(filled, square) - cv2.erode(filled, square) < EDGE_PX * scale
    depth_m = camera.baseline_m * camera.fx_px / np.maximum(np.nan_to_num(disparity) + camera.doffs_px, 1e-3)
    usable = smooth & (depth_m > search.depth_range_m[0]) & (depth_m < search.depth_range_m[1])
    usable &= cv2.erode(inside.astype(np.uint8), np.ones((PATCH_PX, PATCH_PX), np.uint8)) > 0
    usable[:half], usable[-half:], usable[:, :half], usable[:, -half:] = False, False, False, False
    if not usable.any():
        return np.empty((0, 2), int)
    spacing = max(3.0, np.sqrt(usable.sum() / search.patches) * 0.7)
    corners = cv2.goodFeaturesToTrack(small, search.patches, 1e-3, spacing, mask=usable.astype(np.uint8), blockSize=5)
    return np.empty((0, 2), int) if corners is None else np.rint(corners.reshape(-1, 2)).astype(int)


def _locate_patch(small: np.ndarray, warped: np.ndarray, inside: np.ndarray, corner: np.ndarray, radius: int):
    """Where the patch around a pixel is in the warped image, to a fraction of a pixel; None where that is ambiguous."""
    half = PATCH_PX // 2
    column, row = corner
    height, width = small.shape
    left, right = max(0, column - half - radius), min(width, column + half + radius + 1)
    top, bottom = max(0, row - half - radius), min(height, row + half + radius + 1)
    patch = small[row - half : row + half + 1, column - half : column + half + 1]
    if patch.std() < 1.0:
        return None
    scores = cv2.matchTemplate(warped[top:bottom, left:right], patch, cv2.TM_CCOEFF_NORMED)
    # A patch that lies partly outside the target cannot be compared.
    centres = inside[top + half : bottom - half, left + half : right - half]
    scores = np.where(centres & np.isfinite(scores), scores, -1.0)
    y, x = np.unravel_index(int(scores.argmax()), scores.shape)
    best = float(scores[y, x])
    if best < MIN_CORRELATION or not (0 < y < scores.shape[0] - 1 and 0 < x < scores.shape[1] - 1):
        return None
    near = max(2, PATCH_PX // 4)
    others = scores.copy()
    others[max(0, y - near) : y + near + 1, max(0, x - near) : x + near + 1] = -1.0
    if best - others.max() < MIN_LEAD and others.max() > -1.0:
        return None
    dx, dy = _parabola_peak(scores[y, x - 1 : x + 2]), _parabola_peak(scores[y - 1 : y + 2, x])
    return left + half + x + dx, top + half + y + dy


def _parabola_peak(three: np.ndarray) -> float:
    """Where the parabola through three values has its maximum, within half a step of the middle."""
    curvature = float(three[0] - 2 * three[1] + three[2])
    return float(np.clip((three[0] - three[2]) / (2 * curvature), -0.5, 0.5)) if curvature < -1e-9 else 0.0


def _explained_by_one_motion(
    uvd_px: Float64[np.ndarray, "M 2 3"], camera: Pinhole, within_px: float
) -> PairMatches | None:
    """The matches that one motion of the camera explains; None where these are few."""
    if len(uvd_px) < MIN_MATCHES:
        return None
    points = unproject(camera, uvd_px[:, 0, :2], uvd_px[:, 0, 2])
    K = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    cv2.setRNGSeed(0)
    try:
        found, rotation, translation, inliers = cv2.solvePnPRansac(
            points,
            np.ascontiguousarray(uvd_px[:, 1, :2]),
            K,
            np.zeros(4),
            iterationsCount=300,
            reprojectionError=within_px,
            confidence=0.999,
        )
    except cv2.error:
        return None
    if not found or inliers is None or len(inliers) < max(MIN_MATCHES, 0.25 * len(uvd_px)):
        return None
    T_target_source = np.eye(4)
    T_target_source[:3, :3], T_target_source[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
    return PairMatches(uvd_px[np.sort(np.asarray(inliers, np.int64).ravel())], T_target_source)
