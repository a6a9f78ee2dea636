"""ROS bags: image pairs, camera and poses out of one recording of ROS 1 or ROS 2, without ROS.

A bag is read through once when it is opened (`bag_log`); an image is decoded when its frame is mapped.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from jaxmap.datasets.bag_cameras import raw_rig, rectified_camera
from jaxmap.datasets.bag_files import Bag, Place, is_bag
from jaxmap.datasets.bag_gps import georeferenced, gps_poses
from jaxmap.datasets.bag_images import as_pair, decode_image
from jaxmap.datasets.bag_log import BagLog, Shot, read_log
from jaxmap.datasets.bag_poses import BagPoses, optical_pose, tf_poses, topic_poses
from jaxmap.datasets.bag_topics import (
    FIX_TYPE,
    TF_TYPES,
    PairTopics,
    attitude_topic,
    choose_pair,
    choose_poses,
    gps_topic,
    info_topic,
    is_rectified_name,
)
from jaxmap.datasets.base import FrameRef, Reader, StereoPair, StereoSequence, assemble, from_images, read_pose_track
from jaxmap.datasets.bit_depth import bits_note, used_bits
from jaxmap.datasets.calibration_files import read_calibration
from jaxmap.datasets.options import Bits, ReadOptions
from jaxmap.datasets.pairing import nearest_pairs
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.stereo.rectify import StereoRig
from jaxmap.types import StereoCamera

_PROBES = 5


def open_rosbag(path: Path, options: ReadOptions) -> StereoSequence:
    """Opens one recording: a file or folder as `bag_files.is_bag` describes.

    Raises:
        JaxmapError: the bag is damaged, has no stereo pair, no camera or no poses, or several of them.
        UsageError: an option names a topic that the bag does not have.
    """
    bag = Bag(path)
    pair, notes = choose_pair(bag.topics, options.bag, path)
    infos = () if options.calibration else _info_topics(bag, pair, options)
    poses = None if options.poses else choose_poses(bag.topics, options.bag, path)
    gps = gps_topic(bag.topics, options.bag)
    by_gps = poses is not None and bag.topics[poses].type == FIX_TYPE
    imu = attitude_topic(bag.topics, options.bag, path) if by_gps else None
    log = read_log(bag, {*pair, *infos, *(name for name in (poses, gps, imu) if name is not None)})
    for topic in (*pair, *infos):
        if topic not in (log.infos if topic in infos else log.shots):
            raise JaxmapError(f"no message of {topic} can be found", where=path, fix="restore the bag, or reindex it")

    shots, more = _pair_shots(log, pair, options.bag.max_pair_gap_s, path)
    notes += more + _notes_on_log(log, infos)
    times_s = np.array([left.time_ns / 1e9 for left, _ in shots])
    if poses is None:
        found = BagPoses(read_pose_track(options, path), np.eye(4), "", [])
    else:
        found = _bag_poses(log, (poses, bag.topics[poses].type), imu, shots[0][0].frame, times_s, options)
    if gps is not None and imu is None and not from_images(options):
        found = georeferenced(found, log, gps, options)
    places = {str(left.time_ns): (left.place, right.place) for left, right in shots}
    reader = _PairReader(bag, pair, places, options.image_bits)
    camera, more = _camera(log, infos, pair, shots[0], times_s, options)
    usual = Counter(left.size_px for left, _ in shots if left.size_px).most_common(1)
    return assemble(
        name=Path(os.path.abspath(path)).stem,
        dataset="rosbag",
        where=path,
        frames=[
            FrameRef(str(left.time_ns), left.time_ns / 1e9, _named(path, left), _named(path, right))
            for left, right in shots
        ],
        track=found.track,
        camera=camera,
        options=options,
        T_child_camera=found.T_child_camera,
        crs=found.crs,
        notes=[*notes, *reader.notes, *more, *found.notes],
        read_pair=reader,
        size_px=usual[0][0] if usual else reader.size_px,
    )


def _named(path: Path, shot: Shot) -> Path:
    return path / shot.place.topic.strip("/") / str(shot.time_ns)


def _info_topics(bag: Bag, pair: PairTopics, options: ReadOptions) -> tuple[str, str]:
    return (
        info_topic(bag.topics, pair.left, "--bag.left-info", options.bag.left_info, bag.path),
        info_topic(bag.topics, pair.right, "--bag.right-info", options.bag.right_info, bag.path),
    )


def _pair_shots(
    log: BagLog, pair: PairTopics, max_gap_s: float, where: Path
) -> tuple[list[tuple[Shot, Shot]], list[str]]:
    """The pairs that are each other's nearest in time, and notes on what was left out.

    Raises:
        JaxmapError: there are none.
    """
    # One image for each time: a repeated one is a message that was recorded twice.
    sides = [list({shot.time_ns: shot for shot in log.shots[topic]}.values()) for topic in pair]
    left_ns, right_ns = (np.array([shot.time_ns for shot in shots], np.int64) for shots in sides)
    left, right, least_ns = nearest_pairs(left_ns, right_ns, round(max_gap_s * 1e9))
    if not len(left):
        raise JaxmapError(
            f"no images of {pair.left} and {pair.right} lie within {max_gap_s * 1e3:g} ms of each other: the nearest "
            f"two are {least_ns / 1e6:.1f} ms apart",
            where=where,
            fix="check that both cameras are triggered together; --bag.max-pair-gap-s allows more",
        )
    shots = [(sides[0][i], sides[1][j]) for i, j in zip(left, right, strict=True)]
    alone = sum(map(len, sides)) - 2 * len(shots)
    notes = [f"{alone} images have no partner within {max_gap_s * 1e3:g} ms and are left out"] * bool(alone)
    sizes = Counter(shot.size_px for shot, _ in shots if shot.size_px)
    if len(sizes) > 1:
        named = ", ".join(f"{count} of {width}x{height} px" for (width, height), count in sizes.most_common(4))
        notes.append(f"left images of several sizes: {named}; those that the calibration is not for are left out")
    return shots, notes


def _notes_on_log(log: BagLog, infos: tuple[str, ...]) -> list[str]:
    changed = [topic for topic in infos if topic in log.changed]
    notes = [f"{' and '.join(changed)} changes in the bag; its first message is used"] * bool(changed)
    for topic, count in log.unstamped.items():
        notes.append(f"{count} messages of {topic} have no time in their header; that of the recording is used")
    return notes


def _bag_poses(
    log: BagLog, topic: tuple[str, str], imu: str | None, frame: str, times_s: np.ndarray, options: ReadOptions
) -> BagPoses:
    """Poses by the kind of their topic (name and type)."""
    name, kind = topic
    T_frame_optical = optical_pose(log.tree, frame, times_s, options.max_pose_gap_s)
    if kind in TF_TYPES:
        found = tf_poses(log, frame, T_frame_optical, times_s, options)
    elif imu is not None:
        found = gps_poses(log, name, imu, frame, T_frame_optical, times_s, options)
    else:
        found = topic_poses(log, name, frame, T_frame_optical, times_s, options)
    if T_frame_optical[0, 0] == 0:
        found.notes.append(f"{frame} is taken for the camera's link: its z axis points up, not out of the lens")
    return found


def _camera(
    log: BagLog,
    infos: tuple[str, ...],
    pair: PairTopics,
    shots: tuple[Shot, Shot],
    times_s: np.ndarray,
    options: ReadOptions,
) -> tuple[StereoCamera | StereoRig, list[str]]:
    """The calibration given, or that of both CameraInfo; and how the images were taken."""
    if options.calibration:
        rectified = is_rectified_name(pair.left) or options.bag.images_are == "rectified"
        found = read_calibration(options.calibration, rectified=rectified)
        return found.camera, [*found.notes]
    left, right = (log.infos[topic] for topic in infos)
    frames = [shot.frame for shot in shots]
    T_left_right = None
    if all(frame and log.tree.holds(frame) for frame in frames):
        found = log.tree.lookup(frames[0], frames[1], times_s[:1], options.max_pose_gap_s)
        if found is not None and found[1].all():
            to_optical = [optical_pose(log.tree, frame, times_s, options.max_pose_gap_s) for frame in frames]
            T_left_right = np.linalg.inv(to_optical[0]) @ found[0][0] @ to_optical[1]
    images_are, by = options.bag.images_are, "--bag.images-are"
    if images_are == "auto":
        named = is_rectified_name(pair.left)
        same = left.undistorted and right.undistorted and np.allclose(left.K[1], right.K[1])
        images_are = "rectified" if same or named else "raw"
        by = "CameraInfo" if same or named is None else "the topic's name"
    note = f"images are taken for {images_are}, by {by}"
    if images_are == "rectified":
        return rectified_camera(left, right, T_left_right), [note]
    return raw_rig(left, right, T_left_right), [note]


class _PairReader:
    """Reads and decodes the images of one frame; the number of bits of deep images is that of a few, for all.

    Attributes:
        size_px: width and height of the first image that can be decoded.
        notes: how many bits were found.
    """

    def __init__(
        self, bag: Bag, pair: PairTopics, places: Mapping[str, tuple[Place, Place]], bits: Bits | None
    ) -> None:
        """Decodes a few pairs.

        Raises:
            FrameError: none of them can be decoded.
        """
        self._bag, self._pair, self._places = bag, pair, places
        names = list(places)
        picked = {names[int(index)] for index in np.linspace(0, len(names) - 1, _PROBES)}
        probes, fault = [], None
        for name in sorted(picked, key=names.index):
            try:
                probes += self._decoded(name)
            except FrameError as error:
                fault = fault or error
        if fault is not None and not probes:
            raise fault
        self.size_px = (probes[0].shape[1], probes[0].shape[0])
        deep = [image for image in probes if image.dtype == np.uint16]
        self.notes, self._bits = [], bits or 16
        if deep and bits is None:
            self._bits, brighter = used_bits(deep)
            self.notes.append(bits_note(self._bits, brighter))

    def __call__(self, frame: FrameRef) -> StereoPair:
        """The pair of a frame.

        Raises:
            FrameError: an image cannot be read or decoded, or the two differ in size.
        """
        left, right = self._decoded(frame.name)
        return StereoPair(*as_pair(left, right, self._bits, f"frame {frame.name}"))

    def _decoded(self, name: str) -> list[np.ndarray]:
        sides = zip(self._pair, self._places[name], strict=True)
        return [decode_image(self._bag.read(place), f"{topic} at {name}") for topic, place in sides]


READER = Reader(
    "rosbag", "a ROS 1 or ROS 2 bag: a .bag, .mcap or .db3 file, or the folder that holds them", is_bag, open_rosbag
)
