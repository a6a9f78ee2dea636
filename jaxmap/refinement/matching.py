"""Where one frame shows what another one shows: patches compared after the views were brought to one perspective.

The disparity and the poses so far tell where each pixel of a view lies in another one. The other image, drawn into this
view by them, differs from it only by what the poses are wrong by, and by noise: perspective, scale and turn are gone. A
patch is then found by normalised cross-correlation within a window as large as the poses may be wrong.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64

from jaxmap.refinement.views import EDGE_PX, Pinhole, View, bilinear, to_points

PATCH_PX = 21
"""Edge of a patch, at the scale of the image it is compared in."""

MIN_CORRELATION = 0.6
MIN_LEAD = 0.05
"""By how much the correlation of the best place is above that of any other, farther than a patch's quarter."""

RANSAC_PX = 2.5
"""Matches that disagree by more with the motion of most others are dropped, at the scale they were compared in."""

MIN_MATCHES = 12


class PairMatches(NamedTuple):
    """Surface points that two views show.

    Attributes:
        seen_px: column, row and disparity (of full size) in the source and in the target.
        T_target_source: the motion that explains them, as good as the scale they were compared in.
    """

    seen_px: Float64[np.ndarray, "M 2 3"]
    T_target_source: Float64[np.ndarray, "4 4"]


class Search(NamedTuple):
    """How patches are looked for.

    Attributes:
        scale: images are shrunk by it.
        radius_px: of the window, at that scale.
        patches: how many in a pair of views.
        depth_range_m: of points that are looked for.
    """

    scale: int
    radius_px: int
    patches: int
    depth_range_m: tuple[float, float]


def match_pair(
    source: View, target: View, T_target_source: Float64[np.ndarray, "4 4"], camera: Pinhole, search: Search
) -> PairMatches | None:
    """Matches patches of a view in another one.

    Args:
        source: the view whose patches are looked for.
        target: where they are looked for.
        T_target_source: the motion between them as far as it is known.
        camera: of both.
        search: how.

    Returns:
        The matches that one motion of the camera explains; None where few do.
    """
    small = [_shrunk(view.image, search.scale) for view in (source, target)]
    height, width = small[0].shape
    drawn_at = _warp(source, T_target_source, camera, search.scale, (height, width))
    drawn = cv2.remap(small[1], *drawn_at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(0,))
    inside = _inside(drawn_at, (height, width))
    corners = _corners(source, small[0], inside, camera, search)
    found = [_find(small[0], drawn, inside, corner, search.radius_px) for corner in corners]
    kept = [index for index, place in enumerate(found) if place is not None]
    if len(kept) < MIN_MATCHES:
        return None
    places = np.array([found[index] for index in kept], np.float64)
    source_px = _full_size(corners[kept].astype(np.float64), search.scale)
    at_target = np.stack([bilinear(drawn_at[axis], places) for axis in range(2)], axis=-1)
    target_px = _full_size(at_target, search.scale)
    seen = [
        np.column_stack([pixels, bilinear(view.disparity_px, pixels)])
        for view, pixels in ((source, source_px), (target, target_px))
    ]
    seen_px = np.stack(seen, axis=1)
    return _agreeing(seen_px[np.isfinite(seen_px).all(axis=(1, 2))], camera, RANSAC_PX * search.scale)


def _shrunk(image: np.ndarray, scale: int) -> np.ndarray:
    if scale == 1:
        return image
    height, width = (length // scale * scale for length in image.shape)
    return cv2.resize(image[:height, :width], None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)


def _full_size(pixels: np.ndarray, scale: int) -> np.ndarray:
    """Pixel centres are whole numbers at every scale."""
    return (pixels + 0.5) * scale - 0.5


def _warp(
    source: View, T_target_source: np.ndarray, camera: Pinhole, scale: int, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Where the pixels of the small source lie in the small target: two float32 maps, -1e6 behind the camera."""
    row, column = np.indices(shape)
    pixels = _full_size(np.stack([column.ravel(), row.ravel()], axis=-1).astype(np.float64), scale)
    nearest = np.clip(np.rint(pixels).astype(int), 0, np.array(source.filled_px.shape)[::-1] - 1)
    points = to_points(camera, pixels, source.filled_px[nearest[:, 1], nearest[:, 0]].astype(np.float64))
    x, y, z = (points @ T_target_source[:3, :3].T + T_target_source[:3, 3]).T
    ahead = z > 0.1
    z = np.where(ahead, z, 1.0)
    found = []
    for focal_px, centre_px, across in ((camera.fx_px, camera.cx_px, x), (camera.fy_px, camera.cy_px, y)):
        full = focal_px * across / z + centre_px
        found.append(np.where(ahead, (full + 0.5) / scale - 0.5, -1e6).astype(np.float32).reshape(shape))
    return found[0], found[1]


def _inside(maps: tuple[np.ndarray, np.ndarray], shape: tuple[int, int]) -> np.ndarray:
    height, width = shape
    return (maps[0] >= 0) & (maps[0] <= width - 1) & (maps[1] >= 0) & (maps[1] <= height - 1)


def _corners(source: View, small: np.ndarray, inside: np.ndarray, camera: Pinhole, search: Search) -> np.ndarray:
    """Textured pixels (column, row) on smooth surfaces in range, spread over what both views show; (N, 2) int."""
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


def _find(small: np.ndarray, drawn: np.ndarray, inside: np.ndarray, corner: np.ndarray, radius: int):
    """Where the patch around a pixel is in the drawn image, to a part of a pixel; None where that is not clear."""
    half = PATCH_PX // 2
    column, row = corner
    height, width = small.shape
    left, right = max(0, column - half - radius), min(width, column + half + radius + 1)
    top, bottom = max(0, row - half - radius), min(height, row + half + radius + 1)
    patch = small[row - half : row + half + 1, column - half : column + half + 1]
    if patch.std() < 1.0:
        return None
    scores = cv2.matchTemplate(drawn[top:bottom, left:right], patch, cv2.TM_CCOEFF_NORMED)
    # Where what is compared lies partly outside the target, the comparison means nothing.
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
    dx, dy = _vertex(scores[y, x - 1 : x + 2]), _vertex(scores[y - 1 : y + 2, x])
    return left + half + x + dx, top + half + y + dy


def _vertex(three: np.ndarray) -> float:
    """Where the parabola through three values is greatest, within half a step of the middle."""
    curvature = float(three[0] - 2 * three[1] + three[2])
    return float(np.clip((three[0] - three[2]) / (2 * curvature), -0.5, 0.5)) if curvature < -1e-9 else 0.0


def _agreeing(seen_px: Float64[np.ndarray, "M 2 3"], camera: Pinhole, within_px: float) -> PairMatches | None:
    """The matches that one motion of the camera explains; None where few do."""
    if len(seen_px) < MIN_MATCHES:
        return None
    points = to_points(camera, seen_px[:, 0, :2], seen_px[:, 0, 2])
    K = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    cv2.setRNGSeed(0)
    try:
        found, rotation, translation, inliers = cv2.solvePnPRansac(
            points,
            np.ascontiguousarray(seen_px[:, 1, :2]),
            K,
            np.zeros(4),
            iterationsCount=300,
            reprojectionError=within_px,
            confidence=0.999,
        )
    except cv2.error:
        return None
    if not found or inliers is None or len(inliers) < max(MIN_MATCHES, 0.25 * len(seen_px)):
        return None
    T_target_source = np.eye(4)
    T_target_source[:3, :3], T_target_source[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
    return PairMatches(seen_px[np.sort(np.asarray(inliers, np.int64).ravel())], T_target_source)
