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

    disparity_px = np.asarray(disparity_px, np.float32)
    known = np.isfinite(disparity_px)
    level = np.zeros(disparity_px.shape, np.uint8)
    if known.any():
        of_known = disparity_px[known]
        low, high = np.percentile(of_known, [2, 98])
        scaled = (of_known - low) / max(high - low, 1e-6)
        # The ends of turbo are nearly black, as the unknown is.
        level[known] = 256 * (0.06 + 0.88 * scaled.clip(0, 1))
    colours = colormaps["turbo"](np.arange(256), bytes=True)[:, :3]
    colours[0] = NO_DISPARITY_COLOUR
    return colours.take(level, axis=0)


def overlay_labels(
    image: UInt8[np.ndarray, "H W *rgb"], labels: UInt8[np.ndarray, "H W"], classes: Sequence[str], alpha: float = 0.45
) -> UInt8[np.ndarray, "H W 3"]:
    """A grey or RGB image tinted by `alpha` of the colours of its labels; pixels without a label stay as they are."""
    import cv2

    labels, colours = np.asarray(labels), class_colours(classes)
    image = np.ascontiguousarray(np.broadcast_to(image if image.ndim == 3 else image[..., None], (*labels.shape, 3)))
    tinted = cv2.addWeighted(image, 1 - alpha, colours.take(labels, axis=0), alpha, 0)
    np.copyto(tinted, image, where=(labels == IGNORE)[..., None])
    return tinted
