"""Poses of the left camera out of a bag: from a topic of poses or from tf."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxmap.datasets.bag_frames import (
    T_LINK_OPTICAL,
    FrameTree,
    axes_of,
    link_to_optical,
)
from jaxmap.datasets.bag_log import BagLog
from jaxmap.datasets.base import by_conventions
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.poses import PoseTrack, make_pose_track, poses_at
from jaxmap.datasets.stamped_poses import make_track
from jaxmap.errors import JaxmapError


class BagPoses(NamedTuple):
    """Poses of a frame, and the left camera in it.

    `child` is the frame's name, empty where it has none; `crs` is the system of a georeference.
    """

    track: PoseTrack
    T_child_camera: np.ndarray
    child: str
    notes: list[str]
    crs: str | None = None


def optical_pose(tree: FrameTree, frame: str, times_s: Float64[np.ndarray, "N"], max_gap_s: float) -> np.ndarray:
    """T_frame_optical of the frame that images name: the identity, or the turn from a camera's link to its optics."""
    if not frame or not tree.holds(frame):
        return np.eye(4)
    found = tree.lookup(tree.body_of(frame), frame, times_s[:1], max_gap_s)
    is_link = found is not None and bool(found[1].all()) and link_to_optical(frame, found[0][0, :3, :3])
    return T_LINK_OPTICAL if is_link else np.eye(4)


def tf_poses(
    log: BagLog, camera_frame: str, T_frame_optical: np.ndarray, times_s: Float64[np.ndarray, "N"], options: ReadOptions
) -> BagPoses:
    """Poses of the camera from tf alone, in its topmost frame.

    Raises:
        JaxmapError: tf does not hold the frame of the images, or nothing in it moves.
    """
    if not camera_frame or not log.tree.holds(camera_frame):
        raise JaxmapError(
            f"tf does not hold {camera_frame!r}, the frame of the left images",
            where="tf",
            fix="choose a topic of poses with --bag.poses TOPIC, or give --poses FILE",
        )
    world = log.tree.chain(camera_frame)[-1]
    if not log.tree.moves(camera_frame):
        raise JaxmapError(
            f"tf fixes {camera_frame} to {world}: it holds no poses of the vehicle", where="tf", fix="give --poses FILE"
        )
    found = log.tree.lookup(world, camera_frame, times_s, options.max_pose_gap_s)
    assert found is not None
    T, known = found
    if not known.any():
        raise JaxmapError(
            f"tf from {camera_frame} to {world} is not known at the time of any image",
            where="tf",
            fix=f"check the clocks, or raise --max-pose-gap-s {options.max_pose_gap_s:g}",
        )
    track = make_pose_track(times_s[known], T[known], where=f"tf from {camera_frame} to {world}")
    notes = [f"poses of {camera_frame} in {world} from tf"]
    if options.pose_convention != "auto":
        return BagPoses(by_conventions(track, options), np.eye(4), camera_frame, notes)
    return BagPoses(by_conventions(track, options), T_frame_optical, camera_frame, notes)


def topic_poses(
    log: BagLog,
    topic: str,
    camera_frame: str,
    T_frame_optical: np.ndarray,
    times_s: Float64[np.ndarray, "N"],
    options: ReadOptions,
) -> BagPoses:
    """Poses of a topic, and where the camera is in the frame that they are poses of.

    Raises:
        JaxmapError: no whole pose, or poses of several frames.
    """
    track, dropped = make_track(log.poses[topic], topic)
    notes = [f"poses from {topic}"]
    notes += [f"{dropped} of {len(track.T) + dropped} poses of {topic} repeat a time or are not whole"] * bool(dropped)
    track = by_conventions(track, options)
    if options.pose_convention != "auto":
        return BagPoses(
            track, np.eye(4), "", [*notes, f"{options.pose_convention} axes at the camera's place, as asked"]
        )
    poses = placed(log, track, log.children[topic], camera_frame, T_frame_optical, times_s, options)
    return poses._replace(notes=[*notes, *poses.notes])


def placed(
    log: BagLog,
    track: PoseTrack,
    children: set[str],
    camera_frame: str,
    T_frame_optical: np.ndarray,
    times_s: Float64[np.ndarray, "N"],
    options: ReadOptions,
) -> BagPoses:
    """Where the camera is in the frame that a track is of.

    That frame is the one of the options, else the one that the messages name. Where there is none, the axes
    tell whether it is the camera itself or a body; a body is the one that carries the camera in tf.

    Raises:
        JaxmapError: the messages name several frames.
    """
    notes: list[str] = []
    named = sorted(children - {""})
    if len(named) > 1 and not options.bag.child:
        raise JaxmapError(
            f"poses of several frames: {', '.join(named[:6])}", where=track.where, fix="choose another topic"
        )
    child = (options.bag.child or "".join(named)).strip("/")
    tree, is_camera = log.tree, "optical" in child or axes_of(track.T) == "optical"
    if not child and not is_camera and tree.holds(camera_frame):
        child = tree.body_of(camera_frame)
        notes.append(f"they are taken for those of {child} (--bag.child names another frame)")
    if tree.holds(child) and tree.holds(camera_frame):
        mounted = _mounted(tree, child, camera_frame, track, times_s, options)
        if mounted is not None:
            track, T_child_frame, child = mounted
            return BagPoses(track, T_child_frame @ T_frame_optical, child, [*notes, f"{camera_frame} in {child} by tf"])
    if is_camera:
        return BagPoses(track, np.eye(4), child, [*notes, "they are taken for those of the left camera"])
    notes.append(
        f"they are poses of a body ({child or 'x forward, z up'}), and tf does not say where the camera is: it is "
        "taken to be there and look ahead; write a mounting into --calibration, or give --poses"
    )
    return BagPoses(track, T_LINK_OPTICAL, child, notes)


def _mounted(
    tree: FrameTree,
    child: str,
    camera_frame: str,
    track: PoseTrack,
    times_s: Float64[np.ndarray, "N"],
    options: ReadOptions,
) -> tuple[PoseTrack, np.ndarray, str] | None:
    """A track, the frame of the camera in its child frame by tf, and the child; where tf moves, the camera itself."""
    found = tree.lookup(child, camera_frame, times_s, options.max_pose_gap_s)
    if found is None or not found[1].any():
        return None
    T_child_frame, known = found
    first = T_child_frame[int(np.argmax(known))]
    if known.all() and (T_child_frame == first).all():
        return track, first, child
    T_world_child, there = poses_at(track, times_s, options.max_pose_gap_s)
    both = known & there
    if not both.any():
        return track, first, child
    T_world_frame = T_world_child[both] @ T_child_frame[both]
    return make_pose_track(times_s[both], T_world_frame, where=track.where), np.eye(4), camera_frame
