"""What is refined: a motion of each frame, one of the camera in its mounting, the baseline, the disparity offset."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

SHARED = 8
"""Numbers that all frames share: mounting (3 m, 3 rad), logarithm of the baseline's scale, disparity offset."""

PER_FRAME = 6
"""Numbers of one frame: 3 m in the world, 3 rad in the camera frame."""


@dataclass(frozen=True)
class Rig:
    """Where the cameras are held to be.

    `T_world_camera = T_world_nominal @ T_nominal_camera`: a nominal pose for each frame, which errs by itself, and
    one displacement of the camera in its mounting.

    Attributes:
        T_world_nominal: float64 (N, 4, 4).
        T_nominal_camera: float64 (4, 4).
        log_baseline_scale: the baseline is that of the calibration times its exponential.
        offset_px: added to the calibration's disparity offset.
    """

    T_world_nominal: np.ndarray
    T_nominal_camera: np.ndarray
    log_baseline_scale: float = 0.0
    offset_px: float = 0.0

    @property
    def T_world_camera(self) -> Float64[np.ndarray, "N 4 4"]:
        """Poses of the cameras."""
        return self.T_world_nominal @ self.T_nominal_camera


def make_rig(T_world_camera: Float64[np.ndarray, "N 4 4"]) -> Rig:
    """The rig that given poses describe."""
    return Rig(np.array(T_world_camera, np.float64), np.eye(4))


def moved(rig: Rig, step: Float64[np.ndarray, "n"]) -> Rig:
    """The rig after a step: `PER_FRAME` numbers of each frame, then the `SHARED` ones."""
    frames = len(rig.T_world_nominal)
    own, shared = step[: PER_FRAME * frames].reshape(frames, PER_FRAME), step[PER_FRAME * frames :]
    return replace(
        rig,
        T_world_nominal=_moved(rig.T_world_nominal, own),
        T_nominal_camera=_moved(rig.T_nominal_camera[None], shared[None, :6])[0],
        log_baseline_scale=rig.log_baseline_scale + float(shared[6]),
        offset_px=rig.offset_px + float(shared[7]),
    )


def displacement(rig: Rig, given: Rig) -> Float64[np.ndarray, "n"]:
    """The step that leads from a given rig to this one."""
    own = _between(given.T_world_nominal, rig.T_world_nominal)
    mounting = _between(given.T_nominal_camera[None], rig.T_nominal_camera[None])
    scalars = [rig.log_baseline_scale - given.log_baseline_scale, rig.offset_px - given.offset_px]
    return np.concatenate([own.ravel(), mounting.ravel(), scalars])


def _moved(T: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Translations in the outer frame, rotations in the inner one: the place stays when the attitude changes."""
    T = T.copy()
    T[:, :3, 3] += step[:, :3]
    T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(step[:, 3:]).as_matrix()
    return T


def _between(T_before: np.ndarray, T_after: np.ndarray) -> np.ndarray:
    turn = Rotation.from_matrix(T_before[:, :3, :3].transpose(0, 2, 1) @ T_after[:, :3, :3]).as_rotvec()
    return np.concatenate([T_after[:, :3, 3] - T_before[:, :3, 3], turn], axis=1)


class Axes(NamedTuple):
    """Axes of the vehicle in the camera frame: forward, left and up, level in the mean over the frames."""

    R_vehicle_camera: np.ndarray


def vehicle_axes(T_world_camera: Float64[np.ndarray, "N 4 4"]) -> Axes:
    """Axes of the vehicle, from the mean up direction in the camera frame and the optical axis."""
    up = T_world_camera[:, 2, :3].mean(axis=0)
    up /= np.linalg.norm(up)
    ahead = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.95 else np.array([0.0, -1.0, 0.0])
    forward = ahead - up * (ahead @ up)
    forward /= np.linalg.norm(forward)
    return Axes(np.stack([forward, np.cross(up, forward), up]))
