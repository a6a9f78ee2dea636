"""A stereo camera that drives over a textured plane: its images are the plane's texture, warped; and its true poses."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from jaxmap.types import Pinhole

WIDTH_PX, HEIGHT_PX = 320, 240
CAMERA = Pinhole(fx_px=260.0, fy_px=260.0, cx_px=159.5, cy_px=119.5, baseline_m=0.12, doffs_px=0.0)
HEIGHT_M, PITCH_RAD, STEP_M = 1.0, np.radians(35.0), 0.12
TEXEL_M, TEXELS, MARGIN_M = 0.008, 1400, 3.0


@cache
def texture() -> np.ndarray:
    """Grains of several sizes, (TEXELS, TEXELS) uint8; its first texel lies at -MARGIN_M, -MARGIN_M."""
    rng, total = np.random.default_rng(5), np.zeros((TEXELS, TEXELS), np.float32)
    for texels in (1.5, 4.0, 12.0):
        grains = cv2.GaussianBlur(rng.normal(size=(TEXELS, TEXELS)).astype(np.float32), (0, 0), texels)
        total += grains / grains.std()
    return np.clip(120 + 30 * total, 0, 255).astype(np.uint8)


def poses(count: int, step_m: float = STEP_M) -> np.ndarray:
    """T_world_camera (N, 4, 4): level on the way north, turning and swaying a little."""
    T = np.tile(np.eye(4), (count, 1, 1))
    level = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    for index in range(count):
        angles = [0.02 * index, -PITCH_RAD + 0.01 * np.sin(index), 0.01 * np.cos(2 * index)]
        T[index, :3, :3] = Rotation.from_euler("ZXY", angles).as_matrix() @ level
        T[index, :3, 3] = [0.02 * index * step_m, index * step_m, HEIGHT_M]
    return T


def pair(T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The left and the right image, uint8 grey."""
    images = []
    for shift_m in (0.0, CAMERA.baseline_m):
        T = T_world_camera.copy()
        T[:3, 3] += T[:3, 0] * shift_m
        R, t = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
        K = np.array([[CAMERA.fx_px, 0, CAMERA.cx_px], [0, CAMERA.fy_px, CAMERA.cy_px], [0, 0, 1]])
        world_texel = np.array([[TEXEL_M, 0, -MARGIN_M], [0, TEXEL_M, -MARGIN_M], [0, 0, 1]])
        H = K @ np.column_stack([R[:, 0], R[:, 1], t]) @ world_texel
        images.append(cv2.warpPerspective(texture(), H, (WIDTH_PX, HEIGHT_PX), flags=cv2.INTER_LINEAR))
    return images[0], images[1]


def pairs(count: int, step_m: float = STEP_M) -> list[tuple[np.ndarray, np.ndarray]]:
    """The images of a drive."""
    return [pair(T) for T in poses(count, step_m)]
