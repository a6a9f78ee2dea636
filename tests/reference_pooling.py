"""SegNet's pooling and unpooling, pixel by pixel, as torch's `max_pool2d(return_indices=True)` and `max_unpool2d`."""

from __future__ import annotations

import numpy as np


def reference_pool(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest of each 2 x 2 pixels, and which it was, the first of equal ones."""
    batch, height, width, channels = images.shape
    largest = np.zeros((batch, height // 2, width // 2, channels), images.dtype)
    places = np.zeros(largest.shape, np.uint8)
    for image, row, column, channel in np.ndindex(largest.shape):
        window = images[image, 2 * row : 2 * row + 2, 2 * column : 2 * column + 2, channel].reshape(-1)
        places[image, row, column, channel] = window.argmax()
        largest[image, row, column, channel] = window.max()
    return largest, places


def reference_unpool(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Each value where it was, zeros elsewhere."""
    batch, height, width, channels = values.shape
    images = np.zeros((batch, 2 * height, 2 * width, channels), values.dtype)
    for image, row, column, channel in np.ndindex(values.shape):
        down, across = divmod(int(places[image, row, column, channel]), 2)
        images[image, 2 * row + down, 2 * column + across, channel] = values[image, row, column, channel]
    return images
