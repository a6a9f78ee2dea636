"""Ground truth on a raster: which pixels are of the class that is scored, which are of another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8

UNLABELLED, OTHER, TARGET = 0, 1, 2
"""What a pixel of the truth is: the codes of a labelled orthomosaic, with rock as the target."""


@dataclass(frozen=True, eq=False)
class LabelRaster:
    """Labels with a place.

    Attributes:
        labels: `UNLABELLED`, `OTHER` or `TARGET`, (rows, columns).
        T_crs_pixel: affine, takes (column, row, 1) to coordinates of `crs`; pixel `i` spans `[i, i + 1)`.
        crs: the coordinate reference system, None where it is unknown.
        name: the file, for texts.
        notes: what was assumed in reading it, in words.
    """

    labels: UInt8[np.ndarray, "H W"]
    T_crs_pixel: Float64[np.ndarray, "3 3"]
    crs: str | None = None
    name: str = "ground truth"
    notes: tuple[str, ...] = ()


def sample_nearest(
    image: UInt8[np.ndarray, "H W *c"], column: Float64[np.ndarray, "*s"], row: Float64[np.ndarray, "*s"]
) -> UInt8[np.ndarray, "*s"]:
    """The pixels that hold given points, 0 outside the image (and where a coordinate is not finite)."""
    height, width = image.shape[:2]
    # Tested on floats: a NaN or a huge number cast to an integer would be a valid index.
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = np.where(inside, row, 0).astype(np.int64), np.where(inside, column, 0).astype(np.int64)
    return np.where(inside.reshape(inside.shape + (1,) * (image.ndim - 2)), image[at], 0).astype(np.uint8)
