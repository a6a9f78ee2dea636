"""The reader of ROS bags, on bags of the scene of tests/scenes.py."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import scenes
import zarr
from bags import FRAMES, KINDS, Messages, Sent, bag, camera_poses, images, time_ns, whole_bag
from fixtures import cli, map_words  # noqa: F401
from rigs import RIG
from scipy.spatial.transform import Rotation

from jaxmap.datasets import ReadOptions, StereoSequence, open_sequence, rosbag
from jaxmap.datasets.bag_files import Bag
from jaxmap.datasets.bag_frames import T_LINK_OPTICAL
from jaxmap.datasets.bag_images import decode_image
from jaxmap.datasets.bag_log import read_log
from jaxmap.datasets.crs import to_utm
from jaxmap.datasets.options import BagOptions
from jaxmap.datasets.poses import write_tum
from jaxmap.datasets.stamped_poses import make_track
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.stereo.rectify import StereoRig
from jaxmap.types import StereoCamera


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


@pytest.mark.parametrize("compressed", [False, True])
def test_a_bag_gives_what_the_bundled_traverse_gives(tmp_path, compressed):
    """Raw colour images, a camera askew and poses in UTM; the rotation between the cameras goes through R and P."""
    whole = open_sequence("sample:traverse")
    T = whole.T_world_camera[:2].copy()
    T[:, :3, 3] += whole.site_origin
    write_tum(tmp_path / "poses.tum", np.array([frame.timestamp_s for frame in whole.frames[:2]]), T)
    expected = open_sequence("sample:traverse", ReadOptions(poses=tmp_path / "poses.tum"))
    messages, rig = Messages("mcap"), expected.camera
    assert isinstance(rig, StereoRig)
    sent = rig_infos(messages, rig)
    for frame, pose in zip(expected.frames, T, strict=True):
        at_ns = round(frame.timestamp_s * 1e9)
        for side, path, pixels in zip("lr", (frame.left, frame.right), expected.read_pair(frame), strict=True):
            image = messages.image(at_ns, pixels, "rgb8")
            jpeg = messages.compressed(at_ns, path.read_bytes(), "rgb8; jpeg compressed bgr8")
            sent.append(
                Sent(f"/{side}/image_raw{'/compressed' if compressed else ''}", at_ns, jpeg if compressed else image)
            )
        sent.append(Sent("/pose", at_ns, messages.pose_stamped(at_ns, pose)))
    found = open_sequence(bag(tmp_path, "mcap", sent))
    np.testing.assert_array_equal(found.T_world_camera, expected.T_world_camera)
    np.testing.assert_array_equal(found.site_origin, expected.site_origin)
    assert_rig(found, rig)
    for frame, other in zip(found.frames, expected.frames, strict=True):
        for image, true_image in zip(found.read_pair(frame), expected.read_pair(other), strict=True):
            np.testing.assert_array_equal(image, true_image)


def rig_infos(messages: Messages, rig: StereoRig) -> list[Sent]:
    """R and P are those of OpenCV's rectification, as ROS's calibrator writes them."""
    size, t = (rig.width_px, rig.height_px), rig.t_right_left_m.reshape(3, 1)
    R_left, R_right, P_left, P_right, *_ = cv2.stereoRectify(
        rig.K_left, rig.distortion_left, rig.K_right, rig.distortion_right, size, rig.R_right_left, t
    )
    left = messages.info(size, rig.K_left, rig.distortion_left, R_left, P_left)
    right = messages.info(size, rig.K_right, rig.distortion_right, R_right, P_right)
    return [Sent("/l/camera_info", 0, left), Sent("/r/camera_info", 0, right)]


def assert_rig(sequence: StereoSequence, rig: StereoRig) -> None:
    found = sequence.camera
    assert isinstance(found, StereoRig)
    for name in ("K_left", "K_right", "distortion_left", "distortion_right"):
        np.testing.assert_array_equal(getattr(found, name), getattr(rig, name))
    np.testing.assert_allclose(found.R_right_left, rig.R_right_left, atol=1e-12)
    np.testing.assert_allclose(found.t_right_left_m, rig.t_right_left_m, atol=1e-12)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_raw_images_come_with_the_rig_of_their_camera_infos(tmp_path, kind):
    messages = Messages(kind)
    picture = messages.image(time_ns(0), np.zeros((RIG.height_px, RIG.width_px), np.uint8), "mono8")
    sent = [*camera_poses(messages), *rig_infos(messages, RIG)]
    sent += [Sent(f"/{side}/image_raw", time_ns(0), picture) for side in "lr"]
    sequence = open_sequence(bag(tmp_path, kind, sent))
    assert_rig(sequence, RIG)
    assert "images are taken for raw, by the topic's name" in sequence.notes


def mosaic(colours: np.ndarray, pattern: str) -> np.ndarray:
    """What a sensor behind a Bayer filter sees; the pattern names the colours of the first two rows."""
    seen = np.empty(colours.shape[:2], colours.dtype)
    for place, colour in enumerate(pattern):
        row, column = divmod(place, 2)
        seen[row::2, column::2] = colours[row::2, column::2, "rgb".index(colour)]
    return seen


RGB = np.broadcast_to(np.array([200, 120, 40], np.uint8), (6, 8, 3))
GREY = np.arange(48, dtype=np.uint8).reshape(6, 8)


@pytest.mark.parametrize(
    ("encoding", "sent", "expected"),
    [
        ("mono8", GREY, GREY),
        ("8UC1", GREY, GREY),
        ("rgb8", RGB, RGB),
        ("bgr8", RGB[..., ::-1], RGB),
        ("rgba8", np.dstack([RGB, GREY]), RGB),
        ("bgra8", np.dstack([RGB[..., ::-1], GREY]), RGB),
        ("mono16", GREY.astype("<u2") * 80, GREY.astype(np.uint16) * 80),
        ("rgb16", RGB.astype("<u2") * 16, RGB.astype(np.uint16) * 16),
        *((f"bayer_{name}8", mosaic(RGB, name), RGB) for name in ("rggb", "bggr", "gbrg", "grbg")),
        ("bayer_grbg16", mosaic(RGB.astype(np.uint16) * 16, "grbg"), RGB.astype(np.uint16) * 16),
    ],
)
@pytest.mark.parametrize("padding", [0, 5])
def test_every_encoding_gives_its_pixels(encoding, sent, expected, padding):
    found = decode_image(Messages("mcap").image(0, sent, encoding, padding=padding), "here")
    assert found.dtype == expected.dtype
    np.testing.assert_array_equal(found, expected)


def test_compressed_images_are_decoded():
    messages = Messages("mcap")
    for pixels, expected in ((GREY, GREY), (RGB[..., ::-1], RGB)):
        data = cv2.imencode(".png", pixels)[1].tobytes()
        np.testing.assert_array_equal(decode_image(messages.compressed(0, data, "png"), "here"), expected)
    packed = cv2.imencode(".png", mosaic(RGB, "gbrg"))[1].tobytes()
    np.testing.assert_array_equal(decode_image(messages.compressed(0, packed, "bayer_gbrg8; png"), "here"), RGB)
    jpeg = cv2.imencode(".jpg", np.ascontiguousarray(RGB[..., ::-1]))[1].tobytes()
    assert np.abs(decode_image(messages.compressed(0, jpeg), "here").astype(int) - RGB).max() < 6


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (Messages("mcap").image(0, GREY.astype(np.float32), "32FC1"), "encoding '32FC1'"),
        (Messages("mcap").image(0, GREY, "rgb8"), "48 bytes are no image of 8x6 px"),
        (Messages("mcap").compressed(0, cv2.imencode(".jpg", GREY)[1].tobytes()[:-40]), "cut off"),
        (Messages("mcap").compressed(0, b"h264", "h264"), "format 'h264'"),
    ],
)
def test_what_is_no_image_is_refused(message, text):
    with pytest.raises(FrameError, match=text):
        decode_image(message, "here")


def test_images_are_decoded_one_at_a_time(tmp_path, monkeypatch):
    sequence = open_sequence(whole_bag(tmp_path))
    decoded = []
    monkeypatch.setattr(rosbag, "decode_image", lambda message, where: decoded.append(where) or GREY)
    sequence.read_pair(sequence.frames[1])
    assert len(decoded) == 2


BODY = np.array([[1.0, 0, 0, 0.3], [0, 1, 0, 0.1], [0, 0, 1, 0.5], [0, 0, 0, 1]])
"""The camera's link in the vehicle."""


def body_pose(index: int) -> np.ndarray:
    """T_world_body so that a camera in its link is where the scene's camera is."""
    return scenes.pose(index) @ np.linalg.inv(T_LINK_OPTICAL) @ np.linalg.inv(BODY)


def body_tf(messages: Messages, link: str = "cam_link") -> list[Sent]:
    edges = [("base", link, BODY), (link, "cam_optical", T_LINK_OPTICAL)]
    return [Sent("/tf_static", 1, messages.tf(0, *edges[: 1 if link == "cam_optical" else 2]))]


def moving_tf(messages: Messages) -> list[Sent]:
    """The world and the vehicle, half a step before each frame and after it: poses are between."""
    sent = []
    for index in range(2 * FRAMES + 1):
        at_ns = time_ns(0) + (index - 1) * round(scenes.FRAME_STEP_S * 5e8)
        sent.append(Sent("/tf", at_ns, messages.tf(at_ns, ("odom", "base", body_pose((index - 1) / 2)))))
    return sent


@pytest.mark.parametrize("kind", ["ros1", "sqlite3"])
def test_poses_of_the_body_come_to_the_camera_by_tf(tmp_path, kind):
    messages = Messages(kind)
    truth = np.stack([scenes.pose(index) for index in range(FRAMES)])
    odometry = [
        Sent("/odom", time_ns(index), messages.odometry(time_ns(index), body_pose(index), "base"))
        for index in range(FRAMES)
    ]
    stamped = [
        Sent("/ekf", time_ns(index), messages.pose_stamped(time_ns(index), body_pose(index))) for index in range(FRAMES)
    ]
    unnamed = [Sent("/tf_static", 1, messages.tf(0, ("base", "base/cam", BODY @ T_LINK_OPTICAL)))]
    for name, poses, frame, tree in (
        ("odometry", odometry, "cam_optical", body_tf(messages)),
        ("stamped", stamped, "cam_optical", body_tf(messages)),
        ("tf", moving_tf(messages), "cam_optical", body_tf(messages)),
        ("images in the link", odometry, "cam_link", body_tf(messages)),
        (
            "optical without its name",
            odometry,
            "/base/cam",
            unnamed,
        ),
    ):
        folder = tmp_path / name
        folder.mkdir()
        sequence = open_sequence(bag(folder, kind, images(messages, frame=frame) + poses + tree))
        np.testing.assert_allclose(sequence.T_world_camera, truth, atol=1e-9, err_msg=name)
        assert ("link" in " ".join(sequence.notes)) == (name == "images in the link")
    bare = tmp_path / "bare"
    bare.mkdir()
    sequence = open_sequence(bag(bare, kind, images(messages) + odometry))
    np.testing.assert_allclose(sequence.T_world_camera[:, :3, :3], truth[:, :3, :3], atol=1e-9)
    assert "tf does not say where the camera is" in " ".join(sequence.notes)


def test_conventions_that_are_asked_for_are_those_of_the_messages(tmp_path):
    messages = Messages("ros1")
    truth = np.stack([scenes.pose(index) for index in range(FRAMES)])
    sent = images(messages)
    for index, T in enumerate(truth @ T_LINK_OPTICAL.T):
        T[:3, 3] *= 1000
        sent.append(Sent("/odom", time_ns(index), messages.odometry(time_ns(index), T, "cam_optical")))
    options = ReadOptions(pose_convention="body", poses_unit="mm")
    sequence = open_sequence(bag(tmp_path, "ros1", sent), options)
    np.testing.assert_allclose(sequence.T_world_camera, truth, atol=1e-9)
    assert "body axes at the camera's place, as asked" in sequence.notes


def test_a_camera_that_turns_on_the_body_is_followed(tmp_path):
    messages = Messages("ros1")
    sent = images(messages)
    truth = []
    for index in range(FRAMES):
        mast = np.eye(4)
        mast[:3, :3] = Rotation.from_euler("z", 0.1 * index).as_matrix()
        sent += [
            Sent("/odom", time_ns(index), messages.odometry(time_ns(index), body_pose(index), "base")),
            Sent("/tf", time_ns(index), messages.tf(time_ns(index), ("base", "mast", mast))),
        ]
        truth.append(body_pose(index) @ mast @ T_LINK_OPTICAL)
    sent.append(Sent("/tf_static", 1, messages.tf(0, ("mast", "cam_optical", T_LINK_OPTICAL))))
    sequence = open_sequence(bag(tmp_path, "ros1", sent))
    np.testing.assert_allclose(sequence.T_world_camera, truth, atol=1e-9)


def test_a_path_is_read_at_its_last_message(tmp_path):
    messages = Messages("sqlite3")
    poses = [messages.pose_stamped(time_ns(index), scenes.pose(index)) for index in range(FRAMES)]
    sent = [
        Sent("/slam/path", time_ns(count), messages.make("nav_msgs/Path", messages.header(1), poses[:count]))
        for count in (1, 2, FRAMES)
    ]
    sequence = open_sequence(bag(tmp_path, "sqlite3", images(messages) + sent))
    np.testing.assert_allclose(sequence.T_world_camera, [scenes.pose(index) for index in range(FRAMES)], atol=1e-12)


SITE = (4.43, 52.24)
"""Longitude and latitude, 1.4 degrees from the meridian of its UTM zone: north of the grid is 1.1 degrees off."""


def gps_messages(messages: Messages, frame: str = "antenna") -> list[Sent]:
    """Fixes of a drive to true north, 20 m a frame."""
    return [
        Sent("/fix", time_ns(index), messages.fix(time_ns(index), SITE[1] + 20 * index / 111_270, SITE[0], 3.0, frame))
        for index in range(FRAMES)
    ]


def test_fixes_and_an_imu_give_poses_in_utm(tmp_path):
    messages = Messages("ros1")
    ahead = Rotation.from_euler("z", 90, degrees=True).as_matrix()  # x forward to the north
    lever = np.eye(4)
    lever[:3, 3] = [0.5, 0, 1.0]
    sent = images(messages) + gps_messages(messages)
    sent += [Sent("/imu", time_ns(index), messages.imu(time_ns(index), ahead, "imu")) for index in range(FRAMES)]
    sent.append(
        Sent("/tf_static", 1, messages.tf(0, ("imu", "antenna", lever), ("imu", "cam_optical", T_LINK_OPTICAL)))
    )
    sequence = open_sequence(bag(tmp_path, "ros1", sent))
    assert sequence.crs == "EPSG:32631"
    step = np.diff(sequence.T_world_camera[:, :3, 3], axis=0)
    np.testing.assert_allclose(np.linalg.norm(step, axis=1), 20, rtol=2e-3)
    # The camera looks along the drive, in the axes of the grid.
    forward = sequence.T_world_camera[:-1, :3, 2]
    np.testing.assert_allclose(forward, step / 20, atol=3e-3)
    assert abs(step[0, 0]) > 0.1
    east, north = to_utm("EPSG:32631", np.array([SITE[0]]), np.array([SITE[1]]))
    place = sequence.T_world_camera[0, :3, 3] + sequence.site_origin
    np.testing.assert_allclose(place, np.array([east[0], north[0], 3.0]) - 0.5 * forward[0] - [0, 0, 1.0], atol=1e-2)


def test_local_poses_are_moved_onto_fixes(tmp_path):
    messages = Messages("ros1")
    sent = images(messages) + gps_messages(messages, "cam_optical")
    for index in range(FRAMES):
        T = scenes.pose(index)
        T[:3, 3] = [100 + 20 * index, -7, 1]  # the local world's x is the drive's north
        T[:3, :3] = Rotation.from_euler("z", -90, degrees=True).as_matrix() @ T[:3, :3]
        sent.append(Sent("/odom", time_ns(index), messages.odometry(time_ns(index), T, "cam_optical")))
    path = bag(tmp_path, "ros1", sent)
    assert open_sequence(path).crs is None
    sequence = open_sequence(path, ReadOptions(bag=BagOptions(gps="/fix")))
    assert sequence.crs == "EPSG:32631"
    east, north = to_utm("EPSG:32631", np.full(FRAMES, SITE[0]), SITE[1] + 20 * np.arange(FRAMES) / 111_270)
    place = sequence.T_world_camera[:, :3, 3] + sequence.site_origin
    np.testing.assert_allclose(place, np.column_stack([east, north, np.full(FRAMES, 3.0)]), atol=0.05)
    assert "onto 3 fixes of /fix" in " ".join(sequence.notes)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_gives_the_map_of_its_folder(tmp_path, kind, cli):
    scenes.write_folder_sequence(tmp_path / "folder", FRAMES)
    maps = []
    for source in (tmp_path / "folder", whole_bag(tmp_path, kind)):
        out = tmp_path / "runs" / source.stem
        # Beside the bag, not in it.
        assert cli(*map_words(source, out)).status == 0
        maps.append(np.asarray(zarr.open_group(out / "map.zarr", mode="r")["log_odds"]))
    np.testing.assert_array_equal(*maps)


REALDATA = Path(os.environ.get("JAXMAP_REALDATA", Path(__file__).parents[2] / ".." / "shared" / "realdata"))
needs_realdata = pytest.mark.skipif(not REALDATA.is_dir(), reason="the folder of real data is absent")


@pytest.mark.realdata
@needs_realdata
@pytest.mark.parametrize(
    ("name", "topics"),
    [
        ("ROS_example.bag", "ORB-SLAM (PoseStamped), S-PTAM (PoseStamped), groundtruth (PoseStamped)"),
        ("tf_example.bag", "/tf (TFMessage), /tf_static (TFMessage)"),
        ("tf_example", "/tf (TFMessage), /tf_static (TFMessage)"),
        ("nav2_turtlebot.mcap", "/amcl_pose (PoseWithCovarianceStamped), /odom (Odometry)"),
    ],
)
def test_real_bags_without_images_are_told_from_those_with(name, topics):
    with pytest.raises(JaxmapError) as caught:
        open_sequence(REALDATA / "pose_formats" / name)
    assert f"no image topic; the bag has {topics}" in str(caught.value)


@pytest.mark.realdata
@needs_realdata
def test_real_tf_is_the_odometry_of_the_same_robot():
    """The tree of a recorded robot gives the positions that its odometry topic says."""
    real = Bag(REALDATA / "pose_formats" / "nav2_turtlebot.mcap")
    log = read_log(real, {"/odom"})
    track, _ = make_track(log.poses["/odom"], "/odom")
    assert log.children["/odom"] == {"base_link"} and log.tree.chain("base_link")[-1] == "map"
    T, known = log.tree.lookup("odom", "base_link", track.timestamps_s, 1.0)
    assert known.mean() > 0.9
    np.testing.assert_allclose(T[known], track.T[known], atol=1e-6)
