"""Points of a stereo pair: found as corners, followed from pair to pair and from left to right by Lucas and Kanade."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

WINDOW_PX, LEVELS = 21, 4
"""Window of the tracker, and levels of its pyramids above the image: it reaches some 2^LEVELS x 10 px."""

RETURN_PX = 0.7
"""A point counts as followed where it comes back this close to where it started."""

OFF_ROW_PX = 2.0
"""How far a point of the right image may lie off its row: calibrations are not perfect."""

COARSE_WIDTH_PX = 256
"""Width at which disparities are searched; the tracker then refines them."""

CORNERS_PER_CELL, CELL_PX = 6, 96
"""Corners kept in each square of the image, so that they spread over it."""

BORDER_PX = 8
PATCH_TEXTURE = 1e-3

_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)


class View(NamedTuple):
    """A rectified pair, prepared.

    Attributes:
        left, right: grey.
        disparity_px: coarse, of the left image at a lower resolution, in pixels of the full one; NaN where unknown.
    """

    left: UInt8[np.ndarray, "H W"]
    right: UInt8[np.ndarray, "H W"]
    disparity_px: Float32[np.ndarray, "h w"]


def make_view(left: UInt8[np.ndarray, "H W *rgb"], right: UInt8[np.ndarray, "H W *rgb"]) -> View:
    """Prepares a rectified pair, grey or RGB."""
    left, right = (image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right))
    return View(left, right, _coarse_disparity(left, right))


def _coarse_disparity(left: np.ndarray, right: np.ndarray) -> Float32[np.ndarray, "h w"]:
    scale = max(1, round(left.shape[1] / COARSE_WIDTH_PX))
    small = [cv2.resize(image, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA) for image in (left, right)]
    searched = max(16, round(small[0].shape[1] / 4 / 16) * 16)
    engine = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=searched, blockSize=5, P1=8 * 25, P2=32 * 25, disp12MaxDiff=1,
        preFilterCap=31, uniquenessRatio=10, speckleWindowSize=40, speckleRange=1, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    padded = [cv2.copyMakeBorder(image, 0, 0, searched, 0, cv2.BORDER_REPLICATE) for image in small]
    raw = engine.compute(*padded)[:, searched:]
    return np.where(raw > 0, raw.astype(np.float32) * (scale / 16), np.float32(np.nan))


def coarse_disparity_at(view: View, pixels: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N"]:
    """The coarse disparity of pixels (column, row), NaN where unknown."""
    height, width = view.disparity_px.shape
    full_height, full_width = view.left.shape
    column = np.clip(((pixels[:, 0] + 0.5) * width / full_width).astype(int), 0, width - 1)
    row = np.clip(((pixels[:, 1] + 0.5) * height / full_height).astype(int), 0, height - 1)
    return view.disparity_px[row, column].astype(np.float64)


def find_corners(
    view: View, known: Float64[np.ndarray, "N 2"], count: int
) -> Float64[np.ndarray, "M 2"]:
    """New corners (column, row) away from known points, spread over the image, at most `count`."""
    height, width = view.left.shape
    spacing = max(5.0, np.sqrt(height * width / count) * 0.5)
    mask = np.zeros((height, width), np.uint8)
    mask[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = 255
    for u, v in np.rint(known).astype(int):
        cv2.circle(mask, (int(u), int(v)), int(spacing), 0, -1)
    # The strength that counts as textured is judged in each cell, else rocks take all corners and sand gets none.
    found = cv2.goodFeaturesToTrack(view.left, 4 * count, 1e-4, spacing, mask=mask, blockSize=5)
    if found is None:
        return np.zeros((0, 2))
    corners = found.reshape(-1, 2).astype(np.float64)
    cell = max(16.0, np.sqrt(height * width / count * 4))
    cells = (corners // cell).astype(int)
    index = cells[:, 1] * (int(width // cell) + 1) + cells[:, 0]
    taken = np.zeros(len(corners), bool)
    full = np.bincount(
        (np.rint(known) // cell).astype(int) @ [1, int(width // cell) + 1] if len(known) else np.zeros(0, int),
        minlength=index.max() + 1,
    ).tolist()
    for place, where in enumerate(index.tolist()):
        if full[where] < 4:
            full[where] += 1
            taken[place] = True
    return corners[taken]


def match_right(
    view: View, pixels: Float64[np.ndarray, "N 2"], disparity_px: Float64[np.ndarray, "N"]
) -> tuple[Float64[np.ndarray, "N"], Bool[np.ndarray, "N"]]:
    """The column in the right image of pixels (column, row) of the left one.

    Args:
        view: the pair.
        pixels: in the left image.
        disparity_px: about; NaN where unknown.

    Returns:
        The columns, and where they were found.
    """
    known = np.isfinite(disparity_px)
    guess = pixels - np.column_stack([np.where(known, disparity_px, 0.0), np.zeros(len(pixels))])
    found, good = follow(view.left, view.right, pixels, guess)
    return found[:, 0], good & known & (np.abs(found[:, 1] - pixels[:, 1]) < OFF_ROW_PX)


def follow(
    source: UInt8[np.ndarray, "H W"],
    target: UInt8[np.ndarray, "H W"],
    pixels: Float64[np.ndarray, "N 2"],
    guess: Float64[np.ndarray, "N 2"],
    levels: int = 2,
) -> tuple[Float64[np.ndarray, "N 2"], Bool[np.ndarray, "N"]]:
    """Where pixels of an image lie in another one, and whether they come back when they are followed back."""
    if not len(pixels):
        return np.zeros((0, 2)), np.zeros(0, bool)
    at = pixels.astype(np.float32).reshape(-1, 1, 2)
    start = guess.astype(np.float32).reshape(-1, 1, 2)
    options = dict(winSize=(WINDOW_PX, WINDOW_PX), maxLevel=levels, criteria=_STOP, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=PATCH_TEXTURE)
    there, ok, _ = cv2.calcOpticalFlowPyrLK(source, target, at, start.copy(), **options)
    shift = at - start
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(target, source, there, there + shift, **options)
    off_px = np.abs(back - at).reshape(-1, 2).max(axis=1)
    height, width = target.shape
    found = there.reshape(-1, 2).astype(np.float64)
    inside = (found > BORDER_PX).all(axis=1) & (found[:, 0] < width - BORDER_PX) & (found[:, 1] < height - BORDER_PX)
    return found, (ok.ravel() == 1) & (ok_back.ravel() == 1) & (off_px < RETURN_PX) & inside
