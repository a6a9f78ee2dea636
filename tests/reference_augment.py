"""Augmentation, one pixel after the other: slow, and plain to read."""

from __future__ import annotations

import numpy as np

from jaxmap.labels import IGNORE

F = np.float32


def position(index: int, offset_px: int, scale: float, size: int, mirrored: bool) -> np.float32:
    """Where a row (or column) of a crop lies on its image."""
    exact = (F(index + offset_px) + F(0.5)) / F(scale) - F(0.5)
    return F(size - 1) - exact if mirrored else exact


def cut(
    scale: float,
    offset_px: tuple[int, int],
    mirrored: bool,
    image: np.ndarray,
    labels: np.ndarray,
    size_px: tuple[int, int],
    crop_px: tuple[int, int],
    fill: tuple[float, float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """The twin of `jaxmap.training.augment.cut`."""
    height, width = size_px
    colours = np.empty((*crop_px, 3))
    near = np.empty(crop_px, np.uint8)
    for row, column in np.ndindex(*crop_px):
        y = position(row, offset_px[0], scale, height, mirrored=False)
        x = position(column, offset_px[1], scale, width, mirrored)
        nearest = int(np.floor(y + F(0.5))), int(np.floor(x + F(0.5)))
        if 0 <= nearest[0] < height and 0 <= nearest[1] < width:
            near[row, column] = labels[nearest]
            colours[row, column] = bilinear(image, float(y), float(x), size_px)
        else:
            near[row, column] = IGNORE
            colours[row, column] = fill
    return colours, near


def cut_relief(
    scale: float,
    offset_px: tuple[int, int],
    mirrored: bool,
    relief: np.ndarray,
    size_px: tuple[int, int],
    crop_px: tuple[int, int],
) -> np.ndarray:
    """The twin of `jaxmap.training.augment.cut_relief`: where the middle of each block of 4 x 4 pixels lies."""
    shape = -(-crop_px[0] // 4), -(-crop_px[1] // 4)
    held = -(-size_px[0] // 4), -(-size_px[1] // 4)
    result = np.zeros((*shape, relief.shape[-1]))
    for row, column in np.ndindex(*shape):
        y, x = ((4 * place + 2 + start) / scale for place, start in zip((row, column), offset_px, strict=True))
        x = size_px[1] - x if mirrored else x
        # From pixels of the image, counted from its edge, to pixels of relief, counted from their middles.
        y, x = y / 4 - 0.5, x / 4 - 0.5
        if 0 <= np.floor(y + 0.5) < size_px[0] / 4 and 0 <= np.floor(x + 0.5) < size_px[1] / 4:
            result[row, column] = bilinear(relief, y, x, held)
    return result


def bilinear(image: np.ndarray, y: float, x: float, size_px: tuple[int, int]) -> np.ndarray:
    """The colour between the four pixels around a place, which is moved onto the image first."""
    y, x = min(max(y, 0), size_px[0] - 1), min(max(x, 0), size_px[1] - 1)
    top, left = int(y), int(x)
    bottom, right = min(top + 1, size_px[0] - 1), min(left + 1, size_px[1] - 1)
    corners = image.astype(np.float64)
    above = corners[top, left] * (1 - (x - left)) + corners[top, right] * (x - left)
    below = corners[bottom, left] * (1 - (x - left)) + corners[bottom, right] * (x - left)
    return above * (1 - (y - top)) + below * (y - top)
