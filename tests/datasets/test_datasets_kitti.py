"""The KITTI odometry reader, on a small made sequence and on the real one."""

import os
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.datasets.poses import write_tum
from jaxmap.errors import JaxmapError, UsageError

REALDATA = Path(os.environ.get("JAXMAP_REALDATA", Path(__file__).parents[2] / ".." / "shared" / "realdata"))
needs_realdata = pytest.mark.skipif(not REALDATA.is_dir(), reason="the folder of real data is absent")

CALIB = """P0: 8 0 4 0 0 8 2 0 0 0 1 0
P1: 8 0 4 -4 0 8 2 0 0 0 1 0
P2: 8 0 4 0.8 0 8 2 0 0 0 1 0
P3: 8 0 4 -3.2 0 8 2 0 0 0 1 0
Tr: 1 0 0 0 0 1 0 0 0 0 1 0
"""


def made_sequence(root: Path, cameras=(0, 1), count=4) -> Path:
    folder = root / "sequences" / "07"
    for camera in cameras:
        (folder / f"image_{camera}").mkdir(parents=True)
        for index in range(count):
            Image.fromarray(np.zeros((6, 9), np.uint8)).save(folder / f"image_{camera}" / f"{index:06d}.png")
    (folder / "calib.txt").write_text(CALIB)
    (folder / "times.txt").write_text("".join(f"{index / 10:e}\n" for index in range(count)))
    (root / "poses").mkdir()
    write_own_poses(root, count)
    return folder


def write_own_poses(root: Path, count: int) -> None:
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 2, 3] = np.arange(count)
    np.savetxt(root / "poses" / "07.txt", T[:, :3].reshape(count, 12))


def refused(folder: Path, options=None) -> str:
    with pytest.raises(JaxmapError) as caught:
        open_sequence(folder, options)
    assert "\n" not in str(caught.value)
    return str(caught.value).replace(str(folder), "SEQ").replace(str(folder.parents[1]), "ROOT")


def test_the_grey_pair_opens_and_moves_north(tmp_path):
    sequence = open_sequence(made_sequence(tmp_path))
    assert (sequence.name, sequence.dataset, len(sequence.frames)) == ("kitti_07", "kitti", 4)
    assert float(sequence.camera.baseline_m) == 0.5
    np.testing.assert_allclose(sequence.T_world_camera[:, :3, 3], np.arange(4)[:, None] * [0.0, 1.0, 0.0])
    assert sequence.frames[2].right.parts[-2:] == ("image_1", "000002.png")
    assert sequence.frames[2].timestamp_s == 0.2


def test_the_colour_pair_is_taken_without_the_grey_one_and_its_poses_are_moved(tmp_path):
    sequence = open_sequence(made_sequence(tmp_path, cameras=(2, 3)))
    assert float(sequence.camera.baseline_m) == pytest.approx(0.5)
    # Camera 2 sits 0.1 m to the left of camera 0.
    np.testing.assert_allclose(sequence.T_world_camera[0, :3, 3], [-0.1, 0, 0], atol=1e-12)
    write_tum(tmp_path / "left.tum", np.arange(4) / 10, np.tile(np.eye(4), (4, 1, 1)))
    given = open_sequence(tmp_path / "sequences" / "07", ReadOptions(poses=tmp_path / "left.tum"))
    np.testing.assert_array_equal(given.T_world_camera[0, :3, 3], [0, 0, 0])


def test_with_both_pairs_the_grey_one_is_taken_and_told_and_the_other_can_be_chosen(tmp_path):
    folder = made_sequence(tmp_path, cameras=(0, 1, 2, 3))
    grey = open_sequence(folder)
    assert grey.frames[0].left.parts[-2] == "image_0"
    assert any("the grey pair is taken" in note and "--camera color" in note for note in grey.notes)
    chosen = open_sequence(folder, ReadOptions(camera="grey"))
    assert not any("pair" in note for note in chosen.notes)
    np.testing.assert_array_equal(chosen.T_world_camera, grey.T_world_camera)
    colour = open_sequence(folder, ReadOptions(camera="color"))
    assert [path.parts[-2] for path in (colour.frames[0].left, colour.frames[0].right)] == ["image_2", "image_3"]
    # Camera 2 sits 0.1 m to the left of camera 0.
    np.testing.assert_allclose(
        colour.T_world_camera[:, :3, 3] - grey.T_world_camera[:, :3, 3], np.tile([-0.1, 0, 0], (4, 1)), atol=1e-12
    )
    with pytest.raises(UsageError, match=r"kitti has no camera 'pancam' in --camera; choose grey or color"):
        open_sequence(folder, ReadOptions(camera="pancam"))


def test_half_a_pair_is_not_taken_where_the_other_is_whole(tmp_path):
    folder = made_sequence(tmp_path, cameras=(0, 2, 3))
    assert open_sequence(folder).frames[0].left.parts[-2] == "image_2"
    assert "the pair of image_0 has no image_1 in SEQ; restore it" in refused(folder, ReadOptions(camera="grey"))


def test_a_relative_path_finds_the_poses(tmp_path, monkeypatch):
    folder = made_sequence(tmp_path)
    (folder / "other").mkdir()
    monkeypatch.chdir(folder / "other")
    assert open_sequence("..").name == "kitti_07"


def test_part_of_the_images_keep_their_own_poses(tmp_path):
    folder = made_sequence(tmp_path)
    (folder / "image_0" / "000001.png").unlink()
    sequence = open_sequence(folder)
    assert [frame.name for frame in sequence.frames] == ["000000", "000002", "000003"]
    assert sequence.T_world_camera[:, 1, 3].tolist() == [0, 2, 3]
    assert "1 of 4 frames have no left image" in sequence.notes


def test_missing_files_are_reported(tmp_path):
    folder = made_sequence(tmp_path)
    (tmp_path / "poses" / "07.txt").unlink()
    message = refused(folder)
    assert message.startswith("the sequence has no poses: there is no file ROOT/poses/07.txt; give them with --poses")
    (folder / "times.txt").unlink()
    assert refused(folder) == "there is no file SEQ/times.txt; check the path"


def test_counts_that_disagree_are_reported(tmp_path):
    folder = made_sequence(tmp_path)
    write_own_poses(tmp_path, 3)
    assert refused(folder).startswith("3 poses for 4 frames in ROOT/poses/07.txt; poses without times need")
    (folder / "times.txt").write_text("0\n0.1\n")
    assert refused(folder).startswith("000002.png is none of the 2 frames of times.txt in SEQ/image_0; name images")


@pytest.mark.parametrize(
    ("calib", "message"),
    [
        ("", "no line P0 or P1 in SEQ/calib.txt; restore the file"),
        (CALIB.splitlines()[0], "no line P1 in SEQ/calib.txt; restore the file"),
        (CALIB.replace("-4", "x"), "P1 is not twelve numbers in SEQ/calib.txt line 2; restore the file"),
        (CALIB.replace("-4 0 8 2", "-4 0 8"), "P1 is not twelve numbers in SEQ/calib.txt line 2"),
        (CALIB.replace("P0: 8", "P0: -8"), "P0 is not a projection matrix in SEQ/calib.txt line 1; restore the file"),
        (CALIB.replace("P0: 8", "P0: nan"), "P0 is not a projection matrix in SEQ/calib.txt line 1; restore the file"),
        (
            CALIB.replace("P0: 8 0", "P0: 8 1"),
            "P0 is not of a rectified camera in SEQ/calib.txt line 1; restore the file",
        ),
        (CALIB.replace("P1: 8", "P1: 9"), "the two cameras differ in SEQ/calib.txt; give a rectified pair"),
        (CALIB.replace("-4", "4"), "baseline_m is -0.5, it must be positive in SEQ/calib.txt; check the calibration"),
    ],
)
def test_faulty_calibration_is_reported_by_line(tmp_path, calib, message):
    folder = made_sequence(tmp_path)
    (folder / "calib.txt").write_text(calib)
    assert message in refused(folder)


def test_a_given_calibration_goes_first(tmp_path):
    folder = made_sequence(tmp_path)
    path = tmp_path / "camera.yaml"
    camera = {"image_size_px": [9, 6], "fx_px": 7.0, "cx_px": 4, "cy_px": 2.5, "baseline_m": 0.1}
    path.write_text(yaml.safe_dump(camera))
    assert float(open_sequence(folder, ReadOptions(calibration=path)).camera.fx_px) == 7.0
    path.write_text(yaml.safe_dump(camera | {"image_size_px": [9, 7]}))
    assert "images are 9x6 px, the calibration is for 9x7 px" in refused(folder, ReadOptions(calibration=path))


@pytest.mark.realdata
@needs_realdata
def test_the_real_sequence_opens():
    sequence = open_sequence(REALDATA / "kitti_odometry" / "sequences" / "01")
    assert len(sequence.frames) == 51
    assert float(sequence.camera.fx_px) == pytest.approx(707.0912)
    assert float(sequence.camera.baseline_m) == pytest.approx(0.53715, abs=1e-5)
    assert (sequence.camera.width_px, sequence.camera.height_px) == (1226, 370)
    positions = sequence.T_world_camera[:, :3, 3]
    assert positions[-1, 1] > 59
    assert np.abs(positions[:, [0, 2]]).max() < 2
    np.testing.assert_allclose(-sequence.T_world_camera[:, :3, 1], np.tile([0.0, 0, 1], (51, 1)), atol=0.02)
    pair = sequence.read_pair(sequence.frames[50])
    assert pair.left.shape == pair.right.shape == (370, 1226)
