"""What a rover's sensors recorded, as checked arrays.

The body frame is x forward, y left, z up, with its origin in the IMU; the world is x east, y north,
z up. Times are seconds on one clock, strictly increasing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

MAX_SENSOR_GAP_S = 0.5
"""Samples of the IMU or the wheels farther apart leave a gap, in which they tell nothing."""


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
    """What gyros and inclinometer felt.

    Attributes:
        timestamps_s: (N,).
        rate_body: (N, 3), angular rate in rad/s.
        force_body: (N, 3), specific force in m/s2: upwards and 9.81 at rest.
    """

    timestamps_s: np.ndarray
    rate_body: np.ndarray
    force_body: np.ndarray


class WheelLog(NamedTuple):
    """How fast the wheels say that the rover goes.

    Attributes:
        timestamps_s: (N,).
        speed_m_s: (N,), forward positive.
        turning: (N,), whether any wheel turns; where none does, the rover stands.
    """

    timestamps_s: np.ndarray
    speed_m_s: np.ndarray
    turning: np.ndarray


@dataclass(frozen=True)
class RoverGeometry:
    """Where things are on the rover, in the body frame.

    Wheels hold on to the ground, so it is the ground under the rover, not the IMU on its swaying
    body, that moves the way the rover looks.

    Attributes:
        antenna_body_m: (3,), the phase centre of the GPS antenna.
        height_m: of the IMU over the ground.
        turning_centre_m: how far ahead of the IMU the axis lies about which the rover turns
            (negative: behind); a first guess, which the estimate betters.
    """

    antenna_body_m: np.ndarray
    height_m: float = 0.0
    turning_centre_m: float = 0.0


def increments(
    timestamps_s: Float64[np.ndarray, "N"], values: Float64[np.ndarray, "N *C"], knots_s: Float64[np.ndarray, "K"]
) -> Float64[np.ndarray, "K-1 *C"]:
    """The integral of a sampled signal from each knot to the next; beyond its ends the signal is zero."""
    samples = values.reshape(len(values), -1)
    # The trapezoidal rule; what scipy.integrate brings along takes a quarter of a second to import.
    whole = np.zeros_like(samples)
    whole[1:] = np.cumsum(np.diff(timestamps_s)[:, None] * (samples[1:] + samples[:-1]) / 2, axis=0)
    columns = whole.T
    at_knots = np.stack([np.interp(knots_s, timestamps_s, column) for column in columns], axis=-1)
    return np.diff(at_knots, axis=0).reshape(len(knots_s) - 1, *values.shape[1:])


def in_gap(timestamps_s: Float64[np.ndarray, "N"], times_s: Float64[np.ndarray, "M"]) -> np.ndarray:
    """Whether times lie outside a recording or in a gap of it, (M,); its samples' own times do not."""
    after = np.searchsorted(timestamps_s, times_s).clip(1, len(timestamps_s) - 1)
    before_s, after_s = timestamps_s[after - 1], timestamps_s[after]
    inside = (times_s >= before_s) & (times_s <= after_s)
    on_sample = (times_s == before_s) | (times_s == after_s)
    return ~inside | ((after_s - before_s > MAX_SENSOR_GAP_S) & ~on_sample)


def time_to_nearest(
    timestamps_s: Float64[np.ndarray, "N"], times_s: Float64[np.ndarray, "M"]
) -> Float64[np.ndarray, "M"]:
    """How far times lie from the nearest of at least one increasing timestamps."""
    after = np.searchsorted(timestamps_s, times_s)
    neighbours = timestamps_s[np.stack([after - 1, after]).clip(0, len(timestamps_s) - 1)]
    return np.abs(neighbours - times_s).min(axis=0)
