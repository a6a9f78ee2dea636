"""Frames of a bag: the tree of tf, tracks of poses from messages, and which way the axes of a frame point."""

from __future__ import annotations

from collections import defaultdict
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float64

from jaxmap.datasets.poses import PoseTrack, poses_at
from jaxmap.datasets.stamped_poses import StampedPose, make_track
from jaxmap.errors import JaxmapError

T_LINK_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""A camera's optical frame (x right, y down, z forward) in its link frame (x forward, y left, z up), REP 103."""

LEAST_TRAVEL_M = 0.2
"""What moves less does not tell its axes by its motion."""

_GLOBES = ("earth", "ecef")
"""Frames above a local world, in which z is not up (REP 105)."""


def frame_name(name: str) -> str:
    """A name of tf; ROS 1 wrote it with a slash before it."""
    return str(name).strip("/")


def stamped_pose(time_ns: int, pose: Any) -> StampedPose:
    """From `geometry_msgs/Pose` or `Transform`."""
    at = pose.position if hasattr(pose, "position") else pose.translation
    turn = pose.orientation if hasattr(pose, "orientation") else pose.rotation
    return StampedPose(time_ns, (at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w))


class FrameTree:
    """The frames of tf: each has one parent, and a transform to it that is fixed or changes with time."""

    def __init__(self) -> None:
        """Without frames."""
        self._poses: dict[tuple[str, str], list[StampedPose]] = defaultdict(list)
        self._fixed: set[tuple[str, str]] = set()
        self._tracks: dict[tuple[str, str], PoseTrack] = {}

    def add(self, message: Any, fixed: bool) -> None:
        """Adds the transforms of a `TFMessage`; those of `tf_static` are fixed."""
        for transform in message.transforms:
            edge = frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)
            stamp = transform.header.stamp
            time_ns = int(stamp.sec) * 10**9 + int(stamp.nanosec)
            self._poses[edge].append(stamped_pose(time_ns, transform.transform))
            if fixed:
                self._fixed.add(edge)

    def holds(self, frame: str) -> bool:
        """Whether tf knows a frame."""
        return any(frame in edge for edge in self._poses)

    def chain(self, frame: str) -> list[str]:
        """A frame and its ancestors, the nearest first.

        Raises:
            JaxmapError: a frame has two parents, or is its own ancestor.
        """
        frames = [frame]
        while parents := {parent for parent, child in self._poses if child == frames[-1] and parent not in _GLOBES}:
            if len(parents) > 1:
                raise JaxmapError(
                    f"frame {frames[-1]} has two parents, {' and '.join(sorted(parents)[:2])}",
                    where="tf",
                    fix="choose a topic of poses with --bag.poses TOPIC, or give --poses FILE",
                )
            (parent,) = parents
            if parent in frames:
                raise JaxmapError(f"frame {parent} is its own ancestor", where="tf", fix="give --poses FILE")
            frames.append(parent)
        return frames

    def moves(self, frame: str) -> bool:
        """Whether a frame moves against any of its ancestors."""
        chain = self.chain(frame)
        return any(not self._is_fixed((parent, child)) for child, parent in pairwise(chain))

    def body_of(self, frame: str) -> str:
        """The farthest ancestor to which a frame is fixed: the body that carries it, or itself."""
        chain = self.chain(frame)
        for child, parent in pairwise(chain):
            if not self._is_fixed((parent, child)):
                return child
        return chain[-1]

    def lookup(
        self, target: str, source: str, times_s: Float64[np.ndarray, "N"], max_gap_s: float
    ) -> tuple[Float64[np.ndarray, "N 4 4"], Bool[np.ndarray, "N"]] | None:
        """T_target_source at given times, interpolated; None where tf does not connect the two.

        Returns:
            T: (N, 4, 4), NaN where a transform on the way is not known.
            known: (N,).
        """
        up, down = self.chain(target), self.chain(source)
        common = next((frame for frame in down if frame in up), None)
        if common is None:
            return None
        T_common_target, known_target = self._to_ancestor(up[: up.index(common) + 1], times_s, max_gap_s)
        T_common_source, known_source = self._to_ancestor(down[: down.index(common) + 1], times_s, max_gap_s)
        if target == common:
            return T_common_source, known_source
        return np.linalg.inv(T_common_target) @ T_common_source, known_target & known_source

    def _to_ancestor(
        self, chain: list[str], times_s: Float64[np.ndarray, "N"], max_gap_s: float
    ) -> tuple[np.ndarray, np.ndarray]:
        T, known = np.tile(np.eye(4), (len(times_s), 1, 1)), np.ones(len(times_s), bool)
        for child, parent in pairwise(chain):
            edge = parent, child
            track = self._track(edge)
            if self._is_fixed(edge):
                T = track.T[-1] @ T
            else:
                T_parent_child, there = poses_at(track, times_s, max_gap_s)
                T, known = T_parent_child @ T, known & there
        return T, known

    def _track(self, edge: tuple[str, str]) -> PoseTrack:
        if edge not in self._tracks:
            self._tracks[edge] = make_track(self._poses[edge], f"tf from {edge[1]} to {edge[0]}")[0]
        return self._tracks[edge]

    def _is_fixed(self, edge: tuple[str, str]) -> bool:
        """Nodes of ROS 1 send fixed transforms again and again, as if they moved."""
        if edge in self._fixed:
            return True
        first = self._poses[edge][0]
        return all(pose[1:] == first[1:] for pose in self._poses[edge])


def axes_of(T_world_child: Float64[np.ndarray, "N 4 4"]) -> Literal["optical", "body"]:
    """Whether a moving frame has the axes of a camera (z forward, y down) or of a body (x forward, z up).

    Where its y axis points down, it is a camera's. Where its z axis points up, it is a body, unless it moves
    along that axis: then it is a camera in a world that is a camera's, too. Anything else (looking straight down) is
    taken for a camera.
    """
    down_y, up_z = -T_world_child[:, 2, 1].mean(), T_world_child[:, 2, 2].mean()
    if down_y > 0.5 or up_z < 0.5:
        return "optical"
    steps = np.diff(T_world_child[:, :3, 3], axis=0)
    along = np.abs(np.einsum("nij,ni->nj", T_world_child[:-1, :3, :3], steps)).sum(axis=0)
    return "optical" if along[2] > max(2 * along[0], LEAST_TRAVEL_M) else "body"


def link_to_optical(frame: str, R_body_camera: Float64[np.ndarray, "3 3"] | None) -> bool:
    """Whether images that are said to lie in a frame lie in the optical frame belonging to it.

    By REP 104 images are in an optical frame, whose z axis points out of the lens; simulators and drivers often name
    the camera's link instead, whose z axis points up in the body.
    """
    if "optical" in frame.lower() or R_body_camera is None:
        return False
    return bool(R_body_camera[2, 2] > 0.7)
