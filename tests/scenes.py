"""A small world with known depth and labels: boxes on textured ground, seen by a stereo pair.

Rays are cast in float64 NumPy. The texture is smooth and is sampled several times in each pixel, so
that a matcher finds disparities to a fraction of a pixel.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from PIL import Image

from jaxmap.datasets.poses import write_tum
from jaxmap.stereo.rectify import StereoRig

WIDTH_PX, HEIGHT_PX = 160, 120
F_PX, CX_PX, CY_PX = 140.0, 79.5, 59.5
BASELINE_M = 0.12
CAMERA_HEIGHT_M = 1.0
PITCH_RAD = np.deg2rad(20.0)
FRAME_STEP_M, FRAME_STEP_S = 0.25, 0.25

BACKGROUND, SAND, ROCK = 0, 1, 2

BOXES_M = np.array(
    [
        [[-0.7, 2.0, -0.1], [-0.3, 2.4, 0.35]],
        [[0.3, 2.6, -0.1], [0.9, 3.2, 0.5]],
        [[-0.4, 3.7, -0.1], [0.1, 4.1, 0.4]],
    ]
)
"""Lower and upper corners, in the world; they reach into the ground."""

CAMERA = {
    "image_size_px": [WIDTH_PX, HEIGHT_PX],
    "fx_px": F_PX,
    "cx_px": CX_PX,
    "cy_px": CY_PX,
    "baseline_m": BASELINE_M,
}
"""The rectified pair, as camera.yaml."""

_SUBSAMPLES = 3


class SceneFrame(NamedTuple):
    """One view: uint8 images, and the truth of the left one (depth along the optical axis, inf for sky)."""

    left: np.ndarray
    right: np.ndarray
    depth_m: np.ndarray
    labels: np.ndarray
    T_world_camera: np.ndarray

    @property
    def disparity_px(self) -> np.ndarray:
        """The true disparity; 0 for the sky."""
        return BASELINE_M * F_PX / self.depth_m


def pose(index: int) -> np.ndarray:
    """T_world_camera of the left camera: 1 m above the ground, pitched down, moving north (+y)."""
    c, s = np.cos(PITCH_RAD), np.sin(PITCH_RAD)
    T = np.eye(4)
    T[:3, :3] = np.array([[1, 0, 0], [0, -s, c], [0, -c, -s]])
    T[:3, 3] = [0.0, index * FRAME_STEP_M, CAMERA_HEIGHT_M]
    return T


def timestamp_s(index: int) -> float:
    """When a frame was taken."""
    return 100.0 + index * FRAME_STEP_S


@cache
def scene_frame(index: int) -> SceneFrame:
    """One frame of the traverse, seen by the rectified pair."""
    T_world_left = pose(index)
    T_left_right = np.eye(4)
    T_left_right[0, 3] = BASELINE_M
    depth_m, labels = _truth(_pinhole_rays, T_world_left)
    return SceneFrame(
        _picture(_pinhole_rays, T_world_left),
        _picture(_pinhole_rays, T_world_left @ T_left_right),
        depth_m,
        labels,
        T_world_left,
    )


def raw_frame(rig: StereoRig, index: int) -> SceneFrame:
    """One frame of the traverse, seen by a raw pair; the pose is that of its left camera."""
    T_right_left = np.eye(4)
    T_right_left[:3, :3], T_right_left[:3, 3] = rig.R_right_left, rig.t_right_left_m

    def left(u_px, v_px):
        return _distorted_rays(rig.K_left, rig.distortion_left, u_px, v_px)

    def right(u_px, v_px):
        return _distorted_rays(rig.K_right, rig.distortion_right, u_px, v_px)

    depth_m, labels = _truth(left, pose(index))
    return SceneFrame(
        _picture(left, pose(index)),
        _picture(right, pose(index) @ np.linalg.inv(T_right_left)),
        depth_m,
        labels,
        pose(index),
    )


def write_folder_sequence(
    path: Path, frames: int | tuple[int, ...] = 6, *, offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Path:
    """Writes a plain folder: left, right, camera.yaml, times.txt, poses.tum, labels; returns `path`.

    Args:
        path: the folder.
        frames: how many, or which.
        offset_m: added to all positions (georeferenced poses).
    """
    indices = tuple(range(frames)) if isinstance(frames, int) else frames
    for part in ("left", "right", "labels"):
        (path / part).mkdir(parents=True)
    for index in indices:
        frame = scene_frame(index)
        for part, image in (("left", frame.left), ("right", frame.right), ("labels", frame.labels)):
            Image.fromarray(image).save(path / part / f"{frame_name(index)}.png")
    (path / "camera.yaml").write_text(yaml.safe_dump(CAMERA))
    (path / "times.txt").write_text("".join(f"{timestamp_s(index)}\n" for index in indices))
    T_world_camera = np.stack([pose(index) for index in indices])
    T_world_camera[:, :3, 3] += offset_m
    write_tum(path / "poses.tum", np.array([timestamp_s(index) for index in indices]), T_world_camera)
    return path


def frame_name(index: int) -> str:
    """The name of a frame's files, without their ending."""
    return f"f{index:03d}"


def _pinhole_rays(u_px: np.ndarray, v_px: np.ndarray) -> np.ndarray:
    return np.stack([(u_px - CX_PX) / F_PX, (v_px - CY_PX) / F_PX, np.ones_like(u_px)], axis=-1)


def _distorted_rays(K: np.ndarray, distortion: np.ndarray, u_px: np.ndarray, v_px: np.ndarray) -> np.ndarray:
    """Rays of a lens with distortion k1 k2 p1 p2, by fixed-point iteration."""
    k1, k2, p1, p2 = distortion[:4]
    x_seen, y_seen = (u_px - K[0, 2]) / K[0, 0], (v_px - K[1, 2]) / K[1, 1]
    x, y = x_seen, y_seen
    for _ in range(30):
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x, y = (x_seen - dx) / radial, (y_seen - dy) / radial
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def _truth(rays, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    v_px, u_px = np.mgrid[:HEIGHT_PX, :WIDTH_PX].astype(np.float64)
    depth_m, labels, _ = _cast(rays(u_px, v_px), T_world_camera)
    return depth_m, labels


def _picture(rays, T_world_camera: np.ndarray) -> np.ndarray:
    """uint8 (H, W): the mean over the samples of each pixel."""
    v_px, u_px = np.mgrid[:HEIGHT_PX, :WIDTH_PX].astype(np.float64)
    offsets = (np.arange(_SUBSAMPLES) + 0.5) / _SUBSAMPLES - 0.5
    total = np.zeros((HEIGHT_PX, WIDTH_PX))
    for dv in offsets:
        for du in offsets:
            total += _cast(rays(u_px + du, v_px + dv), T_world_camera)[2]
    return np.rint(total / _SUBSAMPLES**2).clip(0, 255).astype(np.uint8)


def _cast(rays_camera: np.ndarray, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth, label and brightness of rays with z = 1 in the camera, so that lengths along them are depths."""
    directions = rays_camera @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m = np.where(directions[..., 2] < -1e-9, -origin[2] / directions[..., 2], np.inf)
        labels = np.where(np.isfinite(depth_m), SAND, BACKGROUND).astype(np.uint8)
        for lower, upper in BOXES_M:
            to_lower, to_upper = (lower - origin) / directions, (upper - origin) / directions
            enters = np.minimum(to_lower, to_upper).max(axis=-1)
            leaves = np.maximum(to_lower, to_upper).min(axis=-1)
            hit = (enters <= leaves) & (enters > 0) & (enters < depth_m)
            depth_m, labels = np.where(hit, enters, depth_m), np.where(hit, np.uint8(ROCK), labels)
    # The sky is a sphere so far away that both cameras see it alike.
    sky = directions / np.linalg.norm(directions, axis=-1, keepdims=True) * 2.5
    solid = np.isfinite(depth_m)
    points = np.where(solid[..., None], origin + directions * np.where(solid, depth_m, 0.0)[..., None], sky)
    return depth_m, labels, _brightness(points)


@cache
def _waves() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(4)
    wavelength_m = np.geomspace(0.05, 0.6, 20)
    directions = rng.normal(size=(20, 3))
    directions *= (2 * np.pi / wavelength_m / np.linalg.norm(directions, axis=1))[:, None]
    return directions, rng.uniform(0, 2 * np.pi, 20), 11.0 * (wavelength_m / 0.2) ** 0.3


def _brightness(points: np.ndarray) -> np.ndarray:
    total = np.full(points.shape[:-1], 125.0)
    for direction, phase, amplitude in zip(*_waves(), strict=True):
        total += amplitude * np.sin(points @ direction + phase)
    return total
