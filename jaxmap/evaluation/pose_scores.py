"""How far estimated poses of a rover's camera are from the true ones."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation


class PoseErrors(NamedTuple):
    """Errors without sign, (N,) each: in metres, and in degrees within 180."""

    position_m: np.ndarray
    heading_deg: np.ndarray
    roll_deg: np.ndarray
    pitch_deg: np.ndarray


def pose_errors(
    T_world_camera: Float64[np.ndarray, "N 4 4"],
    T_world_camera_true: Float64[np.ndarray, "N 4 4"],
    T_body_camera: Float64[np.ndarray, "*N 4 4"],
) -> PoseErrors:
    """Compares the cameras' positions, and the attitudes of the body that carries them.

    Args:
        T_world_camera: estimated.
        T_world_camera_true: true, in the same z-up world.
        T_body_camera: where the camera is in the body (x forward, y left, z up), whose heading, roll
            and pitch are compared.
    """
    R_camera_body = np.swapaxes(T_body_camera[..., :3, :3], -1, -2)
    angles, true_angles = (
        Rotation.from_matrix(T[:, :3, :3] @ R_camera_body).as_euler("ZYX", degrees=True)
        for T in (T_world_camera, T_world_camera_true)
    )
    heading, pitch, roll = np.abs((angles - true_angles + 180) % 360 - 180).T
    position = np.linalg.norm(T_world_camera[:, :3, 3] - T_world_camera_true[:, :3, 3], axis=1)
    return PoseErrors(position, heading, roll, pitch)
