"""Slow, readable twins of what the labeller does with the logits of a network, in float64."""

from __future__ import annotations

import numpy as np

from jaxmap.models.base import padded_size

IGNORE = 255


def bilinear(image: np.ndarray, v: float, u: float) -> np.ndarray:
    """The value between pixels, at row `v` and column `u`; outside, that of the border."""
    v, u = min(max(v, 0.0), len(image) - 1.0), min(max(u, 0.0), image.shape[1] - 1.0)
    top, left = int(v), int(u)
    bottom, right = min(top + 1, len(image) - 1), min(left + 1, image.shape[1] - 1)
    below, beside = v - top, u - left
    upper = (1 - beside) * image[top, left] + beside * image[top, right]
    lower = (1 - beside) * image[bottom, left] + beside * image[bottom, right]
    return (1 - below) * upper + below * lower


def resized(image: np.ndarray, size: tuple[int, int], align_corners: bool) -> np.ndarray:
    """Bilinear resizing, pixel by pixel."""

    def position(index: int, source: int, target: int) -> float:
        if align_corners:
            return index * (source - 1) / max(target - 1, 1)
        return (index + 0.5) * source / target - 0.5

    (rows, columns), (height, width) = image.shape[:2], size
    return np.array(
        [
            [bilinear(image, position(v, rows, height), position(u, columns, width)) for u in range(width)]
            for v in range(height)
        ]
    )


def pixel_logits(architecture, coarse, image_px: tuple[int, int], size_px: tuple[int, int] | None) -> np.ndarray:
    """Class logits (H, W, C) of the pixels, from the coarse ones (h, w, C)."""
    inside = image_px if size_px is None else size_px
    padded = (padded_size(inside[0], architecture), padded_size(inside[1], architecture))
    logits = resized(np.asarray(coarse, np.float64), padded, architecture.align_corners)
    logits = logits[: inside[0], : inside[1]]
    return logits if size_px is None else resized(logits, image_px, align_corners=False)


def merged_probabilities(logits: np.ndarray, targets: tuple[int, ...], class_count: int) -> np.ndarray:
    """Probabilities (..., M) of the map's classes: the sum of those of the classes that become each."""
    powers = np.exp(logits - logits.max(axis=-1, keepdims=True))
    shares = powers / powers.sum(axis=-1, keepdims=True)
    result = np.zeros((*logits.shape[:-1], class_count))
    for index, target in enumerate(targets):
        if target != IGNORE:
            result[..., target] += shares[..., index]
    return result
