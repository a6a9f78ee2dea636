"""The rover's poses from the recordings of its sensors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from jaxmap.errors import JaxmapError
from jaxmap.localisation.attitude import RollPitch, estimate_roll_pitch
from jaxmap.localisation.sensors import GpsFixes, ImuLog, RoverGeometry, WheelLog, in_gap, increments, time_to_nearest
from jaxmap.localisation.track import OdometryIncrements, estimate_track

KNOT_SPACING_S = 0.1
"""Spacing of the estimated poses; at a rover's speed the path between them is nearly straight."""

MAX_HEADING_SIGMA_RAD = np.radians(10.0)
"""With a greater uncertainty the heading counts as unobservable: the rover has hardly moved."""

MAX_STANDING_RATE_RAD_S = 0.03
"""At a greater yaw rate the rover does not stand, even if its wheels do: someone turns it by hand."""


class RoverPoses(NamedTuple):
    """Estimated poses.

    Attributes:
        timestamps_s: (K,), about 10 Hz, strictly increasing.
        T_world_body: (K, 4, 4); the body is x forward, y left, z up, its origin the IMU.
        heading_sigma_rad: standard deviation of the heading.
        wheel_scale: distance travelled per distance of the wheels; NaN without wheels.
        fixes: number of GPS fixes; outliers: number of those with a reduced weight.
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
    """Poses of a rover, smoothed over a whole recording.

    The estimate bridges gaps of the IMU, but gives no poses inside them.

    Raises:
        JaxmapError: the recordings do not overlap, or the heading is unobservable as the rover does not move.
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
        roll_pitch = estimate_roll_pitch(imu, knots_s, _acceleration(imu, wheels, knots_s))
        odometry = _odometry_increments(imu, wheels, roll_pitch, knots_s)
        track = estimate_track(fixes, knot_of_fix, odometry, roll_pitch, geometry)
    except (np.linalg.LinAlgError, ValueError, FloatingPointError) as fault:
        raise JaxmapError(
            f"no track fits GPS, IMU and odometry ({fault})", where=where, fix="give --poses FILE"
        ) from fault
    if not track.heading_sigma_rad < MAX_HEADING_SIGMA_RAD:
        raise JaxmapError(
            f"heading unobservable, the rover hardly moves (sigma {np.degrees(track.heading_sigma_rad):.0f} deg)",
            where=where,
            fix="give a recording with more of the drive, or --poses FILE",
        )
    T = np.tile(np.eye(4), (len(knots_s), 1, 1))
    angles = np.stack([track.heading_rad, roll_pitch.pitch_rad, roll_pitch.roll_rad], axis=-1)
    T[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    T[:, :3, 3] = track.imu_world_m
    known = ~in_gap(imu.timestamps_s, knots_s)
    return RoverPoses(
        timestamps_s=knots_s[known],
        T_world_body=T[known],
        heading_sigma_rad=track.heading_sigma_rad,
        wheel_scale=track.wheel_scale if wheels is not None else np.nan,
        fixes=len(fixes.timestamps_s),
        outliers=track.outliers,
    )


def estimate_up(
    imu: ImuLog, wheels: WheelLog | None, timestamps_s: Float64[np.ndarray, "N"]
) -> Float64[np.ndarray, "N 3"]:
    """The direction up in the body frame (x forward, y left, z up) at given times, NaN outside those of the IMU.

    Raises:
        JaxmapError: the IMU says too little.
    """
    up = np.full((len(timestamps_s), 3), np.nan)
    within = (timestamps_s >= imu.timestamps_s[0]) & (timestamps_s <= imu.timestamps_s[-1])
    if not within.any():
        return up
    knots_s = knot_times(imu.timestamps_s, timestamps_s[within])
    try:
        roll, pitch = estimate_roll_pitch(imu, knots_s, _acceleration(imu, wheels, knots_s))
    except (np.linalg.LinAlgError, ValueError, FloatingPointError) as fault:
        raise JaxmapError(f"no attitude fits the IMU ({fault})") from fault
    at = np.searchsorted(knots_s, timestamps_s[within])
    roll, pitch = roll[at], pitch[at]
    up[within] = np.stack([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)], axis=-1)
    return up


def knot_times(imu_s: Float64[np.ndarray, "N"], fixes_s: Float64[np.ndarray, "F"]) -> Float64[np.ndarray, "K"]:
    """The times of all fixes and of IMU samples about `KNOT_SPACING_S` apart."""
    cells = np.floor((imu_s - imu_s[0]) / KNOT_SPACING_S)
    chosen = imu_s[np.unique(cells, return_index=True)[1]]
    chosen = np.union1d(chosen, imu_s[-1:])
    # A sample close to a fix would make an interval of nearly no length.
    return np.union1d(chosen[time_to_nearest(fixes_s, chosen) > KNOT_SPACING_S / 10], fixes_s)


def _odometry_increments(
    imu: ImuLog, wheels: WheelLog | None, roll_pitch: RollPitch, knots_s: np.ndarray
) -> OdometryIncrements:
    dt = np.diff(knots_s)
    middle_s = (knots_s[:-1] + knots_s[1:]) / 2
    _, about_left, about_up = increments(imu.timestamps_s, imu.angular_rate_body_rad_s, knots_s).T
    roll, pitch = ((angle[:-1] + angle[1:]) / 2 for angle in roll_pitch)
    turn = (about_left * np.sin(roll) + about_up * np.cos(roll)) / np.cos(pitch)
    turn = np.where(in_gap(imu.timestamps_s, middle_s), np.nan, turn)
    speed, standing = np.full(len(dt), np.nan), np.zeros(len(dt), bool)
    if wheels is not None:
        speed = increments(wheels.timestamps_s, wheels.speed_m_s, knots_s) / dt
        gaps = in_gap(wheels.timestamps_s, knots_s)
        speed[gaps[:-1] | gaps[1:] | in_gap(wheels.timestamps_s, middle_s)] = np.nan
        still = increments(wheels.timestamps_s, wheels.rolling.astype(float), knots_s) == 0
        standing = still & np.isfinite(speed) & (np.abs(turn) < MAX_STANDING_RATE_RAD_S * dt)
    return OdometryIncrements(dt, turn, speed, standing)


def _acceleration(imu: ImuLog, wheels: WheelLog | None, knots_s: np.ndarray) -> Float64[np.ndarray, "K 3"]:
    """Acceleration of the rover in the body frame: forward from the wheels, lateral from turning."""
    acceleration = np.zeros((len(knots_s), 3))
    if wheels is None:
        return acceleration
    # Wheel rates are coarse; smoothing over some 0.3 s still resolves starts and stops.
    speed = gaussian_filter1d(np.interp(knots_s, wheels.timestamps_s, wheels.speed_m_s), 1.5)
    yaw_rate = np.interp(knots_s, imu.timestamps_s, gaussian_filter1d(imu.angular_rate_body_rad_s[:, 2], 6.0))
    acceleration[:, 0] = np.gradient(speed, knots_s)
    acceleration[:, 1] = speed * yaw_rate
    return acceleration
