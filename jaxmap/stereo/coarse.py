"""What small images show of a pair: disparities over a wide range, at a twentieth of the cost of the full ones."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmap.stereo.align import shrunk_grey
from jaxmap.stereo.jax_matcher import JaxMatcher
from jaxmap.stereo.match import Matcher, StereoOptions

WIDTH_PX = 256
RANGES = 3
"""The range of disparities that is searched, in ranges of the matcher."""

MOST_OF_WIDTH = 0.8


class Coarse(NamedTuple):
    """Disparities in px of the full images, NaN where unknown, for pixels that are `shrink` times as wide."""

    disparity_px: Float[np.ndarray, "h w"]
    shrink: int


class CoarseMatcher:
    """Matches shrunk images, of about 256 columns; may be called from several threads.

    Args:
        matcher: of the full images.
        width_px: of the full images.

    Attributes:
        limit_px: disparities of the full images from here on are not searched.
    """

    def __init__(self, matcher: Matcher | JaxMatcher, width_px: int) -> None:
        self._shrink = max(2, round(width_px / WIDTH_PX))
        least_px = min(matcher.options.min_disparity_px, 0) // self._shrink
        limit_px = max(matcher.options.min_disparity_px + matcher.num_disparities, 1)
        width_px //= self._shrink
        reach_px = min(RANGES * limit_px / self._shrink, MOST_OF_WIDTH * width_px) - least_px
        options = replace(
            StereoOptions(),
            min_disparity_px=least_px,
            num_disparities=max(16, int(reach_px) // 16 * 16),
            edge_step_px=0,
        )
        self._matcher = Matcher(options, width_px)
        self.limit_px = self._shrink * (least_px + self._matcher.num_disparities)

    def __call__(self, left: np.ndarray, right: np.ndarray) -> Coarse:
        """What a rectified pair shows.

        Args:
            left: uint8, (H, W) or (H, W, 3) RGB.
            right: likewise.
        """
        shrink = self._shrink
        return Coarse(shrink * self._matcher(shrunk_grey(left, shrink), shrunk_grey(right, shrink)), shrink)
