"""The frames of a sequence as refinement sees them: grey images, disparities, and points drawn from them."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from scipy.ndimage import distance_transform_edt

from jaxmap.types import StereoCamera

EDGE_PX = 2.0
"""Disparities that differ by more within a few pixels lie on two surfaces."""


class View(NamedTuple):
    """One rectified frame.

    Attributes:
        image: grey.
        disparity_px: NaN where unknown.
        filled_px: the same with holes filled from the nearest pixel, to warp images by.
    """

    image: UInt8[np.ndarray, "H W"]
    disparity_px: Float32[np.ndarray, "H W"]
    filled_px: Float32[np.ndarray, "H W"]


def make_view(image: np.ndarray, disparity_px: np.ndarray) -> View | None:
    """A view of a rectified image, grey or RGB, and its disparity; None where hardly any disparity is known."""
    known = np.isfinite(disparity_px) & (disparity_px > 0)
    if known.mean() < 0.02:
        return None
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    assert isinstance(nearest, np.ndarray)
    return View(grey, np.where(known, disparity_px, np.nan).astype(np.float32), disparity_px[tuple(nearest)])


def smooth_pixels(view: View) -> Bool[np.ndarray, "H W"]:
    """Pixels away from the edges of surfaces: at edges, matchers make up points between near and far."""
    square = np.ones((9, 9), np.uint8)
    return cv2.dilate(view.filled_px, square) - cv2.erode(view.filled_px, square) < EDGE_PX


class Pinhole(NamedTuple):
    """The numbers of a rectified camera in float64, for the host."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    baseline_m: float
    doffs_px: float


def pinhole(camera: StereoCamera) -> Pinhole:
    """The numbers of a camera."""
    return Pinhole(*(float(getattr(camera, name)) for name in Pinhole._fields))


def to_points(
    camera: Pinhole, pixels: Float64[np.ndarray, "N 2"], disparity_px: Float64[np.ndarray, "N"]
) -> Float64[np.ndarray, "N 3"]:
    """Points of pixels (column, row) in the camera frame, in metres."""
    depth_m = camera.baseline_m * camera.fx_px / np.maximum(disparity_px + camera.doffs_px, 1e-6)
    x = (pixels[:, 0] - camera.cx_px) / camera.fx_px * depth_m
    y = (pixels[:, 1] - camera.cy_px) / camera.fy_px * depth_m
    return np.stack([x, y, depth_m], axis=-1)


def bilinear(image: np.ndarray, pixels: Float64[np.ndarray, "N 2"]) -> Float64[np.ndarray, "N"]:
    """Values at pixels (column, row), NaN outside or beside an unknown one."""
    maps = pixels.astype(np.float32).reshape(1, -1, 2)
    border = cv2.BORDER_CONSTANT
    found = cv2.remap(image, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=border, borderValue=(np.nan,))
    return found.reshape(-1).astype(np.float64)
