"""The tree of tf, and what axes a frame has."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
from bags import Messages
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxmap.datasets.bag_frames import T_LINK_OPTICAL, FrameTree, axes_of, link_to_optical
from jaxmap.datasets.pose_axes import T_Z_UP_SOURCE
from jaxmap.errors import JaxmapError

MESSAGES = Messages("mcap")
TIMES_S = np.array([0.0, 1.0])


def random_pose(rng: np.random.Generator) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3)
    return T


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, 30), min_size=2, max_size=8))
def test_a_tree_gives_the_same_along_every_way(seed, parents):
    """Frame i + 1 hangs on an earlier one; the world of all is frame 0."""
    rng = np.random.default_rng(seed)
    tree, T_world = FrameTree(), [np.eye(4)]
    for child, number in enumerate(parents, start=1):
        parent, T = number % child, random_pose(rng)
        tree.add(MESSAGES.tf(0, (f"/{parent}", str(child), T)), fixed=True)
        T_world.append(T_world[parent] @ T)
    a, b = rng.integers(0, len(T_world), 2)
    found = tree.lookup(str(a), str(b), TIMES_S, 1.0)
    assert found is not None and found[1].all()
    np.testing.assert_allclose(found[0], np.broadcast_to(np.linalg.inv(T_world[a]) @ T_world[b], (2, 4, 4)), atol=1e-9)


def test_frames_of_other_trees_are_not_connected():
    tree = FrameTree()
    tree.add(MESSAGES.tf(0, ("a", "b", np.eye(4)), ("c", "d", np.eye(4)), ("earth", "a", np.eye(4))), fixed=True)
    assert tree.lookup("b", "d", TIMES_S, 1.0) is None
    assert tree.chain("b") == ["b", "a"], "in the frame of the earth z is not up"


def test_a_circle_is_told():
    tree = FrameTree()
    tree.add(MESSAGES.tf(0, ("a", "b", np.eye(4)), ("b", "a", np.eye(4))), fixed=True)
    with pytest.raises(JaxmapError, match="is its own ancestor"):
        tree.chain("a")


CAMERA = np.stack([scenes.pose(index) for index in range(4)])
BODY = CAMERA @ np.linalg.inv(T_LINK_OPTICAL)


def test_axes_are_told_by_attitude_and_motion():
    assert axes_of(CAMERA) == "optical"
    assert axes_of(BODY) == "body"
    in_a_camera_world = np.linalg.inv(T_Z_UP_SOURCE["camera"]) @ CAMERA
    assert axes_of(in_a_camera_world) == "optical"
    standing = np.repeat(BODY[:1], 4, axis=0)
    standing[:, 2, 3] += [0, 0.01, -0.01, 0]
    assert axes_of(standing) == "body"


def test_a_link_is_known_by_its_axes_or_its_name():
    ahead = Rotation.from_euler("yz", [20, 5], degrees=True).as_matrix()
    assert link_to_optical("camera_link", ahead)
    assert not link_to_optical("camera_optical_frame", ahead)
    assert not link_to_optical("camera", ahead @ T_LINK_OPTICAL[:3, :3])
    assert not link_to_optical("camera", None)
