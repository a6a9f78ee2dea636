"""The frames of a sequence as refinement uses them: grey images, disparities, and pixels sampled from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int, UInt8
from scipy.ndimage import distance_transform_edt

from jaxmap.types import Pinhole

EDGE_PX = 2.0
"""Disparities that differ by more within a few pixels lie on two surfaces."""


class DisparityFrame(NamedTuple):
    """One rectified frame.

    Attributes:
        image: grey.
        disparity_px: NaN where unknown.
        filled_px: the same with holes filled from the nearest pixel, to warp images by.
    """

    image: UInt8[np.ndarray, "H W"]
    disparity_px: Float32[np.ndarray, "H W"]
    filled_px: Float32[np.ndarray, "H W"]


def make_disparity_frame(image: np.ndarray, disparity_px: np.ndarray) -> DisparityFrame | None:
    """A frame from a rectified image, grey or RGB, and its disparity; None where hardly any disparity is known."""
    known = np.isfinite(disparity_px) & (disparity_px > 0)
    if known.mean() < 0.02:
        return None
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    assert isinstance(nearest, np.ndarray)
    return DisparityFrame(grey, np.where(known, disparity_px, np.nan).astype(np.float32), disparity_px[tuple(nearest)])


def unproject(
    camera: Pinhole, pixels: Float64[np.ndarray, "N 2"], disparity_px: Float64[np.ndarray, "N"]
) -> Float64[np.ndarray, "N 3"]:
    """Points of pixels (column, row) in the camera frame, in metres."""
    depth_m = camera.baseline_m * camera.fx_px / np.maximum(disparity_px + camera.doffs_px, 1e-6)
    x = (pixels[:, 0] - camera.cx_px) / camera.fx_px * depth_m
    y = (pixels[:, 1] - camera.cy_px) / camera.fy_px * depth_m
    return np.stack([x, y, depth_m], axis=-1)


def sample_bilinear(image: np.ndarray, pixels: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N"]:
    """Values at pixels (column, row), NaN outside or beside an unknown one."""
    maps = pixels.astype(np.float32).reshape(1, -1, 2)
    border = cv2.BORDER_CONSTANT
    found = cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=border, borderValue=(np.nan,))
    return found.reshape(-1).astype(np.float64)


class PixelSamples(NamedTuple):
    """Pixels sampled from several frames: the index of the frame; column, row and disparity."""

    frames: Int[np.ndarray, "P"]
    uvd_px: Float64[np.ndarray, "P 3"]


def sample_pixels(
    frames: Sequence[DisparityFrame], camera: Pinhole, depth_range_m: tuple[float, float], per_frame: int
) -> PixelSamples:
    """Pixels of a regular raster in each frame, within a range of depths and away from the edges of surfaces."""
    indices, samples = [], []
    for index, frame in enumerate(frames):
        height, width = frame.image.shape
        step = max(1, int(np.sqrt(height * width / per_frame)))
        rows, columns = (part.ravel() for part in np.mgrid[step // 2 : height : step, step // 2 : width : step])
        disparity = frame.disparity_px[rows, columns].astype(np.float64)
        depth_m = camera.baseline_m * camera.fx_px / np.maximum(disparity + camera.doffs_px, 1e-6)
        good = _smooth(frame)[rows, columns] & (depth_m > depth_range_m[0]) & (depth_m < depth_range_m[1])
        samples.append(np.column_stack([columns, rows, disparity])[good])
        indices.append(np.full(int(good.sum()), index))
    return PixelSamples(np.concatenate(indices), np.concatenate(samples))


def _smooth(frame: DisparityFrame) -> Bool[np.ndarray, "H W"]:
    """Pixels away from the edges of surfaces: at edges, matchers invent points between near and far."""
    square = np.ones((9, 9), np.uint8)
    return cv2.dilate(frame.filled_px, square) - cv2.erode(frame.filled_px, square) < EDGE_PX
