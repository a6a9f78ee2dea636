"""Which topics of a bag make the stereo pair, and which one gives the poses: by their names and types alone."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from jaxmap.datasets.bag_files import Topic
from jaxmap.datasets.options import BagOptions
from jaxmap.errors import JaxmapError, UsageError

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO_TYPE = "sensor_msgs/msg/CameraInfo"
POSE_TYPES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Path",
)
TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
FIX_TYPE, IMU_TYPE = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu"

_SIDES = (("left", "right"), ("l", "r"), ("infra1", "infra2"), ("port", "starboard"), ("master", "slave"))
_NO_PICTURE = re.compile(r"depth|disparity|confidence|mask|label|segment|theora|compresseddepth|cost", re.IGNORECASE)
_NO_TRACK = re.compile(r"goal|initial_?pose|plan|setpoint|target|waypoint|command|cmd", re.IGNORECASE)
_PICTURE = re.compile(r"(_?(image|rect|rectified|raw|rgb|gr[ae]y|colou?r|mono))+")
_MOST_NAMED = 12


class PairTopics(NamedTuple):
    """The image topics of a stereo pair."""

    left: str
    right: str


def choose_pair(topics: Mapping[str, Topic], options: BagOptions, where: Path) -> tuple[PairTopics, list[str]]:
    """The stereo pair, and notes on what was chosen.

    Left and right are found by names that differ in one word alone: left and right, l and r, infra1 and infra2, or
    a number and the next one (cam0, cam1). Of several pictures of one pair of cameras, the rectified one is
    taken, then colour, then the uncompressed one.

    Raises:
        JaxmapError: no image, no pair, or pairs of several rigs.
        UsageError: a topic of the options is not an image topic of the bag.
    """
    images = {name: topic for name, topic in topics.items() if topic.type in IMAGE_TYPES}
    for option, name in (("--bag.left", options.left), ("--bag.right", options.right)):
        if name is not None and name not in images:
            raise UsageError(f"{name} is no image topic of the bag: {_listed(images)}", where=option, fix="choose one")
    if options.left is not None and options.right is not None:
        if options.left == options.right:
            raise UsageError("--bag.left and --bag.right are one topic", fix="give the two topics of a stereo pair")
        return PairTopics(options.left, options.right), []
    if not images:
        raise JaxmapError(f"no image topic; the bag has {_listed(topics)}", where=where, fix="give the bag with images")
    found = [
        pair for pair in _pairs(images) if options.left in (None, pair.left) and options.right in (None, pair.right)
    ]
    if not found:
        raise JaxmapError(
            f"no two image topics whose names are those of a left and a right camera: {_listed(images)}",
            where=where,
            fix="choose with --bag.left TOPIC --bag.right TOPIC",
        )
    rigs = {_camera_name(pair.left) for pair in found}
    if len(rigs) > 1:
        named = "; ".join(f"{pair.left} and {pair.right}" for pair in found[:_MOST_NAMED])
        raise JaxmapError(
            f"{len(rigs)} stereo pairs: {named}", where=where, fix="choose with --bag.left TOPIC --bag.right TOPIC"
        )
    best = min(found, key=lambda pair: _preference(pair.left, images))
    others = [pair.left for pair in found if pair != best]
    note = f"images of {best.left} and {best.right}"
    return best, [note + (f"; --bag.left chooses another: {', '.join(others[:_MOST_NAMED])}" if others else "")]


def is_rectified_name(topic: str) -> bool | None:
    """Whether an image topic is rectified, by ROS's names: `image_rect*` is, `image_raw`, `image_color`... are not."""
    words = re.split(r"[/_]", topic.lower())
    if any(word.startswith("rect") for word in words):
        return True
    return False if words[-1] in ("raw", "mono") or words[-2:] == ["image", "color"] else None


def info_topic(topics: Mapping[str, Topic], image: str, option: str, given: str | None, where: Path) -> str:
    """The CameraInfo topic of an image topic: the one given, or `camera_info` beside it.

    Raises:
        JaxmapError: there is none.
        UsageError: the one given is no CameraInfo topic.
    """
    infos = {name: topic for name, topic in topics.items() if topic.type == INFO_TYPE}
    if given is not None:
        if given not in infos:
            raise UsageError(
                f"{given} is no CameraInfo topic of the bag: {_listed(infos)}", where=option, fix="choose one"
            )
        return given
    parts = image.split("/")
    # image_transport appends /compressed; some drivers give each picture of a camera a folder of its own.
    beside = ["/".join([*parts[:count], "camera_info"]) for count in range(len(parts) - 1, 0, -1)]
    for name in beside[:3]:
        if name in infos:
            return name
    raise JaxmapError(
        f"no CameraInfo for {image}; the bag has {_listed(infos)}",
        where=where,
        fix=f"give {option} TOPIC, or the calibration with --calibration FILE",
    )


def choose_poses(topics: Mapping[str, Topic], options: BagOptions, where: Path) -> str:
    """The topic of the poses: the one given; else the only one that gives poses; else the tf tree; else GPS fixes.

    Raises:
        JaxmapError: there are none, or several.
        UsageError: the one given is none.
    """
    kinds = (*POSE_TYPES, *TF_TYPES, FIX_TYPE)
    known = {name: topic for name, topic in topics.items() if topic.type in kinds}
    if options.poses is not None:
        if options.poses not in known:
            raise UsageError(
                f"{options.poses} gives no poses in this bag: {_listed(known)}", where="--bag.poses", fix="choose one"
            )
        return options.poses
    tracks = [name for name, topic in known.items() if topic.type in POSE_TYPES and not _NO_TRACK.search(name)]
    if len(tracks) > 1:
        chosen = {name: known[name] for name in known if name in tracks or known[name].type not in POSE_TYPES}
        raise JaxmapError(
            f"{len(tracks)} topics give poses: {_listed(chosen)}", where=where, fix="choose with --bag.poses TOPIC"
        )
    if tracks:
        return tracks[0]
    moving = [name for name, topic in known.items() if topic.type in TF_TYPES and not name.endswith("tf_static")]
    fixes = [name for name, topic in known.items() if topic.type == FIX_TYPE]
    chosen = moving or fixes
    if len(chosen) > 1:
        raise JaxmapError(
            f"several topics give poses: {_listed(chosen)}", where=where, fix="choose with --bag.poses TOPIC"
        )
    if not chosen:
        raise JaxmapError(
            f"the bag has no poses: no Odometry, pose, Path, tf or NavSatFix topic among {_listed(topics)}",
            where=where,
            fix="give them with --poses FILE (TUM text, T_world_camera of the left camera), or --poses odometry",
        )
    return chosen[0]


def gps_topic(topics: Mapping[str, Topic], options: BagOptions) -> str | None:
    """The NavSatFix topic that georeferences the poses, if one is given.

    Raises:
        UsageError: the bag does not have it.
    """
    fixes = [name for name, topic in topics.items() if topic.type == FIX_TYPE]
    if options.gps is not None and options.gps not in fixes:
        raise UsageError(
            f"{options.gps} is no NavSatFix topic of the bag: {_listed(fixes)}", where="--bag.gps", fix="choose one"
        )
    return options.gps


def attitude_topic(topics: Mapping[str, Topic], options: BagOptions, where: Path) -> str:
    """The Imu topic whose orientation turns GPS fixes into poses.

    Raises:
        JaxmapError: there is none, or several.
    """
    imus = [name for name, topic in topics.items() if topic.type == IMU_TYPE]
    if options.attitude is not None:
        if options.attitude not in imus:
            raise UsageError(
                f"{options.attitude} is no Imu topic of the bag: {_listed(imus)}",
                where="--bag.attitude",
                fix="choose one",
            )
        return options.attitude
    if len(imus) != 1:
        what = (
            f"{len(imus)} Imu topics: {_listed(imus)}"
            if imus
            else "GPS fixes, but no Imu topic that gives the attitude"
        )
        raise JaxmapError(what, where=where, fix="choose with --bag.attitude TOPIC, or give --poses FILE")
    return imus[0]


def _pairs(images: Mapping[str, Topic]) -> Iterator[PairTopics]:
    for left in sorted(images):
        if not _NO_PICTURE.search(left):
            yield from (PairTopics(left, right) for right in _partners(left, images) if right in images)


def _partners(left: str, images: Collection[str]) -> Iterator[str]:
    """The names that a right image may have: one word, wherever it occurs, replaced by that of the other side."""
    words = re.split(r"([/_])", left)
    for one, other in _SIDES:
        for case in (str.lower, str.upper, str.capitalize):
            if case(one) in words:
                yield "".join(case(other) if word == case(one) else word for word in words)
    for index, word in enumerate(words):
        numbered = re.fullmatch(r"([a-zA-Z]*)([0-9]+)", word)
        if numbered is None:
            continue

        def of_camera(number: int, index: int = index, parts: re.Match = numbered) -> str:
            return "".join([*words[:index], f"{parts[1]}{number:0{len(parts[2])}d}", *words[index + 1 :]])

        # Of four cameras 0 to 3, 1 and 2 are no pair; some drivers count from 1.
        number = int(numbered[2])
        first = next((low for low in (0, 1) if of_camera(low) in images), 0)
        if (number - first) % 2 == 0:
            yield of_camera(number + 1)


def _camera_name(topic: str) -> str:
    """What the pictures of one camera have in common: the name without the last words that tell the picture."""
    words = [word for word in topic.split("/") if word != "compressed"]
    return "/".join(word for word in words if not _PICTURE.fullmatch(word.lower()))


def _preference(topic: str, images: Mapping[str, Topic]) -> tuple[bool, bool, bool, str]:
    colour = re.search("colou?r|rgb", topic.lower()) is not None
    return (not is_rectified_name(topic), not colour, images[topic].type != IMAGE_TYPES[0], topic)


def _listed(topics: Mapping[str, Topic] | list[str]) -> str:
    """Topics in one line, with their types where they are known."""
    if not topics:
        return "none"
    if isinstance(topics, Mapping):
        named = [f"{name} ({topic.type.rpartition('/')[2]})" for name, topic in sorted(topics.items())]
    else:
        named = sorted(topics)
    more = f" and {len(named) - _MOST_NAMED} more" if len(named) > _MOST_NAMED else ""
    return ", ".join(named[:_MOST_NAMED]) + more
