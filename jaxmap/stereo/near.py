"""What lies nearer than the searched disparities reach, found on small images.

A matcher that cannot reach the disparity of a surface does not leave it out: in one pixel of three it finds a false
match, which is far away.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool

from jaxmap.stereo.coarse import Coarse


class TooNear(NamedTuple):
    """Pixels whose surface is too near to be matched or hidden behind one that is, and the disparity of the nearest."""

    pixels: Bool[np.ndarray, "H W"]
    disparity_px: float


def too_near(coarse: Coarse, limit_px: int, image_px: Sequence[int]) -> TooNear | None:
    """Pixels of the left image that are too near to be matched, or that such a surface hides from the right camera.

    Args:
        coarse: what small images show.
        limit_px: disparities from here on are not searched.
        image_px: height and width of the full images.

    Returns:
        Pixels and disparity; None where nothing is too near.
    """
    disparity_px, shrink = coarse
    # A surface as near as the limit is found by the matcher itself.
    near = disparity_px > limit_px + shrink
    if not near.any():
        return None
    nearest_px = float(np.quantile(disparity_px[near], 0.95))
    reach = 2 * -(-limit_px // shrink) + 1
    beside = cv2.dilate(near.astype(np.uint8), np.ones((5, max(reach, 5)), np.uint8)) > 0
    near |= beside & np.isnan(disparity_px)
    near_full = np.zeros(image_px, bool)
    rows, columns = (length * shrink for length in near.shape)
    near_full[:rows, :columns] = np.kron(near, np.ones((shrink, shrink), bool))
    return TooNear(near_full, nearest_px)
