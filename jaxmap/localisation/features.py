"""Points of a stereo pair: found as corners, followed from pair to pair and from left to right.

Following is by Lucas and Kanade, in pyramids, there and back.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

MEAN_GREY, SPREAD_GREY, MOST_GAIN = 110.0, 50.0, 6.0
"""Mean and standard deviation that images are brought to: exposure changes from pair to pair."""

LEAST_SPREAD_GREY = 1.0
"""An image that varies less shows nothing: it is black, white or fog."""

LARGE_PX = 600
"""From this width on, corners and first poses are found at half the resolution."""

COARSE_WIDTH_PX = 256
"""Width at which disparities are searched; the tracker then refines them."""

RETURN_PX = 0.7
"""A point counts as followed where it comes back this close to where it started."""

OFF_ROW_PX = 3.0
"""How far a point of the right image may lie off its row: calibrations are not perfect."""

BORDER_PX = 8
PER_CELL = 4
"""Corners in each square of the image, at most, so that they spread over it."""

_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)


class View(NamedTuple):
    """A rectified pair, prepared.

    Attributes:
        left, right: grey, of one brightness and contrast.
        small: the left one, `scale` times smaller: good enough to find corners and a first pose.
        disparity_px: coarse, of the left image at a lower resolution, in pixels of the full one; NaN where unknown.
    """

    left: UInt8[np.ndarray, "H W"]
    right: UInt8[np.ndarray, "H W"]
    small: UInt8[np.ndarray, "SH SW"]
    scale: int
    disparity_px: Float32[np.ndarray, "h w"]

    def to_small(self, pixels: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """Pixels of the left image in the small one: centres are whole numbers in both."""
        return (pixels + 0.5) / self.scale - 0.5

    def to_full(self, pixels: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N 2"]:
        """Pixels of the small image in the left one."""
        return (pixels + 0.5) * self.scale - 0.5


def make_view(left: UInt8[np.ndarray, "H W *rgb"], right: UInt8[np.ndarray, "H W *rgb"]) -> View | None:
    """Prepares a rectified pair, grey or RGB; None where an image shows nothing."""
    made = [_even(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) for image in (left, right)]
    if made[0] is None or made[1] is None:
        return None
    scale = 2 if left.shape[1] >= LARGE_PX else 1
    return View(made[0], made[1], shrunk(made[0], scale), scale, _coarse_disparity(made[0], made[1]))


def _even(grey: np.ndarray) -> np.ndarray | None:
    """The image in the common brightness and contrast; None where it shows nothing."""
    mean, spread = (float(value[0, 0]) for value in cv2.meanStdDev(grey))
    if spread < LEAST_SPREAD_GREY:
        return None
    gain = min(SPREAD_GREY / spread, MOST_GAIN)
    return cv2.LUT(grey, np.clip(gain * (np.arange(256) - mean) + MEAN_GREY, 0, 255).astype(np.uint8))


def coarse_scale(width_px: int) -> int:
    """How many times images of a width are shrunk where disparities are searched."""
    return max(1, round(width_px / COARSE_WIDTH_PX))


def shrunk(image: np.ndarray, scale: int) -> np.ndarray:
    """An image `scale` times smaller; rows and columns that do not fill a pixel are left out."""
    if scale == 1:
        return image
    height, width = (length // scale * scale for length in image.shape[:2])
    return cv2.resize(image[:height, :width], (width // scale, height // scale), interpolation=cv2.INTER_AREA)


def _coarse_disparity(left: np.ndarray, right: np.ndarray) -> Float32[np.ndarray, "h w"]:
    """Disparities up to a quarter of the width, by semi-global matching of small images."""
    scale = coarse_scale(left.shape[1])
    small = [shrunk(image, scale) for image in (left, right)]
    searched = max(16, round(small[0].shape[1] / 64) * 16)
    block_px = 5
    engine = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=searched,
        blockSize=block_px,
        P1=8 * block_px**2,
        P2=32 * block_px**2,
        disp12MaxDiff=1,
        preFilterCap=31,
        uniquenessRatio=10,
        speckleWindowSize=40,
        speckleRange=1,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    # Matching begins a search range to the right of the edge.
    padded = [cv2.copyMakeBorder(image, 0, 0, searched, 0, cv2.BORDER_REPLICATE) for image in small]
    raw = engine.compute(*padded)[:, searched:]
    return np.where(raw > 0, raw.astype(np.float32) * np.float32(scale / 16), np.float32(np.nan))


def coarse_disparity_at(view: View, pixels: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N"]:
    """The coarse disparity of pixels (column, row), NaN where unknown."""
    scale, shape = coarse_scale(view.left.shape[1]), np.array(view.disparity_px.shape)
    row, column = np.clip(((pixels[:, ::-1] + 0.5) / scale).astype(int), 0, shape - 1).T
    return view.disparity_px[row, column].astype(np.float64)


def find_corners(view: View, known: Float64[np.ndarray, "N 2"], count: int) -> Float64[np.ndarray, "M 2"]:
    """Corners (column, row) away from known ones, spread over the image, so that both are about `count`.

    Each square of the image takes its strongest corners, few of them: rocks would else take all, and sand get none.
    """
    image, known = view.small, view.to_small(known)
    height, width = image.shape
    cell_px = np.sqrt(height * width * PER_CELL / count)
    spacing_px = max(5.0 / view.scale, 0.25 * cell_px)
    mask = np.zeros((height, width), np.uint8)
    mask[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = 255
    for column, row in np.rint(known).astype(int).tolist():
        cv2.circle(mask, (column, row), int(spacing_px), (0,), -1)
    found = cv2.goodFeaturesToTrack(image, 4 * count, 1e-4, spacing_px, mask=mask, blockSize=5)
    if found is None:
        return np.zeros((0, 2))
    corners = found.reshape(-1, 2).astype(np.float64)
    columns = int(width // cell_px) + 1
    cells = [
        (places.clip(0, [width - 1, height - 1]) // cell_px).astype(int) @ [1, columns] for places in (known, corners)
    ]
    filled = np.bincount(cells[0], minlength=columns * (int(height // cell_px) + 1)).tolist()
    chosen = []
    for corner, cell in zip(corners, cells[1].tolist(), strict=True):
        if filled[cell] < PER_CELL:
            filled[cell] += 1
            chosen.append(corner)
    return view.to_full(np.array(chosen).reshape(-1, 2))


def match_right(
    view: View, pixels: Float64[np.ndarray, "N 2"], disparity_px: Float64[np.ndarray, "N"]
) -> tuple[Float64[np.ndarray, "N"], Bool[np.ndarray, "N"]]:
    """The columns in the right image of pixels (column, row) of the left one, and where they were found.

    Args:
        view: the pair.
        pixels: in the left image.
        disparity_px: about, in the pixels' own columns; NaN where unknown.
    """
    known = np.isfinite(disparity_px)
    guess = pixels - np.column_stack([np.where(known, disparity_px, 0.0), np.zeros(len(pixels))])
    found, good = follow(view.left, view.right, pixels, guess, levels=1, window_px=15)
    return found[:, 0], good & known & (np.abs(found[:, 1] - pixels[:, 1]) < OFF_ROW_PX)


def follow(
    source: UInt8[np.ndarray, "H W"],
    target: UInt8[np.ndarray, "H W"],
    pixels: Float64[np.ndarray, "N 2"],
    guess: Float64[np.ndarray, "N 2"],
    *,
    levels: int,
    window_px: int,
) -> tuple[Float64[np.ndarray, "N 2"], Bool[np.ndarray, "N"]]:
    """Where pixels of an image lie in another one, and whether they come back when they are followed back.

    Args:
        source: an image.
        target: another one.
        pixels: columns and rows in the source.
        guess: about where they lie in the target.
        levels: of the pyramid, above the image: each doubles how far off the guess may be.
        window_px: what is compared around a pixel.
    """
    if not len(pixels):
        return np.zeros((0, 2)), np.zeros(0, bool)
    start, aim = (places.astype(np.float32).reshape(-1, 1, 2) for places in (pixels, guess))
    by = partial(
        cv2.calcOpticalFlowPyrLK,
        winSize=(window_px, window_px),
        maxLevel=levels,
        criteria=_STOP,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    there, arrived, _ = by(source, target, start, aim.copy())
    back, returned, _ = by(target, source, there, there + start - aim)
    found = there.reshape(-1, 2).astype(np.float64)
    inside = ((found > BORDER_PX) & (found < np.array(target.shape[::-1]) - BORDER_PX)).all(axis=1)
    near = np.abs(back - start).reshape(-1, 2).max(axis=1) < RETURN_PX
    return found, (arrived.ravel() == 1) & (returned.ravel() == 1) & near & inside


def match_descriptors(
    source: View, target: View, count: int
) -> tuple[Float64[np.ndarray, "N 2"], Float64[np.ndarray, "N 2"]]:
    """Pixels of two left images that look alike, wherever they lie: many are wrong, and all are coarse.

    ORB at the small scale, each the other's best.
    """
    orb = cv2.ORB.create(count)
    # An empty mask is none.
    none = np.zeros((0, 0), np.uint8)
    (here, one), (there, other) = (orb.detectAndCompute(view.small, none) for view in (source, target))
    if one is None or other is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(one, other)
    found = np.array([[here[pair.queryIdx].pt, there[pair.trainIdx].pt] for pair in pairs]).reshape(-1, 2, 2)
    return source.to_full(found[:, 0]), target.to_full(found[:, 1])
