"""Wild poses are found, and nothing else is."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxmap.datasets.pose_faults import find_wild_poses
from jaxmap.datasets.poses import make_pose_track, without_wild_poses


def path_of(seed: int, count: int, step_s: float, speed_m_s: float) -> tuple[np.ndarray, np.ndarray]:
    """A winding drive with noise of centimetres, standing still for a random while at first."""
    rng = np.random.default_rng(seed)
    times_s = 1.7e9 + step_s * np.arange(count) + rng.uniform(0, step_s / 4, count)
    yaw = np.cumsum(rng.normal(0, 0.1, count))
    moving = np.arange(count) >= rng.integers(0, count)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    T[:, 0, 3] = 4e5 + np.cumsum(moving * speed_m_s * step_s * np.cos(yaw))
    T[:, 1, 3] = 5e6 + np.cumsum(moving * speed_m_s * step_s * np.sin(yaw))
    T[:, :3, 3] += rng.normal(0, 0.02, (count, 3))
    return times_s, T


paths = st.builds(
    path_of,
    st.integers(0, 2**32 - 1),
    st.integers(2, 40),
    st.sampled_from([0.005, 0.1, 0.27, 1.0, 5.0]),
    st.sampled_from([0.0, 0.05, 1.0, 10.0, 30.0]),
)


@given(path=paths)
def test_a_drive_has_no_wild_pose(path):
    assert not find_wild_poses(*path).wild.any()


@given(path=paths, place=st.integers(0, 39), away_m=st.sampled_from([600.0, 12e3, 5e6]))
def test_one_pose_far_away_is_found_and_no_other(path, place, away_m):
    times_s, T = path
    place %= len(T)
    if len(T) == 2:
        place = 1
    T[place, :3, 3] += [away_m, -away_m, 0]
    found = find_wild_poses(times_s, T)
    assert np.flatnonzero(found.wild).tolist() == [place]
    assert found.away_m > away_m


@given(seed=st.integers(0, 2**32 - 1), place=st.integers(1, 18))
def test_a_small_glitch_that_returns_at_once_is_found(seed, place):
    times_s, T = path_of(seed, 20, 0.1, 1.0)
    T[place, :3, 3] += [4.0, 0, 0]
    assert np.flatnonzero(find_wild_poses(times_s, T).wild).tolist() == [place]


@given(seed=st.integers(0, 2**32 - 1), place=st.integers(1, 18))
def test_a_pose_turned_to_identity_is_found(seed, place):
    times_s, T = path_of(seed, 20, 0.1, 1.0)
    upright = Rotation.from_euler("x", -100, degrees=True).as_matrix()
    T[:, :3, :3] = T[:, :3, :3] @ upright
    T[place, :3, :3] = np.eye(3)
    assert find_wild_poses(times_s, T).wild[place]


def test_zeros_before_the_first_fix_are_left_out():
    times_s, T = path_of(1, 40, 0.1, 1.0)
    T[:12, :3, 3] = 0
    assert np.flatnonzero(find_wild_poses(times_s, T).wild).tolist() == list(range(12))


def test_a_localisation_that_corrects_itself_keeps_both_parts_and_is_told():
    times_s, T = path_of(1, 40, 0.1, 1.0)
    T[20:, 0, 3] += 20.0
    found = find_wild_poses(times_s, T)
    assert not found.wild.any()
    assert found.kept_jump_m == pytest.approx(20, abs=1)


def test_a_pan_tilt_head_that_looks_left_and_right_is_not_wild():
    T = np.tile(np.eye(4), (6, 1, 1))
    T[:, :3, :3] = Rotation.from_euler("z", [[0], [60], [0], [-60], [0], [60]], degrees=True).as_matrix()
    assert not find_wild_poses(np.arange(6.0) * 2, T).wild.any()


def test_a_wild_pose_is_taken_out_of_a_track_with_a_fault_that_names_its_line():
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 12034.5
    track = without_wild_poses(make_pose_track(np.array([0.0, 0.1]), T, where="a/poses.tum", lines=[3, 4]))
    assert track.usable.tolist() == [True, False]
    assert track.faults == ("poses.tum: 1 of 2 poses off the path by up to 12034 m and 0 deg (line 4) is left out",)
