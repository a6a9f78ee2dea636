"""Disparity and labels of a frame in colour."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8

from jaxmap.labels import IGNORE, class_colours

NO_DISPARITY_COLOUR = (22, 24, 29)


def colourise_disparity(disparity_px: Float[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Disparity in colour, near red to far blue; dark where it is NaN.

    The range is that of the middle 96 % of the pixels, so that a few mismatches do not wash it out.
    """
    from matplotlib import colormaps

    disparity_px = np.asarray(disparity_px, np.float64)
    known = np.isfinite(disparity_px)
    picture = np.full((*disparity_px.shape, 3), NO_DISPARITY_COLOUR, np.uint8)
    if known.any():
        low, high = np.percentile(disparity_px[known], [2, 98])
        scaled = (disparity_px[known] - low) / max(high - low, 1e-6)
        # The ends of turbo are nearly black, as the unknown is.
        picture[known] = colormaps["turbo"](0.06 + 0.88 * scaled.clip(0, 1), bytes=True)[:, :3]
    return picture


def overlay_labels(
    image: UInt8[np.ndarray, "H W *rgb"], labels: UInt8[np.ndarray, "H W"], classes: Sequence[str], alpha: float = 0.45
) -> UInt8[np.ndarray, "H W 3"]:
    """A grey or RGB image tinted by `alpha` of the colours of its labels; pixels without a label stay as they are."""
    image = np.asarray(image, np.float64)
    if image.ndim == 2:
        image = image[..., None]
    share = np.where(np.asarray(labels) == IGNORE, 0.0, alpha)[..., None]
    return np.rint((1 - share) * image + share * class_colours(classes)[np.asarray(labels)]).astype(np.uint8)
