"""Disparities and what labels are made from, as the small integers that observations store."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float, Int16, Shaped

from jaxmap.errors import FrameError

Kept = Literal["logits", "labels", "class_probabilities"]
"""The field of `Frame` that labels are made from, and the name of its array.

Logits are int16 times the frame's `scale`, probabilities uint8 of 255ths, labels uint8.
"""

_SUBPIXELS, _UNKNOWN = 16, -(2**15)


def quantise_disparity(disparity_px: Float[np.ndarray, "H W"]) -> Int16[np.ndarray, "H W"]:
    """Disparity in sixteenths of a pixel, the nearest to what is given; OpenCV's matcher gives such.

    Raises:
        FrameError: a disparity of 2048 px or more.
    """
    known = np.isfinite(disparity_px)
    sixteenths = np.rint(np.where(known, disparity_px, 0.0) * _SUBPIXELS)
    if (np.abs(sixteenths) >= -_UNKNOWN).any():
        raise FrameError(
            f"a disparity of {np.abs(sixteenths).max() / _SUBPIXELS:.0f} px cannot be kept", fix="search less than 2048"
        )
    return np.where(known, sixteenths, _UNKNOWN).astype(np.int16)


def restore_disparity(sixteenths: Int16[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """What `quantise_disparity` was given, to within a 32nd of a pixel."""
    disparity_px = np.multiply(sixteenths, np.float32(1 / _SUBPIXELS), dtype=np.float32)
    disparity_px[sixteenths == _UNKNOWN] = np.nan
    return disparity_px


def quantise_kept(values: Shaped[np.ndarray, "..."], kept: Kept) -> tuple[Shaped[np.ndarray, "..."], float]:
    """An array as it is stored, and the number that its integers are multiplied by.

    The scale of logits is that of the frame's greatest: 0.0003 of rounding where they reach 20, and none is cut off.

    Raises:
        FrameError: the numbers are not finite.
    """
    if kept == "labels":
        return np.asarray(values, np.uint8), 1.0
    if not np.isfinite(values).all():
        raise FrameError(f"the {kept.replace('_', ' ')} are not finite", fix="check the network or the files of labels")
    if kept == "class_probabilities":
        return np.rint(np.clip(values, 0.0, 1.0) * 255).astype(np.uint8), 1 / 255
    scale = float(np.float32(max(float(np.abs(values).max(initial=0.0)), 1e-6) / (2**15 - 1)))
    return np.rint(values / np.float64(scale)).clip(_UNKNOWN + 1, -_UNKNOWN - 1).astype(np.int16), scale


def restore_kept(stored: Shaped[np.ndarray, "..."], kept: Kept, scale: float) -> Shaped[np.ndarray, "..."]:
    """What `quantise_kept` was given, to within half a step."""
    return stored if kept == "labels" else np.multiply(stored, np.float32(scale), dtype=np.float32)
