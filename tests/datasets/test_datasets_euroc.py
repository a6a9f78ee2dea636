"""The EuRoC reader, on a small made recording and on real images."""

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.datasets.pose_axes import T_Z_UP_SOURCE
from jaxmap.datasets.poses import write_tum
from jaxmap.errors import JaxmapError
from jaxmap.stereo.rectify import StereoRig, make_rectifier

REALDATA = Path(os.environ.get("JAXMAP_REALDATA", Path(__file__).parents[2] / ".." / "shared" / "realdata"))
needs_realdata = pytest.mark.skipif(not REALDATA.is_dir(), reason="the folder of real data is absent")

START_NS = 1403715273262142976
STEP_NS = 50_000_000

SENSOR = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, {x},
         0.0, 0.0, 1.0, 0.2,
         0.0, -1.0, 0.0, 0.3,
         0.0, 0.0, 0.0, 1.0]
resolution: [32, 24]
camera_model: pinhole
intrinsics: [30.0, 30.0, 15.5, 11.5] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.1, 0.01, 0.0, 0.0]
"""


def made_recording(root: Path, right_shift_ns=1_000_000, right_count=4, ground_truth=True) -> Path:
    folder = root / "MH_00"
    for camera, count, shift_ns, x in (("cam0", 4, 0, 0.1), ("cam1", right_count, right_shift_ns, 0.21)):
        data = folder / "mav0" / camera / "data"
        data.mkdir(parents=True)
        rows = ["#timestamp [ns],filename"]
        for index in range(count):
            time_ns = START_NS + index * STEP_NS + shift_ns
            Image.fromarray(np.zeros((24, 32), np.uint8)).save(data / f"{time_ns}.png")
            rows.append(f"{time_ns},{time_ns}.png")
        (data.parent / "data.csv").write_text("\r\n".join(rows) + "\r\n")
        (data.parent / "sensor.yaml").write_text(SENSOR.format(x=x))
    if ground_truth:
        (folder / "mav0" / "state_groundtruth_estimate0").mkdir()
        rows = [f"{START_NS + i * STEP_NS},{float(i)},0,0,1,0,0,0,0,0,0" for i in range(4)]
        (folder / "mav0" / "state_groundtruth_estimate0" / "data.csv").write_text("#timestamp\n" + "\n".join(rows))
    return folder


def refused(folder: Path, options=None) -> str:
    with pytest.raises(JaxmapError) as caught:
        open_sequence(folder, options)
    assert "\n" not in str(caught.value)
    return str(caught.value).replace(str(folder), "REC")


def test_a_recording_opens_with_poses_of_its_left_camera(tmp_path):
    sequence = open_sequence(made_recording(tmp_path))
    assert (sequence.name, sequence.dataset, len(sequence.frames)) == ("MH_00", "euroc", 4)
    assert isinstance(sequence.camera, StereoRig)
    np.testing.assert_allclose(sequence.camera.t_right_left_m, [-0.11, 0, 0], atol=1e-12)
    np.testing.assert_allclose(sequence.T_world_camera[:, :3, 3], [[i + 0.1, 0.2, 0.3] for i in range(4)])
    np.testing.assert_array_equal(sequence.T_world_camera[0, :3, :3], T_Z_UP_SOURCE["camera"][:3, :3])
    assert sequence.frames[0].name == str(START_NS)
    assert sequence.frames[0].timestamp_s == START_NS / 1e9
    assert sequence.frames[0].right.name == f"{START_NS + 1_000_000}.png"
    assert sequence.notes == ()


def test_given_camera_poses_are_taken_as_they_are_and_given_body_poses_are_moved(tmp_path):
    folder = made_recording(tmp_path, ground_truth=False)
    times_s = np.array([(START_NS + i * STEP_NS) / 1e9 for i in range(4)])
    write_tum(tmp_path / "camera.tum", times_s, np.tile(T_Z_UP_SOURCE["camera"], (4, 1, 1)))
    sequence = open_sequence(folder, ReadOptions(poses=tmp_path / "camera.tum"))
    np.testing.assert_allclose(sequence.T_world_camera, np.tile(T_Z_UP_SOURCE["camera"], (4, 1, 1)), atol=1e-12)
    (tmp_path / "body.csv").write_text(f"{START_NS},5,0,0,1,0,0,0\n")
    sequence = open_sequence(folder, ReadOptions(poses=tmp_path / "body.csv"))
    np.testing.assert_allclose(sequence.T_world_camera[:, :3, 3], [[5.1, 0.2, 0.3]])
    assert sequence.notes[0].startswith("3 of 4 frames have no pose and are left out: the frames span ")


def test_images_without_a_partner_are_dropped_and_noted(tmp_path):
    sequence = open_sequence(made_recording(tmp_path, right_count=3))
    assert len(sequence.frames) == 3
    assert sequence.notes == ("1 images have no partner within 5 ms and are left out",)
    folder = made_recording(tmp_path / "late", right_shift_ns=6_000_000)
    assert refused(folder).startswith("no left and right images lie within 5 ms of each other in REC/mav0; check")


def test_missing_ground_truth_is_reported(tmp_path):
    assert refused(made_recording(tmp_path, ground_truth=False)) == (
        "the sequence has no poses: there is no file REC/mav0/state_groundtruth_estimate0/data.csv; give them with "
        "--poses FILE (TUM text, T_world_camera of the left camera), or estimate them from the images: --poses odometry"
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("intrinsics", "intrinsic", "keys are missing: intrinsics in REC/mav0/cam0/sensor.yaml; restore the file"),
        (
            "radial-tangential",
            "equidistant",
            "the camera model is pinhole with equidistant distortion in REC/mav0/cam0",
        ),
        ("pinhole", "omni", "the camera model is omni with radial-tangential distortion in REC/mav0/cam0/sensor.yaml"),
        ("data: [1.0,", "data: [", "T_BS.data is not a list of 16 numbers in REC/mav0/cam0/sensor.yaml"),
        ("data: [1.0,", "data: [2.0,", "T_BS is not a rigid transform in REC/mav0/cam0/sensor.yaml"),
        ("[32, 24]", "[33, 24]", "the cameras differ in resolution in REC/mav0"),
        ("[32, 24]", "[.nan, 24]", "resolution is [nan, 24] in REC/mav0/cam0/sensor.yaml; give [width, height]"),
        ("[-0.1, 0.01, 0.0, 0.0]", "[0.1, 0.01]", "distortion_left has 2 coefficients in REC/mav0"),
        ("[-0.1, 0.01, 0.0, 0.0]", "[-0.1, 0.01", "malformed YAML"),
    ],
)
def test_faulty_sensor_files_are_reported(tmp_path, old, new, message):
    folder = made_recording(tmp_path)
    path = folder / "mav0" / "cam0" / "sensor.yaml"
    path.write_text(path.read_text().replace(old, new))
    assert message in refused(folder)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("", "no images are listed in REC/mav0/cam1/data.csv; restore the file"),
        ("5,a.png\n5,b.png\n", "timestamps go back or repeat in REC/mav0/cam1/data.csv line 2; sort the file by time"),
        ("5\n", "not a time and a file name in REC/mav0/cam1/data.csv line 1; restore the file"),
        ("5,\n", "not a time and a file name in REC/mav0/cam1/data.csv line 1; restore the file"),
        ("5.5,a.png\n", "'5.5' is not a time in whole nanoseconds in REC/mav0/cam1/data.csv line 1; correct the line"),
        ("-5,a.png\n", "'-5' is not a time in whole nanoseconds"),
    ],
)
def test_faulty_image_lists_are_reported_by_line(tmp_path, rows, message):
    folder = made_recording(tmp_path)
    (folder / "mav0" / "cam1" / "data.csv").write_text(rows)
    assert message in refused(folder)


def test_images_of_another_size_are_reported(tmp_path):
    folder = made_recording(tmp_path)
    for camera in ("cam0", "cam1"):
        path = folder / "mav0" / camera / "sensor.yaml"
        path.write_text(path.read_text().replace("[32, 24]", "[752, 480]"))
    assert "images are 32x24 px, the calibration is for 752x480 px in REC" in refused(folder)


@pytest.mark.realdata
@needs_realdata
def test_the_real_recording_needs_poses_and_rectifies_with_them(tmp_path):
    folder = REALDATA / "euroc_micro"
    assert "give them with --poses FILE" in refused(folder)
    names = sorted(file.stem for file in (folder / "mav0" / "cam0" / "data").iterdir())
    times_s = np.array([int(name) / 1e9 for name in names])
    write_tum(tmp_path / "made.tum", times_s, np.tile(T_Z_UP_SOURCE["camera"], (12, 1, 1)))
    sequence = open_sequence(folder, ReadOptions(poses=tmp_path / "made.tum"))
    assert [frame.name for frame in sequence.frames] == names
    camera = make_rectifier(sequence.camera).camera
    assert float(camera.fx_px) == pytest.approx(436.24, abs=0.01)
    assert float(camera.baseline_m) == pytest.approx(0.11008, abs=1e-5)
    pair = sequence.read_pair(sequence.frames[0])
    assert pair.left.shape == pair.right.shape == (480, 752)
