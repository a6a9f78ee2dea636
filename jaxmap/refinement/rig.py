"""The refined parameters: a pose correction of each frame, the camera's mounting, baseline and disparity offset."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from jaxmap.refinement.frames import PixelSamples, unproject
from jaxmap.types import Pinhole

SHARED = 8
"""Parameters that all frames share: mounting (3 m, 3 rad), logarithm of the baseline's scale, disparity offset."""

PER_FRAME = 6
"""Parameters of one frame: 3 m in the world, 3 rad in the camera frame."""


@dataclass(frozen=True)
class Rig:
    """The poses and the calibration of a stereo camera along its path.

    `T_world_camera = T_world_nominal @ T_nominal_camera`: a nominal pose for each frame, each with an error of its own,
    and one displacement of the camera in its mounting.

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
    """The rig of given poses, before any refinement."""
    return Rig(np.array(T_world_camera, np.float64), np.eye(4))


def moved(rig: Rig, step: Float64[np.ndarray, "n"]) -> Rig:
    """The rig after a step: `PER_FRAME` parameters of each frame, then the `SHARED` ones."""
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
    """Translations in the outer frame, rotations in the inner one: a rotation leaves the position as it is."""
    T = T.copy()
    T[:, :3, 3] += step[:, :3]
    T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(step[:, 3:]).as_matrix()
    return T


def _between(T_before: np.ndarray, T_after: np.ndarray) -> np.ndarray:
    turn = Rotation.from_matrix(T_before[:, :3, :3].transpose(0, 2, 1) @ T_after[:, :3, :3]).as_rotvec()
    return np.concatenate([T_after[:, :3, 3] - T_before[:, :3, 3], turn], axis=1)


def vehicle_axes(T_world_camera: Float64[np.ndarray, "N 4 4"]) -> Float64[np.ndarray, "3 3"]:
    """R_vehicle_camera: rows are the vehicle's forward, left and up axes in the camera frame, level in the mean.

    Up is the mean up direction over the frames; forward follows the optical axis.
    """
    up = T_world_camera[:, 2, :3].mean(axis=0)
    up /= np.linalg.norm(up)
    ahead = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.95 else np.array([0.0, -1.0, 0.0])
    forward = ahead - up * (ahead @ up)
    forward /= np.linalg.norm(forward)
    return np.stack([forward, np.cross(up, forward), up])


def points_world(rig: Rig, camera: Pinhole, samples: PixelSamples) -> Float64[np.ndarray, "P 3"]:
    """Where sampled pixels are in the world, under a rig."""
    calibrated = camera._replace(
        baseline_m=camera.baseline_m * float(np.exp(rig.log_baseline_scale)), doffs_px=camera.doffs_px + rig.offset_px
    )
    local = unproject(calibrated, samples.uvd_px[:, :2], samples.uvd_px[:, 2])
    T = rig.T_world_camera[samples.frames]
    return np.einsum("pij,pj->pi", T[:, :3, :3], local) + T[:, :3, 3]
