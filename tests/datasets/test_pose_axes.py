"""Conventions of poses: known matrices, round trips, and a scene that comes out the same from all of them."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxmap.datasets.base import read_pose_track
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.pose_axes import (
    T_CHILD_CAMERA,
    T_Z_UP_SOURCE,
    PoseReading,
    rigid_inverse,
    to_z_up,
    with_other_quaternions,
)
from jaxmap.datasets.poses import write_tum
from jaxmap.errors import UsageError

READINGS = [
    PoseReading(convention, world, are)
    for convention, world, are in product(T_CHILD_CAMERA, T_Z_UP_SOURCE, ("T_world_camera", "T_camera_world"))
]


def random_poses(seed: int, count: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    T[:, :3, 3] = rng.normal(0, 50, (count, 3))
    return T


@pytest.mark.parametrize("T", [*T_CHILD_CAMERA.values(), *T_Z_UP_SOURCE.values()])
def test_every_turn_is_a_rotation_by_whole_axes(T):
    np.testing.assert_array_equal(T @ T.T, np.eye(4))
    assert np.linalg.det(T) == pytest.approx(1)
    assert set(np.unique(T)) <= {-1.0, 0.0, 1.0}


@pytest.mark.parametrize(
    ("convention", "right", "down", "forward"),
    [
        ("optical", (1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ("body", (0, -1, 0), (0, 0, -1), (1, 0, 0)),
        ("frd", (0, 1, 0), (0, 0, 1), (1, 0, 0)),
        ("opengl", (1, 0, 0), (0, -1, 0), (0, 0, -1)),
    ],
)
def test_right_down_and_forward_of_each_convention(convention, right, down, forward):
    T = PoseReading(convention).camera_poses(np.eye(4)[None])[0]
    np.testing.assert_array_equal(T[:3, :3].T, [right, down, forward])


@pytest.mark.parametrize(
    ("world", "up", "ahead"),
    [
        ("z_up", (0, 0, 1), (0, 1, 0)),
        ("z_down", (0, 0, -1), (1, 0, 0)),
        ("y_up", (0, 1, 0), (0, 0, -1)),
        ("camera", (0, -1, 0), (0, 0, 1)),
    ],
)
def test_up_and_ahead_of_each_world_become_z_and_y(world, up, ahead):
    _, T_world_source = to_z_up(np.eye(4)[None], world)
    np.testing.assert_array_equal(T_world_source[:3, :3] @ up, [0, 0, 1])
    np.testing.assert_array_equal(T_world_source[:3, :3] @ ahead, [0, 1, 0])


@given(seed=st.integers(0, 2**32 - 1), world=st.sampled_from(sorted(T_Z_UP_SOURCE)))
def test_a_world_that_is_not_level_is_turned_by_the_least_that_makes_it_so(seed, world):
    tilt = Rotation.from_rotvec([*np.random.default_rng(seed).uniform(-0.5, 0.5, 2), 0.0])
    up = T_Z_UP_SOURCE[world][:3, :3].T @ tilt.as_matrix().T @ [0.0, 0.0, 1.0]
    T = random_poses(seed)
    turned, T_world_source = to_z_up(T, world, tuple(3 * up))
    np.testing.assert_allclose(T_world_source[:3, :3] @ up, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(T_world_source[:3, :3], tilt.as_matrix() @ T_Z_UP_SOURCE[world][:3, :3], atol=1e-9)
    np.testing.assert_allclose(turned, T_world_source @ T, atol=1e-9)


def test_an_up_that_cannot_be_is_refused():
    with pytest.raises(UsageError, match="no direction"):
        to_z_up(np.eye(4)[None], "z_up", (0.0, 0.0, 0.0))
    far = np.eye(4)[None].copy()
    far[0, 0, 3] = 5e5
    with pytest.raises(UsageError, match="coordinate reference system"):
        to_z_up(far, "z_up", (0.0, 0.1, 1.0))


@given(seed=st.integers(0, 2**32 - 1), reading=st.sampled_from(READINGS))
def test_what_a_reading_does_it_undoes(seed, reading):
    T = random_poses(seed)
    np.testing.assert_allclose(reading.file_poses(reading.camera_poses(T)), T, atol=1e-9)
    np.testing.assert_allclose(rigid_inverse(T) @ T, np.tile(np.eye(4), (3, 1, 1)), atol=1e-9)


@given(seed=st.integers(0, 2**32 - 1), was=st.sampled_from(["xyzw", "wxyz"]), becomes=st.sampled_from(["xyzw", "wxyz"]))
def test_quaternions_are_read_in_the_other_order(seed, was, becomes):
    numbers = np.random.default_rng(seed).normal(size=(3, 4))
    numbers /= np.linalg.norm(numbers, axis=1, keepdims=True)

    def read(order: str) -> np.ndarray:
        T = np.tile(np.eye(4), (3, 1, 1))
        T[:, :3, :3] = Rotation.from_quat(numbers if order == "xyzw" else numbers[:, [1, 2, 3, 0]]).as_matrix()
        return T

    np.testing.assert_allclose(with_other_quaternions(read(was), was, becomes), read(becomes), atol=1e-9)


@pytest.mark.parametrize("reading", READINGS)
def test_files_of_every_convention_read_as_the_same_cameras(tmp_path, reading):
    T = random_poses(5)
    T_source_camera = T_Z_UP_SOURCE[reading.poses_world].T @ T
    path = tmp_path / "poses.tum"
    write_tum(path, np.arange(3.0), reading.file_poses(T_source_camera))
    options = ReadOptions(poses=path, pose_convention=reading.pose_convention, poses_are=reading.poses_are)
    track = read_pose_track(options, path)
    np.testing.assert_allclose(to_z_up(track.T, reading.poses_world)[0], T, atol=1e-9)


def test_positions_in_millimetres_are_read_in_metres(tmp_path):
    path = tmp_path / "poses.tum"
    path.write_text("0 1000 2000 -3000 0 0 0 1\n")
    for unit, metres in (("m", 1000.0), ("cm", 10.0), ("mm", 1.0)):
        track = read_pose_track(ReadOptions(poses=path, poses_unit=unit), path)
        np.testing.assert_allclose(track.T[0, :3, 3], [metres, 2 * metres, -3 * metres])
