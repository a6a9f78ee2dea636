"""Whether steps of the poses are as long as those that images show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from jaxmap.checks.finding import Finding
from jaxmap.checks.motions import Motion

SCALE_FITS, SCALE_STOPS = 1.1, 1.5
"""Steps whose lengths differ by less fit: with right calibrations and poses they differed by 1.03 at most. By more than
the second, the map would be wrong."""

ENOUGH_STEPS, FEW_FIT = 3, 2.0
"""Fewer steps than the first tell a difference above the second alone: a smaller one may be noise."""

SCATTER = 1.35
"""Quartiles that lie farther apart, or farther than the difference itself, tell of the clock or of tracking."""

STILL = 0.05
"""Poses whose steps are shorter than this share of those that images show stand still."""

UNITS = {1000.0: "mm", 100.0: "cm"}
LONGEST_BASELINE_M = 3.0
"""No stereo rig of a rover or a car is longer."""


def scale_findings(
    T_world_camera: Float64[np.ndarray, "N 4 4"], motions: Sequence[Motion], baseline_m: float | None
) -> list[Finding]:
    """Tells a constant factor between the lengths of steps by the images and by the poses.

    A wrong baseline, a wrong focal length and a wrong unit all scale what images show, or what the poses say.

    Args:
        T_world_camera: the poses as read; any world.
        motions: measured between frames.
        baseline_m: of the camera, to tell a wrong unit of the baseline from one of the poses.
    """
    by_poses_m, by_images_m = _lengths(T_world_camera, motions)
    moved = by_poses_m > 0
    if not moved.any():
        return []
    low, factor, high = np.quantile(by_images_m[moved] / by_poses_m[moved], (0.25, 0.5, 0.75))
    count, size = int(moved.sum()), max(factor, 1 / factor)
    if max(low, 1 / high) < SCALE_FITS or high > min(size, SCATTER) * low:
        return []
    if count < ENOUGH_STEPS and size < FEW_FIT:
        return []
    unit = next((name for unit_size, name in UNITS.items() if 1 / SCATTER < size / unit_size < SCATTER), None)
    by_images = "by the images" if baseline_m is None else f"by the images, with a baseline of {baseline_m:.3g} m,"
    what = f"steps are {factor:,.4g} times as long {by_images} as by the poses"
    if unit is None:
        fix = (
            "check the focal length and the baseline of the calibration, and the unit of the poses; poses of a single "
            "camera have no scale of their own, those of wheels slip"
        )
    elif factor > 1:
        long_baseline = baseline_m is not None and baseline_m > LONGEST_BASELINE_M
        fix = f"--baseline-unit {unit}" if long_baseline else "check --poses-unit: the positions are too small"
    else:
        fix = f"--poses-unit {unit}"
    # One step tells a unit; a scale that is off by less needs several.
    certain = (count + 1) / (count + 1.5) if size > 10 else count / (count + 1)
    return [Finding("scale", bool(size > SCALE_STOPS), round(certain, 2), what, fix)]


def still_findings(T_world_camera: Float64[np.ndarray, "N 4 4"], motions: Sequence[Motion]) -> list[Finding]:
    """Tells poses that stand still while the images move: all the same, or degrees in place of metres.

    Args:
        T_world_camera: the poses as read; any world.
        motions: measured between frames.
    """
    by_poses_m, by_images_m = map(np.median, _lengths(T_world_camera, motions))
    if not by_poses_m < STILL * by_images_m:
        return []
    what = f"the poses stand still: their steps are {by_poses_m:.2g} m long where images show {by_images_m:.2g} m"
    fix = "give the poses of this drive, positions in metres (UTM in place of degrees), or --poses odometry"
    return [Finding("poses-still", True, round(len(motions) / (len(motions) + 1), 2), what, fix)]


def _lengths(T: np.ndarray, motions: Sequence[Motion]) -> tuple[np.ndarray, np.ndarray]:
    """Lengths (M,) of the steps by the poses and by the images, in metres; NaN (1,) where no images show one."""
    steps = [motion for motion in motions if motion.steps]
    if not steps:
        return np.full(1, np.nan), np.full(1, np.nan)
    by_poses = np.stack([T[motion.j, :3, 3] - T[motion.i, :3, 3] for motion in steps])
    by_images = np.stack([motion.T_i_j[:3, 3] for motion in steps])
    return np.linalg.norm(by_poses, axis=1), np.linalg.norm(by_images, axis=1)
