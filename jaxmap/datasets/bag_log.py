"""What one pass through a bag finds: when and where images were taken, cameras, frames, poses, GPS fixes.

Of images only the headers are kept. Times are those of the headers, at which things were measured; where they are 0,
those of the recording.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from jaxmap.datasets.bag_cameras import CameraInfo
from jaxmap.datasets.bag_files import Bag, Message, Place
from jaxmap.datasets.bag_frames import FrameTree, frame_name, stamped_pose
from jaxmap.datasets.bag_topics import FIX_TYPE, IMAGE_TYPES, IMU_TYPE, INFO_TYPE, TF_TYPES
from jaxmap.datasets.stamped_poses import StampedPose


class Shot(NamedTuple):
    """An image that lies in the bag; compressed ones do not say their size."""

    time_ns: int
    place: Place
    size_px: tuple[int, int] | None
    frame: str


class Fix(NamedTuple):
    """A GPS fix; `frame` is that of the antenna."""

    time_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    frame: str


@dataclass
class BagLog:
    """What was read of the topics asked for, by topic.

    Attributes:
        shots: images, in the order of time.
        infos: the first CameraInfo.
        changed: CameraInfo topics whose later messages say something else.
        poses: of pose topics; of Imu topics the orientations, at position 0; of a Path the last one.
        children: frames whose poses a topic gives, as its messages say.
        fixes: of NavSatFix topics.
        unstamped: how many messages of a topic have no time in their header.
        tree: of all tf topics.
    """

    shots: dict[str, list[Shot]] = field(default_factory=lambda: defaultdict(list))
    infos: dict[str, CameraInfo] = field(default_factory=dict)
    changed: set[str] = field(default_factory=set)
    poses: dict[str, list[StampedPose]] = field(default_factory=lambda: defaultdict(list))
    children: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    fixes: dict[str, list[Fix]] = field(default_factory=lambda: defaultdict(list))
    unstamped: Counter[str] = field(default_factory=Counter)
    tree: FrameTree = field(default_factory=FrameTree)


def read_log(bag: Bag, topics: Collection[str]) -> BagLog:
    """Reads the messages of some topics, and all of tf.

    Raises:
        JaxmapError: the bag is damaged.
    """
    log = BagLog()
    wanted = {name for name, topic in bag.topics.items() if name in topics or topic.type in TF_TYPES}
    for message in bag.messages(wanted):
        kind = bag.topics[message.place.topic].type
        if kind in TF_TYPES:
            log.tree.add(message.value, fixed=message.place.topic.endswith("tf_static"))
        elif kind == INFO_TYPE:
            _add_info(log, message)
        elif kind.endswith("/Path"):
            poses = [stamped_pose(_time_ns(log, message, pose.header), pose.pose) for pose in message.value.poses]
            log.poses[message.place.topic] = poses
        else:
            _add_measured(log, message, kind)
    for shots in log.shots.values():
        shots.sort(key=lambda shot: shot.time_ns)
    return log


def _add_info(log: BagLog, message: Message) -> None:
    info = CameraInfo(message.value, message.place.topic)
    if not log.infos.setdefault(info.topic, info).same_as(info):
        log.changed.add(info.topic)


def _add_measured(log: BagLog, message: Message, kind: str) -> None:
    topic, value = message.place.topic, message.value
    time_ns, frame = _time_ns(log, message, value.header), frame_name(value.header.frame_id)
    if kind in IMAGE_TYPES:
        size = (int(value.width), int(value.height)) if hasattr(value, "width") else None
        log.shots[topic].append(Shot(time_ns, message.place, size, frame))
    elif kind == FIX_TYPE:
        # -1 means that the receiver had no fix.
        if value.status.status >= 0:
            log.fixes[topic].append(Fix(time_ns, value.latitude, value.longitude, value.altitude, frame))
    elif kind == IMU_TYPE:
        # By the message's definition -1 means that there is no orientation.
        if value.orientation_covariance[0] != -1:
            turn = value.orientation
            log.poses[topic].append(StampedPose(time_ns, (0.0, 0.0, 0.0), (turn.x, turn.y, turn.z, turn.w)))
            log.children[topic].add(frame)
    else:
        pose = value.transform if hasattr(value, "transform") else value.pose
        log.poses[topic].append(stamped_pose(time_ns, pose.pose if hasattr(pose, "pose") else pose))
        if hasattr(value, "child_frame_id"):
            log.children[topic].add(frame_name(value.child_frame_id))


def _time_ns(log: BagLog, message: Message, header: Any) -> int:
    time_ns = int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)
    if not time_ns:
        log.unstamped[message.place.topic] += 1
    return time_ns or message.place.recorded_ns
