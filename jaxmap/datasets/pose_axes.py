"""The conventions of pose files: axes of the posed frame and of the world, direction of the transform, quaternions.

A file's poses `T_file` become `T_world_camera = T_world_source @ T_source_child @ T_child_camera`: `T_source_child` is
`T_file` or its inverse, `T_child_camera` turns the axes of the posed frame into the optical ones (x right, y down,
z forward), and `T_world_source` turns the file's world z-up.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from jaxmap.datasets.options import PosesAre, PosesWorld
from jaxmap.errors import UsageError

Axes = Literal["optical", "body", "frd", "opengl"]
World = Literal["z_up", "z_down", "y_up", "camera"]
Quaternion = Literal["xyzw", "wxyz"]


def _turn(*columns: tuple[int, int, int]) -> np.ndarray:
    """(4, 4), the rotation whose columns are given."""
    T = np.eye(4)
    T[:3, :3] = np.array(columns, np.float64).T
    return T


T_CHILD_CAMERA: dict[Axes, np.ndarray] = {
    "optical": np.eye(4),
    "body": _turn((0, -1, 0), (0, 0, -1), (1, 0, 0)),
    "frd": _turn((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    "opengl": np.diag([1.0, -1.0, -1.0, 1.0]),
}
"""The optical frame in a frame of each convention; the columns are right, down and forward."""

T_Z_UP_SOURCE: dict[World, np.ndarray] = {
    "z_up": np.eye(4),
    "z_down": _turn((0, 1, 0), (1, 0, 0), (0, 0, -1)),
    "y_up": _turn((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "camera": _turn((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
"""Each kind of world turned z-up: north, east, down becomes east, north, up; where y is up or down, x stays x and
forward (-z or z) becomes y."""

MAX_LOCAL_RANGE_M = 10_000.0
"""Smaller coordinates need no site origin: float32 resolves 1 mm there."""

UPRIGHT = 0.8
"""Cosine of the angle between the cameras' mean up axis and a world's up axis that is clear; 37 degrees."""


class PoseReading(NamedTuple):
    """How the numbers of a pose file are read; each field is the value of an option."""

    pose_convention: Axes = "optical"
    poses_world: World = "z_up"
    poses_are: PosesAre = "T_world_camera"
    quaternion: Quaternion = "xyzw"

    def camera_poses(self, T_file: Float64[np.ndarray, "N 4 4"]) -> Float64[np.ndarray, "N 4 4"]:
        """T_source_camera of poses as they stand in the file, in the file's own world."""
        T_source_child = T_file if self.poses_are == "T_world_camera" else rigid_inverse(T_file)
        return T_source_child @ T_CHILD_CAMERA[self.pose_convention]

    def file_poses(self, T_source_camera: Float64[np.ndarray, "N 4 4"]) -> Float64[np.ndarray, "N 4 4"]:
        """The inverse of `camera_poses`."""
        T_source_child = T_source_camera @ T_CHILD_CAMERA[self.pose_convention].T
        return T_source_child if self.poses_are == "T_world_camera" else rigid_inverse(T_source_child)


def rigid_inverse(T: Float64[np.ndarray, "N 4 4"]) -> Float64[np.ndarray, "N 4 4"]:
    """The inverses of rigid transforms."""
    inverse = T.copy()
    inverse[:, :3, :3] = T[:, :3, :3].transpose(0, 2, 1)
    inverse[:, :3, 3] = -(inverse[:, :3, :3] @ T[:, :3, 3:])[..., 0]
    return inverse


def with_other_quaternions(T: Float64[np.ndarray, "N 4 4"], was: str, becomes: str) -> Float64[np.ndarray, "N 4 4"]:
    """The poses that the same numbers make when their quaternions are read in another order.

    Args:
        T: poses whose quaternions were read in the order `was`.
        was: xyzw or wxyz.
        becomes: xyzw or wxyz.
    """
    if was == becomes:
        return T
    numbers = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    if was == "wxyz":
        numbers = numbers[:, [3, 0, 1, 2]]
    turned = T.copy()
    turned[:, :3, :3] = Rotation.from_quat(numbers[:, [1, 2, 3, 0]] if becomes == "wxyz" else numbers).as_matrix()
    return turned


def stand_upright(T: Float64[np.ndarray, "N 4 4"]) -> bool:
    """Whether cameras with optical axes stand upright on the mean, in a z-up world."""
    return bool(-T[:, 2, 1].mean() > UPRIGHT)


def found_world(T: Float64[np.ndarray, "N 4 4"], world: PosesWorld) -> World:
    """The world of camera poses as it is given; or `auto`.

    That takes it for a camera world (KITTI's) if the mean of the cameras' up axes (-y) points clearly along its -y,
    else for z-up.
    """
    if world != "auto":
        return world
    up_world = -T[:, :3, 1].mean(axis=0)
    return "camera" if -up_world[1] > UPRIGHT and -up_world[1] > abs(up_world[2]) else "z_up"


def to_z_up(
    T: Float64[np.ndarray, "N 4 4"], world: PosesWorld, up: tuple[float, float, float] | None = None
) -> tuple[Float64[np.ndarray, "N 4 4"], Float64[np.ndarray, "4 4"]]:
    """Camera poses in a z-up world, and the transform from their own world into it.

    Args:
        T: T_source_camera.
        world: the kind of that world, see `found_world`.
        up: the direction of up in it, where it is not level; the least turn makes it so.

    Raises:
        UsageError: `up` has no direction, or the poses lie too far from their origin to be turned about it.
    """
    T_world_source = T_Z_UP_SOURCE[found_world(T, world)].copy()
    if up is not None:
        length = np.linalg.norm(up)
        if not 1e-6 < length < np.inf:
            raise UsageError(f"{up} has no direction", where="--poses-up", fix="give the one that jaxmap check tells")
        if (np.abs(T[:, :3, 3]) > MAX_LOCAL_RANGE_M).any():
            raise UsageError(
                "the poses lie more than 10 km from their origin, as those of a coordinate reference system, whose up "
                "is known",
                where="--poses-up",
                fix="leave it out",
            )
        up_about = T_world_source[:3, :3] @ np.array(up) / length
        level = Rotation.align_vectors([[0.0, 0.0, 1.0]], up_about[None])[0]
        T_world_source[:3, :3] = level.as_matrix() @ T_world_source[:3, :3]
    return T_world_source @ T, T_world_source
