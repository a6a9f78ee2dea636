"""Poses with times, as messages and tables give them, made into a track."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxmap.datasets.poses import PoseTrack, make_pose_track
from jaxmap.errors import JaxmapError


class StampedPose(NamedTuple):
    """A pose at a time; a quaternion of length 0 stands in messages that were never filled."""

    time_ns: int
    position_m: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float]


def make_track(poses: Iterable[StampedPose], where: str) -> tuple[PoseTrack, int]:
    """A track in the order of time, and how many poses were left out: repeated times, and poses that are none.

    Raises:
        JaxmapError: nothing is left.
    """
    by_time: dict[int, StampedPose] = {}
    count = 0
    for pose in poses:
        count += 1
        norm = float(np.linalg.norm(pose.quaternion_xyzw))
        if abs(norm - 1) < 1e-2 and np.isfinite(pose.position_m).all():
            by_time.setdefault(pose.time_ns, pose)
    if not by_time:
        raise JaxmapError(f"none of {count} poses is whole", where=where, fix="give other poses")
    kept = [by_time[time_ns] for time_ns in sorted(by_time)]
    T = np.tile(np.eye(4), (len(kept), 1, 1))
    T[:, :3, :3] = Rotation.from_quat([pose.quaternion_xyzw for pose in kept]).as_matrix()
    T[:, :3, 3] = [pose.position_m for pose in kept]
    times_s = np.array([pose.time_ns / 1e9 for pose in kept])
    # Far from 1970 float64 resolves no less than a quarter of a microsecond.
    distinct = np.diff(times_s, prepend=-np.inf) > 0
    return make_pose_track(times_s[distinct], T[distinct], where=where), count - int(distinct.sum())
