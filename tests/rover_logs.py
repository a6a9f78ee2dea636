"""Simulated drives of a rover and the recordings of its sensors: ground truth for estimated poses."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

START_S = datetime(2015, 11, 26, 12, 53, 20, tzinfo=UTC).timestamp()
SITE_UTM_M = np.array([595_700.0, 5_785_780.0, 46.0])
STEP_S = 0.004
IMU_HEIGHT_M = 0.543
R_BODY_IMU = np.diag([-1.0, -1.0, 1.0])

T_IMU_LOCCAM = np.eye(4)
T_IMU_LOCCAM[:3, :3] = Rotation.from_quat([0.572, 0.572, -0.416, -0.416]).as_matrix()
T_IMU_LOCCAM[:3, 3] = [-0.382, -0.078, 0.557]


class Stretch(NamedTuple):
    """A part of a drive: duration, forward speed, turn rate to the left."""

    seconds: float
    speed_m_s: float = 0.3
    turn_rad_s: float = 0.0


DRIVES = {
    "straight": [Stretch(3, 0), Stretch(40)],
    "curves": [Stretch(3, 0), Stretch(8), Stretch(15, 0.3, 0.1), Stretch(15, 0.3, -0.15), Stretch(8)],
    "stops": [Stretch(10), Stretch(6, 0), Stretch(10, 0.4), Stretch(5, 0), Stretch(10, 0.3, 0.1), Stretch(4, 0)],
    "on the spot": [Stretch(2, 0), Stretch(12), Stretch(6, 0, 0.3), Stretch(12), Stretch(10, 0, -0.3), Stretch(10)],
    "reversing": [Stretch(2, 0), Stretch(15), Stretch(2, 0), Stretch(12, -0.25), Stretch(2, 0), Stretch(10, 0.3, 0.2)],
    "circling": [Stretch(3, 0), Stretch(10), Stretch(60, 0.3, 0.06)],
    "all of it": [
        *(Stretch(4, 0), Stretch(12, 0.3, 0.05), Stretch(6, 0.3, -0.12), Stretch(3, 0), Stretch(5, 0, 0.35)),
        *(Stretch(12, 0.35), Stretch(8, -0.2, 0.08), Stretch(2, 0), Stretch(12, 0.3, 0.1)),
    ],
}
"""Kinds of drives."""


@dataclass(frozen=True)
class Sensors:
    """Errors of the sensors; the defaults are a little worse than in the recorded excerpts."""

    gps_sigma_m: tuple[float, float, float] = (0.01, 0.01, 0.02)
    gps_every_s: float = 3.0
    antenna_imu_m: tuple[float, float, float] = (0.221, -0.052, 1.5785)
    gyro_bias: tuple[float, float, float] = (0.002, -0.001, 0.002)
    gyro_sigma: float = 0.003
    force_sigma: float = 0.05
    wheel_radius_m: float = 0.118
    slip: float = 0.05
    turning_centre_m: float = -0.11


class Drive(NamedTuple):
    """The truth, every `STEP_S`: times from 0, the IMU's position, body attitude (x forward), speed and turning."""

    times_s: np.ndarray
    position_m: np.ndarray
    R_world_body: Rotation
    speed_m_s: np.ndarray
    turn_rad_s: np.ndarray

    def at(self, times_s: np.ndarray) -> np.ndarray:
        """T_world_imu, (N, 4, 4)."""
        index = np.round(np.asarray(times_s) / STEP_S).astype(int)
        T = np.tile(np.eye(4), (len(index), 1, 1))
        T[:, :3, :3] = self.R_world_body[index].as_matrix() @ R_BODY_IMU
        T[:, :3, 3] = self.position_m[index]
        return T


def drive(
    stretches: list[Stretch],
    seed: int = 0,
    heading_rad: float = 0.7,
    roughness_rad: float = 0.04,
    centre_m: float = -0.11,
) -> Drive:
    """Drives the stretches over rolling ground; speeds change within half a second."""
    rng = np.random.default_rng(seed)
    counts = [round(stretch.seconds / STEP_S) for stretch in stretches]
    smooth = lambda values, seconds: gaussian_filter1d(values, seconds / STEP_S, mode="nearest")  # noqa: E731
    speed = smooth(np.repeat([stretch.speed_m_s for stretch in stretches], counts), 0.25)
    turn = smooth(np.repeat([stretch.turn_rad_s for stretch in stretches], counts), 0.25)
    times_s = np.arange(len(speed)) * STEP_S
    heading = heading_rad + np.cumsum(turn) * STEP_S
    # The ground tilts the rover depending on the distance driven and turned.
    way = np.cumsum(np.abs(speed) + 0.3 * np.abs(turn)) * STEP_S
    ground = np.arange(0, max(way[-1], 10), 0.02)
    bumps = gaussian_filter1d(rng.normal(size=(2, len(ground))), 0.35 / 0.02, mode="wrap")
    bumps *= roughness_rad / bumps.std(axis=1, keepdims=True)
    roll, pitch = (smooth(np.interp(way, ground, bump), 0.2) for bump in bumps)
    R = Rotation.from_euler("ZYX", np.stack([heading, pitch, roll], axis=-1))
    along = R.apply([1.0, 0, 0]) * speed[:, None]
    across = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], -1) * (-centre_m * turn)[:, None]
    # The wheels do not slide, and the IMU sways above the ground.
    position = np.cumsum(along + across, axis=0) * STEP_S + R.apply([0, 0, IMU_HEIGHT_M])
    return Drive(times_s, position - position[0] + SITE_UTM_M + rng.uniform(-50, 50, 3), R, speed, turn)


def time_text(time_s: float) -> str:
    """A time in the data set's format: milliseconds without leading zeros."""
    milliseconds = round((START_S + time_s) * 1000)
    moment = datetime.fromtimestamp(milliseconds // 1000, UTC)
    return f"{moment:%Y_%m_%d_%H_%M_%S}_{milliseconds % 1000}"


def write_part(folder: Path, truth: Drive, sensors: Sensors = Sensors(), seed: int = 1, images: int = 0) -> np.ndarray:
    """Writes the text files of a part, and small pictures; returns the times of the frames, from 0."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "gps-latlong.txt").write_text(gps_text(truth, sensors, rng))
    (folder / "imu.txt").write_text(imu_text(truth, sensors, rng))
    (folder / "odometry.txt").write_text(odometry_text(truth, sensors, rng))
    frames_s = np.round(np.linspace(1.5, truth.times_s[-1] - 1.5, max(images, 2)) / STEP_S)[:images] * STEP_S
    if images:
        (folder / "LocCam").mkdir(exist_ok=True)
    for time_s in frames_s:
        for side in (0, 1):
            shutil.copyfile(_black_picture(), folder / "LocCam" / f"LocCam_{time_text(time_s)}_{side}.png")
    return frames_s


@cache
def _black_picture() -> Path:
    path = Path(tempfile.mkdtemp()) / "black.png"
    Image.fromarray(np.zeros((768, 1024), np.uint8)).save(path)
    return path


def gps_text(truth: Drive, sensors: Sensors, rng: np.random.Generator) -> str:
    from pyproj import Transformer

    times_s = np.arange(0.6, truth.times_s[-1] - 0.1, sensors.gps_every_s)
    T = truth.at(times_s)
    antenna = (
        T[:, :3, 3]
        + T[:, :3, :3] @ np.array(sensors.antenna_imu_m)
        + rng.normal(size=(len(T), 3)) * sensors.gps_sigma_m
    )
    longitude, latitude = Transformer.from_crs("EPSG:32631", "EPSG:4326", always_xy=True).transform(*antenna[:, :2].T)
    east, north, up = sensors.gps_sigma_m
    rows = zip(times_s, latitude, longitude, antenna[:, 2], strict=True)
    return "".join(
        f"{time_text(t)} RTK_FIXED {lat:.11f} {lon:.11f} {alt:.4f} {north:.4f} {east:.4f} {up:.4f}\n"
        for t, lat, lon, alt in rows
    )


def imu_text(truth: Drive, sensors: Sensors, rng: np.random.Generator) -> str:
    every = 2
    turned = (truth.R_world_body[:-every].inv() * truth.R_world_body[every:]).as_rotvec() / (every * STEP_S)
    rate = turned[::every]
    velocity = np.gradient(truth.position_m, STEP_S, axis=0)
    acceleration = gaussian_filter1d(np.gradient(velocity, STEP_S, axis=0), 5, axis=0)
    force = truth.R_world_body.inv().apply(acceleration + np.array([0, 0, 9.81]))[:-every:every]
    # Each sample is the mean rate of the interval around it.
    times_s = truth.times_s[:-every:every] + STEP_S
    rate = rate @ R_BODY_IMU + sensors.gyro_bias + rng.normal(size=rate.shape) * sensors.gyro_sigma
    force = force @ R_BODY_IMU
    rough = force + rng.normal(size=force.shape) * 4 * sensors.force_sigma
    fine = force + rng.normal(size=force.shape) * sensors.force_sigma
    table = np.hstack([rough, rate, fine])
    return "".join(
        f"{time_text(t)} {' '.join(f'{v:.6f}' for v in row)}\n" for t, row in zip(times_s, table, strict=True)
    )


def odometry_text(truth: Drive, sensors: Sensors, rng: np.random.Generator) -> str:
    index = np.arange(0, len(truth.times_s), 20)
    speed, turn = truth.speed_m_s[index], truth.turn_rad_s[index]
    slip = 1 + sensors.slip * gaussian_filter1d(rng.normal(size=len(index)), 25, mode="wrap") * 8
    forward_m, left_m = np.array([0.75, 0.75, 0, 0, -0.75, -0.75]), np.array([1, -1, 1, -1, 1, -1]) * 0.4
    along, across = speed[:, None] - turn[:, None] * left_m, turn[:, None] * forward_m
    rates = np.sign(along) * np.hypot(along, across) * slip[:, None] / sensors.wheel_radius_m
    rates += rng.normal(size=rates.shape) * 0.005
    angles = np.cumsum(rates, axis=0) * 0.08
    joints = np.zeros((len(index), 10, 3))
    joints[:, :6, 0], joints[:, :6, 1] = angles, rates
    table = np.hstack([joints.reshape(len(index), 30), rng.normal(size=(len(index), 3)) * 0.01])
    return "".join(
        f"{time_text(t)} {' '.join(f'{v:.6f}' for v in row)}\n"
        for t, row in zip(truth.times_s[index], table, strict=True)
    )
