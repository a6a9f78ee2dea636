"""From what the sensors recorded to the rover's poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from jaxmap.errors import JaxmapError
from jaxmap.localisation.attitude import Tilt, estimate_tilt
from jaxmap.localisation.sensors import GpsFixes, ImuLog, RoverGeometry, WheelLog, in_gap, increments, time_to_nearest
from jaxmap.localisation.track import estimate_track
from jaxmap.localisation.track_terms import Motion

KNOT_SPACING_S = 0.1
"""Poses are estimated this densely; at a rover's pace they are as good as straight between."""

MAX_HEADING_SIGMA_RAD = np.radians(10.0)
"""Where the heading is known no better than this, the rover has hardly moved."""


MAX_STANDING_RATE = 0.03
"""Gyros that say more (rad/s) are believed, though the wheels stand: someone turns the rover."""


class RoverPoses(NamedTuple):
    """Estimated poses.

    Attributes:
        timestamps_s: (K,), about 10 Hz, strictly increasing.
        T_world_body: (K, 4, 4); the body is x forward, y left, z up, its origin the IMU.
        heading_sigma_rad: how well the heading is known.
        wheel_scale: way travelled by way of the wheels; NaN without wheels.
        fixes: how many were used; outliers: how many of them count less, as they do not fit.
    """

    timestamps_s: np.ndarray
    T_world_body: np.ndarray
    heading_sigma_rad: float
    wheel_scale: float
    fixes: int
    outliers: int


def estimate_poses(
    fixes: GpsFixes, imu: ImuLog, wheels: WheelLog | None, geometry: RoverGeometry, where: object = "sensors"
) -> RoverPoses:
    """Poses of a rover over one recording, from all of it (smoothed, not filtered).

    Poses are given where the IMU recorded; its gaps are bridged by the estimate, but hold no pose.

    Raises:
        JaxmapError: the recordings do not overlap, or tell no heading as the rover does not move.
    """
    if len(imu.timestamps_s) < 3:
        raise JaxmapError(
            f"{len(imu.timestamps_s)} samples of the IMU lie near the times of the images",
            where=where,
            fix="check that both use one clock, or give --poses FILE",
        )
    if wheels is not None and len(wheels.timestamps_s) < 2:
        wheels = None
    within = (fixes.timestamps_s >= imu.timestamps_s[0]) & (fixes.timestamps_s <= imu.timestamps_s[-1])
    fixes = GpsFixes(*(values[within] for values in fixes))
    if len(fixes.timestamps_s) < 2:
        raise JaxmapError(
            f"{len(fixes.timestamps_s)} GPS fixes lie within the times of the IMU, 2 are needed",
            where=where,
            fix="check that both recordings are of one drive, or give --poses FILE",
        )
    knots_s = knot_times(imu.timestamps_s, fixes.timestamps_s)
    knot_of_fix = np.searchsorted(knots_s, fixes.timestamps_s)
    try:
        tilt = estimate_tilt(imu, knots_s, _acceleration(imu, wheels, knots_s))
        track = estimate_track(fixes, knot_of_fix, _motion(imu, wheels, tilt, knots_s), tilt, geometry)
    except (np.linalg.LinAlgError, ValueError, FloatingPointError) as fault:
        raise JaxmapError(
            f"GPS, IMU and odometry do not make a track ({fault})", where=where, fix="give --poses FILE"
        ) from fault
    if not track.heading_sigma_rad < MAX_HEADING_SIGMA_RAD:
        raise JaxmapError(
            f"the rover moves too little to tell its heading ({np.degrees(track.heading_sigma_rad):.0f} deg uncertain)",
            where=where,
            fix="give a recording with more of the drive, or --poses FILE",
        )
    T = np.tile(np.eye(4), (len(knots_s), 1, 1))
    angles = np.stack([track.heading_rad, tilt.pitch_rad, tilt.roll_rad], axis=-1)
    T[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    T[:, :3, 3] = track.position_m
    known = ~in_gap(imu.timestamps_s, knots_s)
    return RoverPoses(
        timestamps_s=knots_s[known],
        T_world_body=T[known],
        heading_sigma_rad=track.heading_sigma_rad,
        wheel_scale=track.wheel_scale if wheels is not None else np.nan,
        fixes=len(fixes.timestamps_s),
        outliers=track.outliers,
    )


def knot_times(imu_s: Float64[np.ndarray, "N"], fixes_s: Float64[np.ndarray, "F"]) -> Float64[np.ndarray, "K"]:
    """The times of all fixes, and those of some of the IMU's samples, about `KNOT_SPACING_S` apart."""
    cells = np.floor((imu_s - imu_s[0]) / KNOT_SPACING_S)
    chosen = imu_s[np.unique(cells, return_index=True)[1]]
    chosen = np.union1d(chosen, imu_s[-1:])
    # A sample right beside a fix would make an interval of no length.
    return np.union1d(chosen[time_to_nearest(fixes_s, chosen) > KNOT_SPACING_S / 10], fixes_s)


def _motion(imu: ImuLog, wheels: WheelLog | None, tilt: Tilt, knots_s: np.ndarray) -> Motion:
    dt = np.diff(knots_s)
    middle_s = (knots_s[:-1] + knots_s[1:]) / 2
    _, about_left, about_up = increments(imu.timestamps_s, imu.rate_body, knots_s).T
    roll, pitch = ((angle[:-1] + angle[1:]) / 2 for angle in tilt)
    turn = (about_left * np.sin(roll) + about_up * np.cos(roll)) / np.cos(pitch)
    turn = np.where(in_gap(imu.timestamps_s, middle_s), np.nan, turn)
    speed, standing = np.full(len(dt), np.nan), np.zeros(len(dt), bool)
    if wheels is not None:
        speed = increments(wheels.timestamps_s, wheels.speed_m_s, knots_s) / dt
        silent = in_gap(wheels.timestamps_s, knots_s)
        speed[silent[:-1] | silent[1:] | in_gap(wheels.timestamps_s, middle_s)] = np.nan
        still = increments(wheels.timestamps_s, wheels.turning.astype(float), knots_s) == 0
        standing = still & np.isfinite(speed) & (np.abs(turn) < MAX_STANDING_RATE * dt)
    return Motion(dt, turn, speed, standing)


def _acceleration(imu: ImuLog, wheels: WheelLog | None, knots_s: np.ndarray) -> Float64[np.ndarray, "K 3"]:
    """How the rover's velocity changes, in the body frame: along by the wheels, across by turning."""
    acceleration = np.zeros((len(knots_s), 3))
    if wheels is None:
        return acceleration
    # The wheels' rate is coarse; what is slower than a third of a second is enough to tell starts and stops.
    speed = gaussian_filter1d(np.interp(knots_s, wheels.timestamps_s, wheels.speed_m_s), 1.5)
    yaw_rate = np.interp(knots_s, imu.timestamps_s, gaussian_filter1d(imu.rate_body[:, 2], 6.0))
    acceleration[:, 0] = np.gradient(speed, knots_s)
    acceleration[:, 1] = speed * yaw_rate
    return acceleration
