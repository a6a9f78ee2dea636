"""Where things are on the Katwijk rover.

The IMU frame is x backward, y right, z up; camera frames are x right, y down, z forward. The numbers
are those of the data set's documents (Hewitt et al. 2018, "The Katwijk beach planetary rover
dataset", International Journal of Robotics Research 37(1)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from jaxmap.datasets.katwijk_files import read_pan_tilt
from jaxmap.localisation.sensors import time_to_nearest

ANTENNA_IMU_M = (0.221, -0.052, 1.5785)
"""The GPS antenna in the IMU frame. Sources differ on its height (1.503 m): `ReadOptions.antenna_m` sets it."""

IMU_HEIGHT_M = 0.543
"""Over the ground: LocCam is 1.10 m above it and 0.557 m above the IMU."""

TURNING_CENTRE_M = -0.05
"""Between the IMU and the axle of the centre wheels, 0.11 m behind it."""

R_BODY_IMU = np.diag([-1.0, -1.0, 1.0])
"""The body frame of `localisation` is x forward, y left, z up."""

MAX_PAN_TILT_GAP_S = 1.0
"""Frames farther from any reading of the pan-tilt unit are counted."""


def _transform(translation_m: Sequence[float], quaternion_xyzw: Sequence[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quaternion_xyzw).as_matrix()
    T[:3, 3] = translation_m
    return T


@dataclass(frozen=True)
class RoverCamera:
    """One stereo camera of the rover.

    Attributes:
        folder: where its images lie in a part.
        size_px: (width, height).
        T_mount_camera: (4, 4), the left optical frame in what the camera is fixed to.
        T_imu_mount: (4, 4), where that is when the pan-tilt unit, if it stands on it, looks ahead.
        on_pan_tilt: whether it turns with `ptu.txt`.
    """

    folder: str
    size_px: tuple[int, int]
    T_mount_camera: np.ndarray
    T_imu_mount: np.ndarray
    on_pan_tilt: bool = False


CAMERAS = {
    "loccam": RoverCamera(
        folder="LocCam",
        size_px=(1024, 768),
        T_mount_camera=_transform((-0.382, -0.078, 0.557), (0.572, 0.572, -0.416, -0.416)),
        T_imu_mount=np.eye(4),
    ),
    "pancam": RoverCamera(
        folder="PanCam",
        size_px=(1280, 960),
        T_mount_camera=_transform((0.010, 0.250, 0.054), (0.5, -0.5, 0.5, -0.5)),
        T_imu_mount=_transform((-0.138, -0.005, 1.286), (0.0, 0.0, 1.0, 0.0)),
        on_pan_tilt=True,
    ),
}
"""The cameras by the names that `ReadOptions.camera` takes; the first is the default."""


def body_to_camera(
    folder: Path, camera: RoverCamera, timestamps_s: Float64[np.ndarray, "N"]
) -> tuple[np.ndarray, list[str]]:
    """T_body_camera of the left camera, (4, 4) or, on the pan-tilt unit, (N, 4, 4); and notes.

    Pan and tilt are read from `ptu.txt` in radians, pan positive to the left and tilt positive
    down, pan turning what tilts.

    Raises:
        JaxmapError: the camera needs `ptu.txt`, and it is missing or mostly damaged.
    """
    T_body_imu = np.eye(4)
    T_body_imu[:3, :3] = R_BODY_IMU
    if not camera.on_pan_tilt:
        return T_body_imu @ camera.T_imu_mount @ camera.T_mount_camera, []
    ptu_s, angles, notes = read_pan_tilt(folder)
    pan, tilt = (np.interp(timestamps_s, ptu_s, np.unwrap(column)) for column in angles.T)
    T_mount_turned = np.tile(np.eye(4), (len(timestamps_s), 1, 1))
    T_mount_turned[:, :3, :3] = Rotation.from_euler("ZY", np.stack([pan, tilt], axis=-1)).as_matrix()
    notes = [*notes, "pan and tilt of ptu.txt are taken for radians, positive to the left and down"]
    away_s = time_to_nearest(ptu_s, timestamps_s)
    if far := int((away_s > MAX_PAN_TILT_GAP_S).sum()):
        notes.append(f"{far} of {len(timestamps_s)} frames have no pan and tilt within {MAX_PAN_TILT_GAP_S:g} s")
    return T_body_imu @ camera.T_imu_mount @ T_mount_turned @ camera.T_mount_camera, notes
