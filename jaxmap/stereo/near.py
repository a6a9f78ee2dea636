"""What lies nearer than the searched disparities reach, found on small images.

A matcher that cannot reach the disparity of a surface does not leave it out: in one pixel of three it finds a false
match, which is far away. On images shrunk to about 256 columns three times the range is searched in a twentieth of the
time.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool

from jaxmap.stereo.align import shrunk_grey
from jaxmap.stereo.jax_matcher import JaxMatcher
from jaxmap.stereo.match import Matcher, StereoOptions

WIDTH_PX = 256
RANGES = 3
"""The range of disparities that is searched, in ranges of the matcher."""

MOST_OF_WIDTH = 0.8


class TooNear(NamedTuple):
    """Pixels whose surface is too near to be matched or hidden behind one that is, and the disparity of the nearest."""

    pixels: Bool[np.ndarray, "H W"]
    disparity_px: float


class NearGuard:
    """Finds what is nearer than a matcher sees; may be called from several threads.

    Args:
        matcher: of the full images.
        width_px: of the full images.
    """

    def __init__(self, matcher: Matcher | JaxMatcher, width_px: int) -> None:
        self._shrink = max(2, round(width_px / WIDTH_PX))
        self._limit_px = matcher.options.min_disparity_px + matcher.num_disparities
        width_px //= self._shrink
        reach_px = min(RANGES * max(self._limit_px, 1) / self._shrink, MOST_OF_WIDTH * width_px)
        options = replace(StereoOptions(), num_disparities=max(16, int(reach_px) // 16 * 16), edge_step_px=0)
        self._coarse = Matcher(options, width_px)

    def __call__(self, left: np.ndarray, right: np.ndarray) -> TooNear | None:
        """Pixels of the left image that are too near to be matched, or that such a surface hides from the right camera.

        Args:
            left: rectified, uint8, (H, W) or (H, W, 3) RGB.
            right: likewise.

        Returns:
            Pixels and disparity; None where nothing is too near.
        """
        # A surface as near as the limit is found by the matcher itself.
        disparity_px = self._shrink * self._coarse(shrunk_grey(left, self._shrink), shrunk_grey(right, self._shrink))
        near = disparity_px > self._limit_px + self._shrink
        if not near.any():
            return None
        nearest_px = float(np.quantile(disparity_px[near], 0.95))
        reach = 2 * -(-self._limit_px // self._shrink) + 1
        beside = cv2.dilate(near.astype(np.uint8), np.ones((5, max(reach, 5)), np.uint8)) > 0
        near |= beside & np.isnan(disparity_px)
        near_full = np.zeros(left.shape[:2], bool)
        rows, columns = (length * self._shrink for length in near.shape)
        near_full[:rows, :columns] = np.kron(near, np.ones((self._shrink, self._shrink), bool))
        return TooNear(near_full, nearest_px)
