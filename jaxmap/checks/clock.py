"""Whether poses and images keep one clock: the camera turns when its poses do, or earlier, or later."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation, Slerp

from jaxmap.checks.finding import Finding
from jaxmap.datasets.base import StereoSequence
from jaxmap.errors import FrameError
from jaxmap.stereo.align import match_features
from jaxmap.stereo.front_end import StereoFrontEnd

MIN_STEPS, MOST_STEPS = 13, 30
"""Steps between consecutive frames that are needed, and those that are looked at."""

WORKING_WIDTH_PX = 512
MIN_FEATURES = 30

LEAST_SPREAD_RAD = np.deg2rad(0.3)
"""Where the turns of the steps differ by less, noise decides."""

LONGEST_OFFSET = 0.25
"""Offsets up to this share of the time that is looked at are tried."""

CORRELATED, BETTER = 0.85, 0.15
"""Turns by poses and by images agree above the first; an offset is told that adds more than the second."""


def clock_findings(sequence: StereoSequence, front_end: StereoFrontEnd) -> list[Finding]:
    """The clock offset between images and poses; nothing where the drive does not tell.

    Args:
        sequence: looked at where its poses turn most.
        front_end: its rectification.
    """
    times_s = np.array([frame.timestamp_s for frame in sequence.frames])
    first = _liveliest(sequence.T_world_camera, times_s)
    if first is None:
        return []
    part = slice(first, first + MOST_STEPS + 1)
    turns_rad = _turns_by_images(sequence, front_end, range(*part.indices(len(times_s))))
    return clock_offset(times_s[part], sequence.T_world_camera[part, :3, :3], turns_rad)


def clock_offset(
    times_s: Float64[np.ndarray, "N"],
    R_world_camera: Float64[np.ndarray, "N 3 3"],
    turns_rad: Float64[np.ndarray, "N-1"],
) -> list[Finding]:
    """The offset under which angles turned by poses and by images correlate best.

    Only angles are compared, so that wrong axes or a wrong direction of the poses change nothing.

    Args:
        times_s: of the frames.
        R_world_camera: their orientations by the poses.
        turns_rad: angle between each frame and the next by the images, NaN where unknown.
    """
    known = np.isfinite(turns_rad)
    if known.sum() < MIN_STEPS or np.std(turns_rad[known]) < LEAST_SPREAD_RAD:
        return []
    path = Slerp(times_s, Rotation.from_matrix(R_world_camera))
    longest_s = LONGEST_OFFSET * (times_s[-1] - times_s[0])
    step_s = float(np.median(np.diff(times_s)))
    offsets_s = np.arange(-round(longest_s / step_s * 4), round(longest_s / step_s * 4) + 1) * step_s / 4
    agreement = np.array([_correlation(path, times_s, turns_rad, offset_s) for offset_s in offsets_s])
    unmoved = agreement[len(offsets_s) // 2]
    # Poses that do not turn correlate with nothing.
    if not np.isfinite(unmoved):
        return []
    best = int(np.nanargmax(agreement))
    offset_s = float(offsets_s[best])
    at_edge = best in (0, len(offsets_s) - 1)
    if agreement[best] < CORRELATED or agreement[best] - unmoved < BETTER or abs(offset_s) < step_s / 2 or at_edge:
        return []
    later = "later" if offset_s > 0 else "earlier"
    what = (
        f"the poses turn {abs(offset_s):.2f} s {later} than the images do: turns correlate by {agreement[best]:.2f} "
        f"with that offset, by {unmoved:.2f} without"
    )
    fix = f"add {-offset_s:+.2f} s to the times of the poses, or take both from one clock"
    return [Finding("clock-offset", True, round(float(agreement[best] - max(unmoved, 0.0) / 2), 2), what, fix)]


def _correlation(path: Slerp, times_s: np.ndarray, turns_rad: np.ndarray, offset_s: float) -> float:
    """Of the turns by images with those of the poses so much later; NaN where too few steps are left."""
    moved_s = times_s + offset_s
    inside = (moved_s >= times_s[0]) & (moved_s <= times_s[-1])
    R = path(np.clip(moved_s, times_s[0], times_s[-1]))
    by_poses_rad = (R[:-1].inv() * R[1:]).magnitude()
    used = inside[:-1] & inside[1:] & np.isfinite(turns_rad)
    if used.sum() < MIN_STEPS * (1 - LONGEST_OFFSET) or np.std(by_poses_rad[used]) == 0:
        return float("nan")
    return float(np.corrcoef(by_poses_rad[used], turns_rad[used])[0, 1])


def _liveliest(T_world_camera: np.ndarray, times_s: np.ndarray) -> int | None:
    """Where the stretch of frames begins whose poses turn most unevenly; None where these are too few or too even."""
    if len(times_s) <= MIN_STEPS:
        return None
    R = Rotation.from_matrix(T_world_camera[:, :3, :3])
    turned = (R[:-1].inv() * R[1:]).magnitude()
    starts = range(0, max(1, len(turned) - MOST_STEPS + 1), MOST_STEPS // 4)
    spreads_rad = {start: float(np.std(turned[start : start + MOST_STEPS])) for start in starts}
    liveliest = max(starts, key=spreads_rad.__getitem__)
    return liveliest if spreads_rad[liveliest] >= LEAST_SPREAD_RAD else None


def _turns_by_images(sequence: StereoSequence, front_end: StereoFrontEnd, indices: Sequence[int]) -> np.ndarray:
    """Angle between each of the left images and the next, NaN where they share too little."""
    camera = front_end.camera
    shrink = max(1, round(camera.width_px / WORKING_WIDTH_PX))
    K = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]], np.float64)
    turns_rad, before = np.full(len(indices) - 1, np.nan), None
    for place, index in enumerate(indices):
        try:
            left = front_end.rectify(*sequence.read_pair(sequence.frames[index]))[0]
        except FrameError:
            before = None
            continue
        if before is not None:
            turns_rad[place - 1] = _turn(match_features(before, left, shrink), K, shrink)
        before = left
    return turns_rad


def _turn(matches: np.ndarray, K: np.ndarray, shrink: int) -> float:
    """The angle of the rotation that matches of two images show, by their essential matrix."""
    if len(matches) < MIN_FEATURES:
        return float("nan")
    cv2.setRNGSeed(0)
    first, second = np.ascontiguousarray(matches[:, :2]), np.ascontiguousarray(matches[:, 2:])
    E, agree = cv2.findEssentialMat(first, second, K, cv2.RANSAC, 0.999, 0.5 * shrink)
    if E is None or E.shape != (3, 3) or agree.sum() < MIN_FEATURES:
        return float("nan")
    _, R, _, _ = cv2.recoverPose(E, first, second, K, mask=agree)
    return float(Rotation.from_matrix(R).magnitude())
