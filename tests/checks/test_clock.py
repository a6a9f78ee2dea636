"""A clock offset between poses and images is found by their turns, and none where the drive does not tell."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from jaxmap.checks.clock import clock_offset

STEPS, STEP_S = 40, 0.25


def drive(offset_s: float, seed: int, noise_rad: float = 0.001) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times of frames, orientations by poses that are late by an offset, and turns by images."""
    rng = np.random.default_rng(seed)
    fine_s = np.arange(-15, 30, 0.05)
    heading = gaussian_filter1d(rng.normal(0, 0.02, len(fine_s)).cumsum(), 4)
    times_s = np.arange(STEPS + 1) * STEP_S
    at_images, at_poses = (np.interp(times, fine_s, heading) for times in (times_s, times_s - offset_s))
    turns = np.abs(np.diff(at_images)) + rng.normal(0, noise_rad, STEPS)
    return times_s, Rotation.from_rotvec(np.outer(at_poses, [0, 0, 1])).as_matrix(), turns


@given(steps=st.integers(-6, 6).filter(lambda steps: abs(steps) >= 2), seed=st.integers(0, 50))
def test_an_offset_is_found(steps, seed):
    found = clock_offset(*drive(steps * STEP_S, seed))
    # Where the drive tells little, silence is right; a wrong number never is.
    if found:
        (one,) = found
        assert one.kind == "clock-offset" and one.stops
        told_s = float(one.what.split()[3]) * (1 if "later" in one.what else -1)
        assert abs(told_s - steps * STEP_S) <= STEP_S


def test_most_offsets_are_found():
    assert sum(bool(clock_offset(*drive(1.0, seed))) for seed in range(20)) >= 16


@given(seed=st.integers(0, 200))
def test_one_clock_is_not_doubted(seed):
    assert clock_offset(*drive(0.0, seed)) == []


@pytest.mark.parametrize("kept", [5, 12])
def test_few_frames_tell_nothing(kept):
    times_s, R, turns = drive(1.0, 0)
    assert clock_offset(times_s[: kept + 1], R[: kept + 1], turns[:kept]) == []


def test_a_straight_drive_tells_nothing():
    times_s, R, turns = drive(1.0, 0)
    assert clock_offset(times_s, np.broadcast_to(np.eye(3), R.shape), turns) == []
    assert clock_offset(times_s, R, np.full(STEPS, 0.001)) == []
