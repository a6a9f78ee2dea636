"""`--poses odometry`: sequences without poses, opened with poses from their images."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import odometry_scenes as scenes
import pytest
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxmap.datasets import ReadOptions, StereoSequence, open_sequence
from jaxmap.datasets.poses import poses_at, read_poses
from jaxmap.datasets.samples import sample_truth
from jaxmap.errors import JaxmapError

COUNT = 6
ODOMETRY = ReadOptions(poses=Path("odometry"))


def write_folder(folder: Path, images: list) -> Path:
    for side, index in (("left", 0), ("right", 1)):
        (folder / side).mkdir(parents=True)
        for frame, pair in enumerate(images):
            Image.fromarray(pair[index]).save(folder / side / f"f{frame}.png")
    camera = {name: value for name, value in scenes.CAMERA._asdict().items() if name != "doffs_px"}
    content = {"image_size_px": [scenes.WIDTH_PX, scenes.HEIGHT_PX], **camera}
    (folder / "camera.yaml").write_text(yaml.safe_dump(content))
    return folder


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("drive"), scenes.pairs(COUNT))


@pytest.fixture(scope="module")
def posed(drive: Path) -> StereoSequence:
    return open_sequence(drive, ODOMETRY)


def refused(folder: Path, options: ReadOptions = ODOMETRY) -> str:
    with pytest.raises(JaxmapError) as caught:
        open_sequence(folder, options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.slow
def test_the_poses_stand_upright_above_the_ground_and_go_north(posed):
    T, truth = posed.T_world_camera, scenes.poses(COUNT)
    assert len(posed.frames) == COUNT
    np.testing.assert_allclose(T[0, :3, 3], [0, 0, scenes.HEIGHT_M], atol=0.03)
    assert abs(T[0, 0, 2]) < 1e-9 and T[0, 1, 2] > 0
    np.testing.assert_allclose(T[-1, :3, 3] - T[0, :3, 3], truth[-1, :3, 3] - truth[0, :3, 3], atol=0.02)
    up = np.einsum("ni,ni->n", T[:, 2, :3], truth[:, 2, :3])
    assert np.degrees(np.arccos(up.clip(-1, 1))).max() < 1.0
    np.testing.assert_array_equal(posed.T_world_source, np.eye(4))


def test_the_notes_say_what_the_poses_are(posed):
    notes = "\n".join(posed.notes)
    assert f"estimated from the images (stereo odometry): {COUNT} of {COUNT} frames tracked over 0.6 m" in notes
    assert "frames numbered 0, 1, 2 ... s, as no times are known" in notes
    assert "up is across the ground" in notes


def test_a_stride_takes_some_of_the_same_poses(drive, posed):
    other = open_sequence(drive, replace(ODOMETRY, stride=2))
    assert [frame.name for frame in other.frames] == ["f0", "f2", "f4"]
    np.testing.assert_array_equal(other.T_world_camera, posed.T_world_camera[::2])


def test_progress_is_told(drive):
    told = []
    open_sequence(drive, replace(ODOMETRY, stop=3), lambda done, total: told.append((done, total)))
    assert told == [(1, 3), (2, 3), (3, 3)]


def test_a_sequence_without_poses_names_the_option(drive):
    assert "or estimate them from the images: --poses odometry" in refused(drive, ReadOptions())


def test_frames_that_cannot_be_used_are_left_out_and_named(tmp_path):
    images = scenes.pairs(COUNT)
    images[2] = (np.zeros_like(images[2][0]),) * 2
    folder = write_folder(tmp_path / "drive", images)
    (folder / "left" / "f4.png").write_bytes(b"no image")
    sequence = open_sequence(folder, ODOMETRY)
    assert [frame.name for frame in sequence.frames] == ["f0", "f1", "f3", "f5"]
    assert "2 frames that match no other are left out (1 cannot be read): f2, f4" in sequence.notes


def test_a_standing_camera_is_refused(tmp_path):
    folder = write_folder(tmp_path / "drive", scenes.pairs(1) * 3)
    message = refused(folder)
    assert "the camera stands still over 3 frames (points move by 0.0 px)" in message
    assert "--poses FILE" in message


def test_too_little_to_see_is_refused(tmp_path):
    black = (np.zeros((scenes.HEIGHT_PX, scenes.WIDTH_PX), np.uint8),) * 2
    assert "0 of 3 frames can be tracked" in refused(write_folder(tmp_path / "drive", [black] * 3))


def test_one_frame_is_refused(drive):
    assert "1 frame shows no motion" in refused(drive, replace(ODOMETRY, stop=1))
    assert "select none" in refused(drive, replace(ODOMETRY, start=9))


def test_a_motion_that_is_lost_is_refused(tmp_path):
    black = (np.zeros((scenes.HEIGHT_PX, scenes.WIDTH_PX), np.uint8),) * 2
    folder = write_folder(tmp_path / "drive", [*scenes.pairs(3), *[black] * 7])
    assert "the motion is lost after frame f2: the 7 frames after it match nothing before" in refused(folder)


def test_a_file_of_that_name_is_a_file(drive, monkeypatch, tmp_path):
    (tmp_path / "odometry").write_text("no pose\n")
    monkeypatch.chdir(tmp_path)
    assert "odometry" in refused(drive) and "images" not in refused(drive)


def drift(sequence: StereoSequence, truth: np.ndarray) -> tuple[float, float, float]:
    """End drift as a share of the path, in attitude in degrees per metre, and the first frame's tilt in degrees."""
    T = np.linalg.inv(sequence.T_world_camera[0]) @ sequence.T_world_camera
    true = np.linalg.inv(truth[0]) @ truth
    path_m = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
    off = np.linalg.inv(true[-1]) @ T[-1]
    tilt = np.arccos(np.clip(sequence.T_world_camera[0, 2, :3] @ truth[0, 2, :3], -1, 1))
    turned = Rotation.from_matrix(off[:3, :3]).magnitude()
    return float(np.linalg.norm(off[:3, 3]) / path_m), float(np.degrees(turned) / path_m), float(np.degrees(tilt))


def truth_at(sequence: StereoSequence, path: Path) -> np.ndarray:
    return poses_at(read_poses(path), np.array([frame.timestamp_s for frame in sequence.frames]), 1.0)[0]


@pytest.mark.slow
def test_the_bundled_traverse_is_followed_and_stands_by_its_inclinometer():
    sequence = open_sequence("sample:traverse", ODOMETRY)
    assert sequence.crs is None and "up is as the inclinometer says" in sequence.notes
    share, _, tilt_deg = drift(sequence, truth_at(sequence, sample_truth() / "poses_utm.tum"))
    assert share < 0.005 and tilt_deg < 0.5


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.parametrize("name", ["traverse_a/Part1", "traverse_b/Part5"])
def test_traverses_of_another_renderer_are_followed(name, realdata):
    folder = realdata.parent / "simdata" / name
    sequence = open_sequence(folder, ODOMETRY)
    share, _, tilt_deg = drift(sequence, truth_at(sequence, folder.parent / "gt" / "poses_utm.tum"))
    assert share < 0.015 and tilt_deg < 0.5


@pytest.mark.slow
@pytest.mark.realdata
def test_a_fast_drive_on_a_road_is_followed(realdata):
    folder = realdata / "kitti_odometry" / "sequences" / "01"
    given = open_sequence(folder)
    found = open_sequence(folder, ODOMETRY)
    assert len(found.frames) == len(given.frames)
    assert drift(found, given.T_world_camera)[0] < 0.02
    # The given attitudes are interpolated before frame 12: they turn evenly there, while the images show the car sway.
    first = 12
    part = replace(found, T_world_camera=found.T_world_camera[first:])
    share, turned_deg_m, _ = drift(part, given.T_world_camera[first:])
    assert share < 0.02 and turned_deg_m < 0.01
