"""What the rover's sensors say of a drive: GPS, inertial unit, odometry, pan-tilt unit, as the data set writes them."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from jaxmap.host.files import atomic_path
from jaxmap.simulation.camera_rig import GPS_ANTENNA_BODY_M
from jaxmap.simulation.drive import WHEEL_BASE_M, WHEEL_TRACK_M, Drive

CRS = "EPSG:32631"
WHEEL_RADIUS_M = 0.125
GRAVITY_M_S2 = 9.81

_GPS_PERIOD_S, _IMU_PERIOD_S, _ODOMETRY_PERIOD_S = 3.0, 0.008, 0.080
_DRIVES = [(ahead, side) for ahead in (1, 0, -1) for side in (1, -1)]
"""The driven wheels: front, middle, rear, and left before right; the four outer ones steer."""


def time_stamp(unix_s: float) -> str:
    """`2015_11_26_12_53_34_617`: UTC to the millisecond, which is not padded with zeros, as the data set has it."""
    milliseconds = round(unix_s * 1000)
    return time.strftime("%Y_%m_%d_%H_%M_%S", time.gmtime(milliseconds // 1000)) + f"_{milliseconds % 1000}"


def write_sensors(folder: Path, drive: Drive, seed: int) -> None:
    """Writes `gps-latlong.txt`, `imu.txt`, `odometry.txt` and `ptu.txt`.

    Raises:
        JaxmapError: a file cannot be written.
    """
    _write(folder / "gps-latlong.txt", gps_lines(drive, np.random.default_rng([seed, 0x695])))
    _write(folder / "imu.txt", imu_lines(drive, np.random.default_rng([seed, 0x1340])))
    _write(folder / "odometry.txt", odometry_lines(drive, np.random.default_rng([seed, 0x0D0])))
    _write(folder / "ptu.txt", ptu_lines(drive))


def gps_lines(drive: Drive, rng: np.random.Generator) -> Iterable[str]:
    """Time, status, latitude and longitude (degrees), altitude and three standard deviations (metres), every 3 s."""
    from rasterio.warp import transform

    times = np.arange(0.0, drive.duration_s, _GPS_PERIOD_S)
    T = drive.T_world_body(times)
    sigma = rng.uniform(0.006, 0.012, (len(times), 3)) * (1, 1, 2)
    antenna = T[:, :3, :3] @ np.array(GPS_ANTENNA_BODY_M) + T[:, :3, 3]
    measured = antenna + rng.normal(0, 1, (len(times), 3)) * sigma + np.array(drive.recipe.site_utm_m)
    longitude, latitude = transform(CRS, "EPSG:4326", measured[:, 0], measured[:, 1])[:2]
    for index, when in enumerate(times):
        stamp = time_stamp(drive.recipe.start_time_s + when)
        deviations = " ".join(f"{value:.4f}" for value in sigma[index])
        place = f"{latitude[index]:.10f} {longitude[index]:.10f} {measured[index, 2]:.4f}"
        yield f"{stamp} RTK_FIXED {place} {deviations}"


def imu_lines(drive: Drive, rng: np.random.Generator) -> Iterable[str]:
    """Time, specific force (m/s2), turn rate (rad/s) and the inclinometer's specific force, at 125 Hz."""
    times = np.arange(0.0, drive.duration_s, _IMU_PERIOD_S)
    force, rate = true_motion(drive, times)
    moving = _moving(drive, times)[:, None]
    count = (len(times), 3)
    shaking = rng.normal(0, 1, count) * (0.02 + 0.15 * moving)
    acceleration = force + rng.normal(0, 0.03, 3) + shaking
    gyro = rate + rng.normal(0, 0.0008, 3) + rng.normal(0, 1, count) * (0.0015 + 0.004 * moving)
    inclinometer = force + rng.normal(0, 0.015, 3) + _low_pass(shaking) + rng.normal(0, 0.012, count)
    return _rows(drive, times, np.concatenate([acceleration, gyro, inclinometer], axis=1), "%.6f")


def true_motion(
    drive: Drive, times_s: Float64[np.ndarray, "N"]
) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
    """Specific force (m/s2, up at rest) and turn rate (rad/s) of the body in its own frame, without noise."""
    from scipy.spatial.transform import Rotation

    step = 0.02
    before, now, after = (drive.T_world_body(times_s + shift) for shift in (-step, 0.0, step))
    acceleration = (before[:, :3, 3] - 2 * now[:, :3, 3] + after[:, :3, 3]) / step**2
    acceleration[:, 2] += GRAVITY_M_S2
    R_body_world = now[:, :3, :3].transpose(0, 2, 1)
    turn = Rotation.from_matrix(before[:, :3, :3].transpose(0, 2, 1) @ after[:, :3, :3]).as_rotvec()
    return np.einsum("nij,nj->ni", R_body_world, acceleration), turn / (2 * step)


def odometry_lines(drive: Drive, rng: np.random.Generator) -> Iterable[str]:
    """Time; angle (rad), rate (rad/s) and motor's analogue of six wheels and four steers; rocker and both bogies."""
    times = np.arange(0.0, drive.duration_s, _ODOMETRY_PERIOD_S)
    curvature = drive.curvature_per_m(times)
    moving = _moving(drive, times)
    drives, steers = [], []
    for ahead, side in _DRIVES:
        left_m = side * WHEEL_TRACK_M / 2
        forward, sideways = 1 - left_m * curvature, ahead * WHEEL_BASE_M / 2 * curvature
        ratio = np.hypot(forward, sideways)
        # Sand gives way: wheels turn a little more than the rover moves.
        slip = 1 + abs(rng.normal(0.01, 0.01))
        driven = np.concatenate([[0], np.cumsum(np.diff(drive.arc_m(times)) * ratio[1:])])
        angle = rng.uniform(-3, 3) + driven * slip / WHEEL_RADIUS_M
        drives += _joint(angle, 0.35, moving, rng)
        if ahead:
            steers += _joint(np.arctan2(sideways, forward), 0.0, moving, rng)
    chassis = rng.normal(0, 0.01, 3) + 0.01 * _low_pass(rng.normal(0, 1, (len(times), 3))) * moving[:, None]
    return _rows(drive, times, np.column_stack([*drives, *steers, chassis]), "%.5f")


def ptu_lines(drive: Drive) -> Iterable[str]:
    """Time, pan and tilt (rad) of the mast, which looks ahead all the time."""
    times = np.arange(0.0, drive.duration_s, 0.1)
    return _rows(drive, times, np.zeros((len(times), 2)), "%.5f")


def _joint(angle: np.ndarray, effort: float, moving: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    rate = np.gradient(angle, _ODOMETRY_PERIOD_S)
    count = len(angle)
    analogue = effort * rate + rng.normal(0, 0.02, count)
    noisy_rate = rate + rng.normal(0, 0.02, count) * moving + rng.normal(0, 0.002, count)
    return [angle + rng.normal(0, 0.0005, count), noisy_rate, analogue]


def _moving(drive: Drive, times_s: np.ndarray) -> Float[np.ndarray, "N"]:
    """Speed in parts of the usual one."""
    step = 0.05
    return np.clip((drive.arc_m(times_s + step) - drive.arc_m(times_s)) / step / drive.recipe.speed_m_s, 0, 1)


def _low_pass(values: np.ndarray) -> np.ndarray:
    kernel = np.hanning(25) / np.hanning(25).sum()
    return np.stack([np.convolve(column, kernel, mode="same") for column in values.T], axis=1)


def _rows(drive: Drive, times_s: np.ndarray, table: np.ndarray, form: str) -> Iterable[str]:
    for when, row in zip(times_s, table, strict=True):
        yield " ".join([time_stamp(drive.recipe.start_time_s + when), *(form % value for value in row)])


def _write(path: Path, lines: Iterable[str]) -> None:
    text = "\n".join(lines) + "\n"
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="ascii")
