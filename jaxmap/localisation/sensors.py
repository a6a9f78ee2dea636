"""Recordings of a rover's sensors as arrays.

The body frame is x forward, y left, z up, with its origin in the IMU; the world is x east, y north,
z up. Times are seconds on one clock, strictly increasing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

MAX_SENSOR_GAP_S = 0.5
"""Samples of the IMU or the wheels farther apart leave a gap without measurement."""


class GpsFixes(NamedTuple):
    """Positions of the antenna in the world.

    Attributes:
        timestamps_s: (N,).
        antenna_world_m: (N, 3).
        sigma_m: (N, 3), standard deviation east, north and up.
    """

    timestamps_s: np.ndarray
    antenna_world_m: np.ndarray
    sigma_m: np.ndarray


class ImuLog(NamedTuple):
    """Gyros and inclinometer.

    Attributes:
        timestamps_s: (N,).
        angular_rate_body_rad_s: (N, 3).
        specific_force_body_m_s2: (N, 3), upwards and 9.81 at rest.
    """

    timestamps_s: np.ndarray
    angular_rate_body_rad_s: np.ndarray
    specific_force_body_m_s2: np.ndarray


class WheelLog(NamedTuple):
    """Wheel odometry.

    Attributes:
        timestamps_s: (N,).
        speed_m_s: (N,), of the rover, forward positive.
        rolling: (N,), whether any wheel turns; where none does, the rover stands.
    """

    timestamps_s: np.ndarray
    speed_m_s: np.ndarray
    rolling: np.ndarray


@dataclass(frozen=True)
class RoverGeometry:
    """Lever arms of the rover in the body frame.

    The wheels do not slide sideways, so the ground point under the rover, not the IMU on its swaying body, moves
    along the heading.

    Attributes:
        antenna_body_m: (3,), the phase centre of the GPS antenna.
        height_m: of the IMU above the ground.
        turning_centre_m: distance from the IMU forward to the axis about which the rover turns (negative: behind);
            a first guess, refined by the estimate.
    """

    antenna_body_m: np.ndarray
    height_m: float = 0.0
    turning_centre_m: float = 0.0


def increments(
    timestamps_s: Float64[np.ndarray, "N"], values: Float64[np.ndarray, "N *C"], knots_s: Float64[np.ndarray, "K"]
) -> Float64[np.ndarray, "K-1 *C"]:
    """The integral of a sampled signal from each knot to the next; beyond its ends the signal is zero."""
    samples = values.reshape(len(values), -1)
    # The trapezoidal rule; scipy.integrate takes a quarter of a second to import.
    whole = np.zeros_like(samples)
    whole[1:] = np.cumsum(np.diff(timestamps_s)[:, None] * (samples[1:] + samples[:-1]) / 2, axis=0)
    columns = whole.T
    at_knots = np.stack([np.interp(knots_s, timestamps_s, column) for column in columns], axis=-1)
    return np.diff(at_knots, axis=0).reshape(len(knots_s) - 1, *values.shape[1:])


def in_gap(timestamps_s: Float64[np.ndarray, "N"], times_s: Float64[np.ndarray, "M"]) -> np.ndarray:
    """Whether times lie outside a recording or in one of its gaps, (M,); times of samples do not."""
    after = np.searchsorted(timestamps_s, times_s).clip(1, len(timestamps_s) - 1)
    before_s, after_s = timestamps_s[after - 1], timestamps_s[after]
    inside = (times_s >= before_s) & (times_s <= after_s)
    on_sample = (times_s == before_s) | (times_s == after_s)
    return ~inside | ((after_s - before_s > MAX_SENSOR_GAP_S) & ~on_sample)


def time_to_nearest(
    timestamps_s: Float64[np.ndarray, "N"], times_s: Float64[np.ndarray, "M"]
) -> Float64[np.ndarray, "M"]:
    """Distance in s from each time to the nearest timestamp; there must be one at least, and they must increase."""
    after = np.searchsorted(timestamps_s, times_s)
    neighbours = timestamps_s[np.stack([after - 1, after]).clip(0, len(timestamps_s) - 1)]
    return np.abs(neighbours - times_s).min(axis=0)
