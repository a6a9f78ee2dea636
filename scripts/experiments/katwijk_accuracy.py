"""How far the Katwijk reader's own poses are from true ones, on simulated parts and on made-up drives.

    python scripts/experiments/katwijk_accuracy.py [PART TRUTH.tum]... [--drives N]

PART is a folder that holds LocCam, TRUTH.tum its true T_world_camera in UTM. Without any, the traverse kept beside the
repository is taken, if it is there. N drives of each kind (straight, curves, with stops, turns on the spot, reversing,
circling) are made up, with what the rover's sensors would record of them. Prints one table: median and greatest error
at the times of the images.
"""

from __future__ import annotations

import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import SHARED, Table, command_line, parse
from PIL import Image
from pyproj import Transformer
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from jaxmap.datasets.katwijk import CAMERAS, R_BODY_IMU, open_katwijk
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.poses import PoseTrack, make_pose_track, poses_at, read_poses
from jaxmap.evaluation.geometry_scores import PoseErrors, pose_errors
from jaxmap.simulation.sensors import time_stamp

T_IMU_CAMERA = CAMERAS["loccam"].T_mount_camera
T_BODY_CAMERA = np.block([[R_BODY_IMU, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]]) @ T_IMU_CAMERA
START_S = datetime(2015, 11, 26, 12, 53, 20, tzinfo=UTC).timestamp()
STEP_S, IMAGES = 0.004, 40
SITE_UTM_M, IMU_HEIGHT_M, TURNING_CENTRE_M = np.array([595_700.0, 5_785_780.0, 46.0]), 0.543, -0.11
ANTENNA_IMU_M, GPS_SIGMA_M = np.array([0.221, -0.052, 1.5785]), np.array([0.01, 0.01, 0.02])
GYRO_BIAS, GYRO_SIGMA, FORCE_SIGMA = np.array([0.002, -0.001, 0.002]), 0.003, 0.05
WHEEL_RADIUS_M, SLIP = 0.118, 0.05

DRIVES = {
    "straight": [(3, 0, 0), (40, 0.3, 0)],
    "curves": [(3, 0, 0), (8, 0.3, 0), (15, 0.3, 0.1), (15, 0.3, -0.15), (8, 0.3, 0)],
    "stops": [(10, 0.3, 0), (6, 0, 0), (10, 0.4, 0), (5, 0, 0), (10, 0.3, 0.1), (4, 0, 0)],
    "on the spot": [(2, 0, 0), (12, 0.3, 0), (6, 0, 0.3), (12, 0.3, 0), (10, 0, -0.3), (10, 0.3, 0)],
    "reversing": [(2, 0, 0), (15, 0.3, 0), (2, 0, 0), (12, -0.25, 0), (2, 0, 0), (10, 0.3, 0.2)],
    "circling": [(3, 0, 0), (10, 0.3, 0), (60, 0.3, 0.06)],
    "all of it": [
        *((4, 0, 0), (12, 0.3, 0.05), (6, 0.3, -0.12), (3, 0, 0), (5, 0, 0.35)),
        *((12, 0.35, 0), (8, -0.2, 0.08), (2, 0, 0), (12, 0.3, 0.1)),
    ],
}
"""Kinds of drives: seconds, speed (m/s) and turn rate (rad/s, to the left) of each part."""


class Drive(NamedTuple):
    """The truth every `STEP_S`: times from 0, the IMU's position, the body's attitude, speed and turn rate."""

    times_s: np.ndarray
    position_m: np.ndarray
    R_world_body: Rotation
    speed_m_s: np.ndarray
    turn_rad_s: np.ndarray

    def T_world_imu(self, times_s: np.ndarray) -> np.ndarray:
        """Poses (N, 4, 4)."""
        index = np.round(times_s / STEP_S).astype(int)
        T = np.tile(np.eye(4), (len(index), 1, 1))
        T[:, :3, :3] = self.R_world_body[index].as_matrix() @ R_BODY_IMU
        T[:, :3, 3] = self.position_m[index]
        return T


def make_drive(kind: str, seed: int) -> Drive:
    """A drive over rolling ground; speeds change within half a second."""

    def smooth(values: np.ndarray, seconds: float) -> np.ndarray:
        return gaussian_filter1d(values, seconds / STEP_S, mode="nearest")

    heading_rad, rng = np.random.default_rng(seed).uniform(-np.pi, np.pi), np.random.default_rng(seed)
    seconds, speeds, turns = zip(*DRIVES[kind], strict=True)
    counts = np.round(np.array(seconds) / STEP_S).astype(int)
    speed, turn = smooth(np.repeat(speeds, counts), 0.25), smooth(np.repeat(turns, counts), 0.25)
    heading = heading_rad + np.cumsum(turn) * STEP_S
    # The ground tilts the rover by where it is, that is by the distance driven and the angle turned.
    way = np.cumsum(np.abs(speed) + 0.3 * np.abs(turn)) * STEP_S
    ground = np.arange(0, max(way[-1], 10), 0.02)
    bumps = gaussian_filter1d(rng.normal(size=(2, len(ground))), 0.35 / 0.02, mode="wrap")
    bumps *= 0.04 / bumps.std(axis=1, keepdims=True)
    roll, pitch = (smooth(np.interp(way, ground, bump), 0.2) for bump in bumps)
    R = Rotation.from_euler("ZYX", np.stack([heading, pitch, roll], axis=-1))
    left = np.stack([-np.sin(heading), np.cos(heading), np.zeros_like(heading)], axis=-1)
    velocity = R.apply([1.0, 0, 0]) * speed[:, None] - left * (TURNING_CENTRE_M * turn)[:, None]
    # Wheels hold on to the ground, and the IMU sways above it.
    position = np.cumsum(velocity, axis=0) * STEP_S + R.apply([0, 0, IMU_HEIGHT_M])
    position += SITE_UTM_M + rng.uniform(-50, 50, 3) - position[0]
    return Drive(np.arange(len(speed)) * STEP_S, position, R, speed, turn)


def write_part(folder: Path, drive: Drive, seed: int) -> np.ndarray:
    """Writes the text files of a part, and black images; the times of the images, from 0."""
    rng = np.random.default_rng(seed)
    (folder / "LocCam").mkdir(parents=True)
    for name, rows in (("gps-latlong", gps_rows), ("imu", imu_rows), ("odometry", odometry_rows)):
        (folder / f"{name}.txt").write_text(
            "".join(f"{time_stamp(START_S + t)} {row}\n" for t, row in rows(drive, rng))
        )
    frames_s = np.round(np.linspace(1.5, drive.times_s[-1] - 1.5, IMAGES) / STEP_S) * STEP_S
    Image.fromarray(np.zeros((768, 1024), np.uint8)).save(folder / "black.png")
    for time_s in frames_s:
        for side in (0, 1):
            path = folder / "LocCam" / f"LocCam_{time_stamp(START_S + time_s)}_{side}.png"
            path.hardlink_to(folder / "black.png")
    return frames_s


def gps_rows(drive: Drive, rng: np.random.Generator) -> list[tuple[float, str]]:
    """Status, latitude, longitude, altitude and standard deviations, every 3 s."""
    times_s = np.arange(0.6, drive.times_s[-1] - 0.1, 3.0)
    T = drive.T_world_imu(times_s)
    antenna = T[:, :3, 3] + T[:, :3, :3] @ ANTENNA_IMU_M + rng.normal(size=(len(T), 3)) * GPS_SIGMA_M
    longitude, latitude = Transformer.from_crs("EPSG:32631", "EPSG:4326", always_xy=True).transform(*antenna[:, :2].T)
    sigma = " ".join(f"{GPS_SIGMA_M[axis]:.4f}" for axis in (1, 0, 2))
    places = zip(latitude, longitude, antenna[:, 2], strict=True)
    rows = [f"RTK_FIXED {north:.11f} {east:.11f} {up:.4f} {sigma}" for north, east, up in places]
    return list(zip(times_s, rows, strict=True))


def imu_rows(drive: Drive, rng: np.random.Generator) -> list[tuple[float, str]]:
    """Specific force of the accelerometer, turn rate and specific force of the inclinometer, at 125 Hz."""
    R, every = drive.R_world_body, 2
    rate = (R[:-every].inv() * R[every:]).as_rotvec()[::every] / (every * STEP_S)
    velocity = np.gradient(drive.position_m, STEP_S, axis=0)
    acceleration = gaussian_filter1d(np.gradient(velocity, STEP_S, axis=0), 5, axis=0)
    force = R.inv().apply(acceleration + np.array([0, 0, 9.81]))[:-every:every] @ R_BODY_IMU
    rate = rate @ R_BODY_IMU + GYRO_BIAS + rng.normal(size=rate.shape) * GYRO_SIGMA
    rough, fine = (force + rng.normal(size=force.shape) * sigma for sigma in (4 * FORCE_SIGMA, FORCE_SIGMA))
    # Each sample is the mean rate of the interval around its time.
    return _rows(drive.times_s[:-every:every] + STEP_S, np.hstack([rough, rate, fine]))


def odometry_rows(drive: Drive, rng: np.random.Generator) -> list[tuple[float, str]]:
    """Angles and rates of six wheels (four steered joints stay at zero), at 12.5 Hz."""
    index = np.arange(0, len(drive.times_s), 20)
    speed, turn = drive.speed_m_s[index, None], drive.turn_rad_s[index, None]
    slip = 1 + SLIP * gaussian_filter1d(rng.normal(size=len(index)), 25, mode="wrap") * 8
    forward_m, left_m = np.array([0.75, 0.75, 0, 0, -0.75, -0.75]), np.array([1, -1, 1, -1, 1, -1]) * 0.4
    along, across = speed - turn * left_m, turn * forward_m
    rates = np.sign(along) * np.hypot(along, across) * slip[:, None] / WHEEL_RADIUS_M
    rates += rng.normal(size=rates.shape) * 0.005
    joints = np.zeros((len(index), 10, 3))
    joints[:, :6, 0], joints[:, :6, 1] = np.cumsum(rates, axis=0) * 0.08, rates
    table = np.hstack([joints.reshape(len(index), 30), rng.normal(size=(len(index), 3)) * 0.01])
    return _rows(drive.times_s[index], table)


def _rows(times_s: np.ndarray, table: np.ndarray) -> list[tuple[float, str]]:
    return [(t, " ".join(f"{value:.6f}" for value in row)) for t, row in zip(times_s, table, strict=True)]


def errors_of(part: Path, truth: PoseTrack) -> PoseErrors:
    """The errors at the times of the frames of a part."""
    sequence = open_katwijk(part, ReadOptions())
    times_s = np.array([frame.timestamp_s for frame in sequence.frames])
    T_true, has_truth = poses_at(truth, times_s, max_gap_s=1.0)
    T = sequence.T_world_camera.copy()
    T[:, :3, 3] += sequence.site_origin
    return pose_errors(T[has_truth], T_true[has_truth], T_BODY_CAMERA)


def errors_of_drive(kind: str, seed: int) -> PoseErrors:
    """The errors on one made-up drive."""
    drive = make_drive(kind, seed)
    with tempfile.TemporaryDirectory() as folder:
        frames_s = write_part(Path(folder), drive, seed)
        truth = make_pose_track(START_S + frames_s, drive.T_world_imu(frames_s) @ T_IMU_CAMERA)
        return errors_of(Path(folder), truth)


def main() -> None:
    """Prints the table."""
    parser = command_line(__doc__)
    parser.add_argument("parts", nargs="*", type=Path, metavar="PART TRUTH")
    parser.add_argument("--drives", type=int, default=10)
    given = parse(parser)
    traverse = SHARED / "simdata" / "traverse_a"
    parts = given.parts or [traverse / "Part1", traverse / "gt" / "poses_utm.tum"]
    kinds = {"position, cm": "13.1f", "heading, deg": "14.2f", "roll, deg": "11.2f", "pitch, deg": "12.2f"}
    columns = {"median, greatest": "<22", "frames": "7d"}
    for name, form in kinds.items():
        columns |= {name: form, " " * len(columns): "7" + form[-3:]}
    table = Table(columns)

    def report(name: str, errors: list[PoseErrors]) -> None:
        position_m, *angles = (np.concatenate(values) for values in zip(*errors, strict=True))
        numbers = [float(fold(values)) for values in (100 * position_m, *angles) for fold in (np.median, np.max)]
        table.row(name, len(position_m), *numbers)

    for part, truth in zip(parts[::2], parts[1::2], strict=True):
        if part.is_dir():
            report(f"{part.resolve().parent.name} {part.name}", [errors_of(part, read_poses(truth))])
        else:
            print(f"left out: there is no {part}")
    for kind in DRIVES:
        report(f"{given.drives} x {kind}", [errors_of_drive(kind, seed) for seed in range(given.drives)])


if __name__ == "__main__":
    main()
