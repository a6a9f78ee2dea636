"""Units of length and time in files of others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxmap.datasets.options import LengthUnit, TimeUnit
from jaxmap.stereo.rectify import StereoRig
from jaxmap.types import StereoCamera

METRES: dict[LengthUnit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}

PER_SECOND: dict[TimeUnit, float] = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}

UNIT_NAMES: dict[TimeUnit, str] = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}

_LEAST_OF_UNIT: tuple[tuple[TimeUnit, float], ...] = (("ns", 1e17), ("us", 1e14), ("ms", 1e11))
"""Unix times of now are 1.7e18 ns, 1.7e15 us, 1.7e12 ms and 1.7e9 s; 1e11 s would be the year 5138."""


def unit_by_size(largest: float) -> TimeUnit | None:
    """The unit of Unix times of which the largest is given; None where they may be seconds."""
    return next((unit for unit, least in _LEAST_OF_UNIT if abs(largest) >= least), None)


def with_baseline_unit(camera: StereoCamera | StereoRig, unit: LengthUnit) -> StereoCamera | StereoRig:
    """A calibration whose baseline was given in another unit than metres, in metres."""
    if unit == "m":
        return camera
    if isinstance(camera, StereoRig):
        return replace(camera, t_right_left_m=camera.t_right_left_m * METRES[unit])
    return replace(camera, baseline_m=camera.baseline_m * np.float32(METRES[unit]))


def unit_that_overlaps(times_s: np.ndarray, others_s: np.ndarray, unit: TimeUnit) -> TimeUnit | None:
    """The unit of some times under which their span meets that of others; None where no other unit does.

    Args:
        times_s: (N,), the times as read in `unit`.
        others_s: (M,), times of the same clock that are right.
        unit: the unit that `times_s` were taken for.
    """
    for other, per_second in PER_SECOND.items():
        scaled_s = times_s * (PER_SECOND[unit] / per_second)
        if other != unit and scaled_s.min() <= others_s.max() and scaled_s.max() >= others_s.min():
            return other
    return None
