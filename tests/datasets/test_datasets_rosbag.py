"""The reader of ROS bags, on bags of the scene of tests/scenes.py."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import scenes
from bags import KINDS, Kind, Messages, Sent

from jaxmap.datasets import ReadOptions, StereoSequence, open_sequence
from jaxmap.datasets.bag_frames import T_LINK_OPTICAL
from jaxmap.datasets.options import BagOptions
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.stereo.rectify import StereoRig, make_rectifier
from jaxmap.types import StereoCamera

SIZE_PX = (scenes.WIDTH_PX, scenes.HEIGHT_PX)
K = [[scenes.F_PX, 0, scenes.CX_PX], [0, scenes.F_PX, scenes.CY_PX], [0, 0, 1]]
FRAMES = 3


def time_ns(index: int) -> int:
    return round(scenes.timestamp_s(index) * 1e9)


def P(side: str) -> np.ndarray:
    return np.column_stack([K, [-scenes.F_PX * scenes.BASELINE_M if side == "right" else 0.0, 0, 0]])


def images(messages: Messages, root: str = "/stereo", frame: str = "cam_optical", shift_ns: int = 0) -> list[Sent]:
    """Rectified pairs and their CameraInfo; headers say when they were taken, the recording is 20 ms late."""
    sent = []
    for index in range(FRAMES):
        taken_ns, pair = time_ns(index), scenes.scene_frame(index)
        for side, pixels, late_ns in (("left", pair.left, 0), ("right", pair.right, shift_ns)):
            info = messages.info(SIZE_PX, K, np.zeros(5), np.eye(3), P(side), time_ns=taken_ns, frame=frame)
            message = messages.image(taken_ns + late_ns, pixels, "mono8", frame, padding=3)
            topic = f"{root}/{side}/image_rect"
            sent += [
                Sent(f"{root}/{side}/camera_info", taken_ns + 20_000_000, info),
                Sent(topic, taken_ns + 20_000_000, message),
            ]
    return sent


def camera_poses(messages: Messages, topic: str = "/pose") -> list[Sent]:
    return [
        Sent(topic, time_ns(index), messages.pose_stamped(time_ns(index), scenes.pose(index)))
        for index in range(FRAMES)
    ]


def bag(tmp_path: Path, kind: Kind, sent: list[Sent]) -> Path:
    name = "log.bag" if kind == "ros1" else "log"
    return Messages(kind).write(tmp_path / name, sorted(sent, key=lambda message: message.time_ns))


def whole_bag(tmp_path: Path, kind: Kind = "ros1") -> Path:
    messages = Messages(kind)
    return bag(tmp_path, kind, images(messages) + camera_poses(messages))


def refused(path: Path, options: ReadOptions | None = None) -> str:
    with pytest.raises(JaxmapError) as caught:
        open_sequence(path, options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def assert_same(found: StereoSequence, expected: StereoSequence) -> None:
    """The same numbers, bit for bit."""
    assert isinstance(found.camera, StereoCamera) and isinstance(expected.camera, StereoCamera)
    assert vars(found.camera) == vars(expected.camera)
    np.testing.assert_array_equal(found.T_world_camera, expected.T_world_camera)
    assert [frame.timestamp_s for frame in found.frames] == [frame.timestamp_s for frame in expected.frames]
    for frame, other in zip(found.frames, expected.frames, strict=True):
        for image, true_image in zip(found.read_pair(frame), expected.read_pair(other), strict=True):
            np.testing.assert_array_equal(image, true_image)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_gives_what_the_folder_gives(tmp_path, kind):
    folder = scenes.write_folder_sequence(tmp_path / "folder", FRAMES)
    path = whole_bag(tmp_path, kind)
    expected = open_sequence(folder)
    assert_same(open_sequence(path), expected)
    if kind != "ros1":
        (file,) = path.glob("*.db3" if kind == "sqlite3" else "*.mcap")
        (path / "metadata.yaml").unlink()
        assert_same(open_sequence(file), expected)
        assert_same(open_sequence(path), expected)
