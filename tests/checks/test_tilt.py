"""A world of poses that is not level is told, with the option that levels it; slopes and walls are not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_pose_convention import PITCH_DEG, drive, normals_of, seen

from jaxmap.checks.pose_convention import pose_convention
from jaxmap.checks.tilt import tilt_findings
from jaxmap.datasets.pose_axes import PoseReading, rigid_inverse, to_z_up

CAMERA_WORLD = PoseReading(poses_world="camera")


def test_a_world_that_begins_at_a_pitched_camera_is_told_and_levelled_by_the_option():
    T = drive(3)
    T_first = rigid_inverse(T[:1]) @ T
    read, _ = to_z_up(T_first, "camera")
    (found,) = pose_convention(read, seen(T), normals_of(T), reading=CAMERA_WORLD)
    assert found.kind == "tilted-world" and found.stops
    option, *up = found.fix.split()
    assert option == "--poses-up" and len(up) == 3
    x, y, z = map(float, up)
    level, _ = to_z_up(T_first, "camera", (x, y, z))
    assert not pose_convention(level, seen(T), normals_of(T), reading=CAMERA_WORLD)
    assert level[0, 2, :3] @ T[0, :3, :3].T @ [0, 0, 1] == pytest.approx(1, abs=1e-3)


def turned(T: np.ndarray, degrees: float) -> np.ndarray:
    """The poses in a world turned about x."""
    R = np.eye(4)
    R[:3, :3] = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    return R @ T


def test_a_slope_may_be_one():
    T = drive(3)
    assert not tilt_findings(turned(T, PITCH_DEG / 2), normals_of(T), PoseReading())
    (found,) = tilt_findings(turned(T, PITCH_DEG), normals_of(T), PoseReading())
    assert not found.stops and "slope" in found.fix and f"{PITCH_DEG:.0f} degrees" in found.what


def test_walls_and_planes_that_differ_are_none_of_it():
    T = drive(3)
    assert not tilt_findings(turned(T, 80), normals_of(T), PoseReading())
    one, *rest = normals_of(T)
    assert not tilt_findings(turned(T, PITCH_DEG), [one], PoseReading())
    leaning = [(row, normals @ np.diag([1.0, 1.0, -1.0])) for row, normals in rest[::2]]
    assert not tilt_findings(turned(T, 3), [one, *leaning], PoseReading())
