"""Ground and boxes of known height, as a tilted stereo camera sees them without noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxmap.types import StereoCamera, make_stereo_camera

WIDTH_PX, HEIGHT_PX = 256, 192
CAMERA = make_stereo_camera(
    fx_px=180.0,
    fy_px=176.0,
    cx_px=125.1,
    cy_px=98.7,
    baseline_m=0.4,
    doffs_px=0.7,
    width_px=WIDTH_PX,
    height_px=HEIGHT_PX,
)
CAMERA_HEIGHT_M = 1.1
FARTHEST_M = 14.0

Surface = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Heights of the ground from x forward and y left, in the level frame of the camera."""


class Box(NamedTuple):
    """A box that stands in the ground, metres in the level frame; its top lies `height_m` above flat ground."""

    x_m: float
    y_m: float
    edge_m: float
    height_m: float


class View(NamedTuple):
    """What the camera sees: all but the direction up are images (H, W).

    Attributes:
        up_camera: unit vector.
        disparity_px: NaN for the sky.
        height_m: above the ground.
        depth_m: along the optical axis; infinite for the sky.
        R_level_camera: of the camera.
    """

    up_camera: np.ndarray
    disparity_px: np.ndarray
    height_m: np.ndarray
    depth_m: np.ndarray
    R_level_camera: np.ndarray


def view_of(
    slopes: tuple[float, float] = (0.0, 0.0),
    boxes: Sequence[Box] = (),
    *,
    bumps: Surface | None = None,
    camera: StereoCamera = CAMERA,
    pitch_deg: float = 18.0,
    roll_deg: float = 0.0,
) -> View:
    """Casts a ray through each pixel; the camera is pitched down, then rolled about its axis.

    Args:
        slopes: of the ground, along x and y.
        boxes: that stand on it.
        bumps: are added to it.
        camera: sees it.
        pitch_deg, roll_deg: of the camera.
    """

    def surface(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return -CAMERA_HEIGHT_M + slopes[0] * x + slopes[1] * y + (0.0 if bumps is None else bumps(x, y))

    R = rotation(pitch_deg, roll_deg)
    v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(np.float64)
    fx, fy, cx, cy = (float(getattr(camera, f"{name}_px")) for name in ("fx", "fy", "cx", "cy"))
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1) @ R.T
    depth_m = _plane_depth(rays, slopes) if bumps is None else _ground_depth(rays, surface)
    for box in boxes:
        depth_m = np.minimum(depth_m, _box_depth(rays, box))
    with np.errstate(invalid="ignore"):
        points = rays * depth_m[..., None]
        height_m = points[..., 2] - surface(points[..., 0], points[..., 1])
    disparity_px = float(camera.baseline_m) * fx / depth_m - float(camera.doffs_px)
    disparity_px = np.where(np.isfinite(depth_m), disparity_px, np.nan).astype(np.float32)
    return View(R[2].astype(np.float32), disparity_px, height_m, depth_m, R)


def rotation(pitch_deg: float, roll_deg: float) -> np.ndarray:
    """R_level_camera."""
    p, r = np.radians([pitch_deg, roll_deg])
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pitched = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(p), np.sin(p)], [0.0, -np.sin(p), np.cos(p)]])
    rolled = np.array([[np.cos(r), -np.sin(r), 0.0], [np.sin(r), np.cos(r), 0.0], [0.0, 0.0, 1.0]])
    return level @ pitched @ rolled


def _plane_depth(rays: np.ndarray, slopes: tuple[float, float]) -> np.ndarray:
    fall = slopes[0] * rays[..., 0] + slopes[1] * rays[..., 1] - rays[..., 2]
    with np.errstate(divide="ignore"):
        depth_m = np.where(fall > 0, CAMERA_HEIGHT_M / fall, np.inf)
    return np.where(depth_m < FARTHEST_M, depth_m, np.inf)


def _ground_depth(rays: np.ndarray, surface: Surface) -> np.ndarray:
    """The first depth at which each ray is below the surface, by steps and bisection; infinite where there is none."""

    def below(depth_m: np.ndarray) -> np.ndarray:
        x, y, z = np.moveaxis(rays * depth_m[..., None], -1, 0)
        return z < surface(x, y)

    low, high = np.zeros(rays.shape[:2]), np.full(rays.shape[:2], np.inf)
    for depth_m in np.arange(0.1, FARTHEST_M, 0.1):
        there = np.isinf(high) & below(np.full(rays.shape[:2], depth_m))
        high[there], low[there] = depth_m, depth_m - 0.1
    hit = np.isfinite(high)
    for _ in range(40):
        middle = np.where(hit, (low + high) / 2, 0.0)
        under = below(middle)
        low, high = np.where(hit & ~under, middle, low), np.where(hit & under, middle, high)
    return high


def _box_depth(rays: np.ndarray, box: Box) -> np.ndarray:
    lower = np.array([box.x_m, box.y_m, -CAMERA_HEIGHT_M - 1])
    upper = np.array([box.x_m + box.edge_m, box.y_m + box.edge_m, -CAMERA_HEIGHT_M + box.height_m])
    with np.errstate(divide="ignore"):
        ends = np.sort([lower / rays, upper / rays], axis=0)
    enters, leaves = ends[0].max(axis=-1), ends[1].min(axis=-1)
    return np.where((enters <= leaves) & (enters > 0), enters, np.inf)
