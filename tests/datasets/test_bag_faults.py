"""Bags that cannot be read, or hold too little or too much: one line each, with the option that chooses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scenes
from bags import FRAMES, KINDS, Messages, Sent, bag, camera_poses, images, time_ns, whole_bag

from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.datasets.bag_files import Bag, Topic, is_bag
from jaxmap.datasets.bag_topics import choose_pair, is_rectified_name
from jaxmap.datasets.options import BagOptions
from jaxmap.errors import FrameError, JaxmapError

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


def refused(path: Path, **options: str | float) -> str:
    with pytest.raises(JaxmapError) as caught:
        open_sequence(path, ReadOptions(bag=BagOptions(**options)))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def without(sent: list[Sent], ending: str) -> list[Sent]:
    return [message for message in sent if not message.topic.endswith(ending)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.999])
def test_a_truncated_bag_is_told(tmp_path, kind, share):
    path = whole_bag(tmp_path, kind)
    file = path if kind == "ros1" else next(file for file in path.iterdir() if file.suffix != ".yaml")
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    assert "the bag cannot be read" in refused(path)
    assert is_bag(file)


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
def test_a_file_that_only_has_the_name_of_a_bag_is_told(tmp_path, name):
    (tmp_path / name).write_bytes(b"no bag at all, but long enough to be read" * 9)
    assert "the bag cannot be read" in refused(tmp_path / name)


def test_topics_that_are_only_announced_are_told(tmp_path, monkeypatch):
    path = whole_bag(tmp_path)
    monkeypatch.setattr(Bag, "messages", lambda bag, topics: iter(()))
    assert "no message of /stereo/left/image_rect can be found" in refused(path)


def test_an_image_whose_bytes_are_damaged_is_one_lost_frame(tmp_path):
    path = whole_bag(tmp_path)
    sequence = open_sequence(path)
    data = bytearray(path.read_bytes())
    # The encoding of the first left image, which lies before its pixels.
    at = data.index(b"mono8")
    path.write_bytes(data[:at] + b"mosaic"[:5] + data[at + 5 :])
    sequence = open_sequence(path)
    with pytest.raises(FrameError, match="encoding 'mosai'"):
        sequence.read_pair(sequence.frames[0])
    assert sequence.read_pair(sequence.frames[1]).left.shape == (scenes.HEIGHT_PX, scenes.WIDTH_PX)


def test_several_rigs_are_listed_and_chosen(tmp_path):
    messages = Messages("ros1")
    sent = images(messages, "/front") + images(messages, "/rear") + camera_poses(messages)
    path = bag(tmp_path, "ros1", sent)
    text = refused(path)
    assert "2 stereo pairs: /front/left/image_rect and /front/right/image_rect; /rear/left" in text
    assert "--bag.left TOPIC" in text
    chosen = open_sequence(path, ReadOptions(bag=BagOptions(left="/rear/left/image_rect")))
    assert "images of /rear/left/image_rect and /rear/right/image_rect" in chosen.notes
    assert "/odd is no image topic of the bag: /front/left/image_rect (Image)" in refused(path, left="/odd")
    assert "one topic" in refused(path, left="/rear/left/image_rect", right="/rear/left/image_rect")
    swapped = refused(path, left="/rear/right/image_rect", right="/rear/left/image_rect")
    assert "baseline_m is -0.12" in swapped and "left and right swapped?" in swapped


def test_several_poses_are_listed_and_chosen(tmp_path):
    messages = Messages("sqlite3")
    goal = [Sent("/move_base/goal", 1, messages.pose_stamped(1, np.eye(4)))]
    sent = images(messages) + camera_poses(messages) + camera_poses(messages, "/slam") + goal
    path = bag(tmp_path, "sqlite3", sent)
    assert "2 topics give poses: /pose (PoseStamped), /slam (PoseStamped)" in refused(path)
    chosen = open_sequence(path, ReadOptions(bag=BagOptions(poses="/slam")))
    assert "poses from /slam" in chosen.notes
    assert "/fix gives no poses in this bag" in refused(path, poses="/fix")


def test_what_is_missing_is_named(tmp_path):
    messages = Messages("ros1")
    whole = images(messages)
    left_only = without(whole, "right/camera_info") + camera_poses(messages)
    for name, sent, text in (
        ("a.bag", whole, "the bag has no poses"),
        ("b.bag", camera_poses(messages), "no image topic; the bag has /pose (PoseStamped)"),
        ("c.bag", left_only, "no CameraInfo for /stereo/right/image_rect"),
        ("d.bag", without(whole, "right/image_rect") + camera_poses(messages), "no two image topics whose names"),
    ):
        path = messages.write(tmp_path / name, sorted(sent, key=lambda message: message.time_ns))
        assert text in refused(path)
    info = {"left_info": "/stereo/left/camera_info", "right_info": "/stereo/left/camera_info"}
    assert "no baseline" in refused(tmp_path / "c.bag", **info)
    (tmp_path / "poses.tum").write_text("".join(f"{scenes.timestamp_s(i)} {i} 0 0 0 0 0 1\n" for i in range(FRAMES)))
    assert len(open_sequence(tmp_path / "a.bag", ReadOptions(poses=tmp_path / "poses.tum")).frames) == FRAMES


def test_cameras_that_are_not_triggered_together_are_told(tmp_path):
    messages = Messages("mcap")
    path = bag(tmp_path, "mcap", images(messages, shift_ns=40_000_000) + camera_poses(messages))
    text = refused(path)
    assert "no images of /stereo/left/image_rect and /stereo/right/image_rect lie within 5 ms" in text
    assert "the nearest two are 40.0 ms apart" in text and "--bag.max-pair-gap-s" in text
    loose = open_sequence(path, ReadOptions(bag=BagOptions(max_pair_gap_s=0.05)))
    assert len(loose.frames) == FRAMES


def test_images_of_several_sizes_are_told(tmp_path):
    messages = Messages("ros1")
    sent = images(messages) + camera_poses(messages)
    small_ns = time_ns(0) - 10_000_000
    for side in ("left", "right"):
        image = messages.image(small_ns, np.zeros((6, 8), np.uint8), "mono8")
        sent.append(Sent(f"/stereo/{side}/image_rect", small_ns, image))
    sequence = open_sequence(bag(tmp_path, "ros1", sent), ReadOptions(max_pose_gap_s=1))
    assert "left images of several sizes: 3 of 160x120 px, 1 of 8x6 px" in " ".join(sequence.notes)


def test_messages_without_a_time_take_that_of_the_recording(tmp_path):
    messages = Messages("mcap")
    sent = []
    for message in images(messages) + camera_poses(messages):
        message.value.header.stamp.sec = message.value.header.stamp.nanosec = 0
        sent.append(message)
    sequence = open_sequence(bag(tmp_path, "mcap", sent), ReadOptions(max_pose_gap_s=1))
    assert "3 messages of /stereo/left/image_rect have no time in their header" in " ".join(sequence.notes)


def test_a_frame_with_two_parents_is_told(tmp_path):
    messages = Messages("ros1")
    edges = ("odom", "cam_optical", np.eye(4)), ("map", "cam_optical", np.eye(4))
    sent = [Sent("/tf", time_ns(index), messages.tf(time_ns(index), *edges)) for index in range(2)]
    assert "frame cam_optical has two parents, map and odom" in refused(bag(tmp_path, "ros1", images(messages) + sent))


def topics(*names: str) -> dict[str, Topic]:
    return {name: Topic(COMPRESSED if name.endswith("compressed") else IMAGE, 1) for name in names}


def both(pattern: str, left: str, right: str) -> tuple[tuple[str, str], str, str]:
    pair = pattern.format(left), pattern.format(right)
    return pair, *pair


@pytest.mark.parametrize(
    ("names", "left", "right"),
    [
        both("/cam{}/image_raw", "0", "1"),
        both("/camera{}/image", "1", "2"),
        both("/d/infra{}/image_rect_raw", "1", "2"),
        both("/zed/{}/image_rect_color", "left", "right"),
        both("/{}/image_raw/compressed", "left", "right"),
        both("/{}_camera/image", "LEFT", "RIGHT"),
        (("/stereo_left", "/stereo_right", "/depth_left", "/depth_right"), "/stereo_left", "/stereo_right"),
        # Of one camera: rectified before raw, colour before grey, Image before CompressedImage.
        (
            tuple(
                f"/s/{side}/image_{kind}"
                for side in ("left", "right")
                for kind in ("raw", "rect", "rect_color", "rect_color/compressed")
            ),
            "/s/left/image_rect_color",
            "/s/right/image_rect_color",
        ),
    ],
)
def test_pairs_are_found_by_their_names(names, left, right):
    pair, _ = choose_pair(topics(*names), BagOptions(), Path("log.bag"))
    assert pair == (left, right)


@pytest.mark.parametrize(
    "names",
    [
        ("/cam/front", "/cam/back"),
        ("/image_0", "/image_1", "/image_2", "/image_3"),
        ("/cam1/image", "/cam2/image", "/cam3/image", "/cam4/image"),
    ],
)
def test_pairs_in_doubt_are_not_guessed(names):
    with pytest.raises(JaxmapError, match=r"--bag\.left TOPIC"):
        choose_pair(topics(*names), BagOptions(), Path("log.bag"))


def test_names_tell_whether_images_are_rectified():
    names = ("/a/image_rect", "/a/image_rect_color", "/a/rectified/left", "/a/image_raw", "/a/image_color", "/a/left")
    assert [is_rectified_name(name) for name in names] == [True, True, True, False, False, None]
