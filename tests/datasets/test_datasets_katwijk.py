"""The Katwijk reader, on made-up parts, and on the data set's own files where they are at hand."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from rover_logs import DRIVES, SITE_UTM_M, START_S, T_IMU_LOCCAM, Drive, drive, time_text, write_part
from scipy.spatial.transform import Rotation

from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.datasets.calibration import read_camera_yaml
from jaxmap.datasets.katwijk import (
    CAMERAS,
    R_BODY_IMU,
    body_to_camera,
    find_parts,
    parse_time,
    read_gps,
    read_imu,
    read_wheels,
)
from jaxmap.datasets.poses import poses_at, read_poses, write_tum
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.evaluation.geometry_scores import pose_errors
from jaxmap.host.files import config_folder
from jaxmap.stereo.rectify import StereoRig, make_rectifier

T_BODY_LOCCAM = np.eye(4)
T_BODY_LOCCAM[:3, :3] = R_BODY_IMU
T_BODY_LOCCAM = T_BODY_LOCCAM @ T_IMU_LOCCAM


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, Drive, np.ndarray]:
    """A part, the drive behind it, and the times of its frames; only to be read."""
    truth = drive(DRIVES["curves"], seed=8)
    folder = tmp_path_factory.mktemp("katwijk") / "Traverse1" / "Part2"
    return folder, truth, write_part(folder, truth, images=6)


@pytest.fixture
def part(made, tmp_path) -> Path:
    """The part, to be damaged."""
    return Path(shutil.copytree(made[0], tmp_path / "Part2"))


def refused(folder: Path, options=None, kind=JaxmapError) -> str:
    with pytest.raises(kind) as caught:
        open_sequence(folder, options)
    assert "\n" not in str(caught.value)
    return str(caught.value).replace(str(folder), "PART")


def rewrite(path: Path, change) -> None:
    path.write_bytes(b"\n".join(change(path.read_bytes().split(b"\n"))))


def test_a_part_opens_with_poses_of_its_own(made):
    folder, truth, frames_s = made
    sequence = open_sequence(folder)
    assert (sequence.name, sequence.dataset, sequence.crs) == ("Traverse1_Part2", "katwijk", "EPSG:32631")
    assert isinstance(sequence.camera, StereoRig)
    assert [frame.timestamp_s for frame in sequence.frames] == pytest.approx(START_S + frames_s, abs=1e-6)
    assert sequence.frames[0].name == f"LocCam_{time_text(frames_s[0])}_0"
    assert sequence.frames[0].right.name == f"LocCam_{time_text(frames_s[0])}_1.png"
    assert sequence.site_origin.dtype == np.float64
    assert np.abs(sequence.site_origin - SITE_UTM_M).max() < 60
    T = sequence.T_world_camera.copy()
    T[:, :3, 3] += sequence.site_origin
    found = pose_errors(T, truth.at(frames_s) @ T_IMU_LOCCAM, T_BODY_LOCCAM)
    assert found.position_m.max() < 0.05
    assert found.heading_deg.max() < 1.5
    assert max(found.roll_deg.max(), found.pitch_deg.max()) < 1
    assert sequence.notes[0].startswith(
        "position from 17 GPS fixes (17 RTK_FIXED), heading from motion and gyro (to 0."
    )
    assert sequence.notes[1].startswith("between fixes the poses follow the wheels, with a radius of 0.11")


def test_given_poses_in_utm_are_taken_as_they_are(made, tmp_path):
    folder, truth, frames_s = made
    T = truth.at(frames_s) @ T_IMU_LOCCAM
    write_tum(tmp_path / "poses.tum", START_S + frames_s, T)
    sequence = open_sequence(folder, ReadOptions(poses=tmp_path / "poses.tum"))
    np.testing.assert_allclose(sequence.T_world_camera[:, :3, 3] + sequence.site_origin, T[:, :3, 3], atol=1e-6)
    assert (sequence.crs, sequence.notes) == ("EPSG:32631", ())
    T[:, :3, 3] -= SITE_UTM_M
    write_tum(tmp_path / "poses.tum", START_S + frames_s, T)
    sequence = open_sequence(folder, ReadOptions(poses=tmp_path / "poses.tum"))
    assert (sequence.crs, sequence.notes) == (None, ("the poses given are not UTM: name their system with --crs",))


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("1970_01_01_00_00_36_29", 36.029),
        ("1970_01_01_00_00_36_1000", 37.0),
        ("1970_1_1_0_0_5_7", 5.007),
        ("2015_11_26_12_53_35_149", 1448542415.149),
        ("1970_01_01_00_00_36_1001", None),
        ("1970_13_01_00_00_36_2", None),
        ("1970_01_01_00_00_36", None),
        ("1970_01_01_00_00_٣_2", None),
        ("nan", None),
    ],
)
def test_milliseconds_are_numbers_and_not_decimals(text, seconds):
    assert parse_time(text) == (None if seconds is None else pytest.approx(seconds, abs=1e-9))


def test_frames_are_in_the_order_of_time_and_not_of_names(part):
    names = sorted((path.name for path in (part / "LocCam").iterdir()), key=lambda name: name.split("_")[1:8])
    times_s = [frame.timestamp_s for frame in open_sequence(part).frames]
    assert (np.diff(times_s) > 0).all()
    first, second = (part / "LocCam" / name for name in names[:2])
    stem = "LocCam_2015_11_26_12_53_30"
    for milliseconds in (900, 29, 1000):
        for side, path in enumerate((first, second)):
            shutil.copy(path, part / "LocCam" / f"{stem}_{milliseconds}_{side}.png")
    names = [frame.name for frame in open_sequence(part).frames]
    assert [name for name in names if stem in name] == [f"{stem}_{ms}_0" for ms in (29, 700, 900, 1000)]


def test_images_without_partner_repeated_or_otherwise_named_are_counted(part):
    images = sorted((part / "LocCam").iterdir())
    images[0].unlink()
    images[3].unlink()
    date, milliseconds, side = images[4].stem.rsplit("_", 2)
    shutil.copy(images[4], part / "LocCam" / f"{date}_{int(milliseconds):04d}_{side}.png")
    shutil.copy(images[4], part / "LocCam" / "preview.png")
    sequence = open_sequence(part)
    assert len(sequence.frames) == 4
    assert sequence.notes[:3] == (
        "LocCam: 2 images without partner left out",
        "LocCam: 1 images with a repeated time left out",
        "LocCam: 1 images with other names left out",
    )


def test_no_pairs_at_all_are_reported(part):
    for path in (part / "LocCam").glob("*_1.png"):
        path.unlink()
    assert refused(part) == (
        "no pair among 6 left and 0 right images and 0 with other names in PART/LocCam; name them "
        "LocCam_YYYY_MM_DD_HH_MM_SS_ms_0.png (left) and _1.png (right)"
    )


def test_a_folder_of_parts_is_reported_with_its_parts(made, tmp_path):
    root = made[0].parent.parent
    assert refused(root) == "the folder holds parts (Traverse1/Part2) in PART; give one of them"
    for name in ("Part10", "Part9", "Traverse2/Part1"):
        (tmp_path / name / "LocCam").mkdir(parents=True)
    assert [path.relative_to(tmp_path).as_posix() for path in find_parts(tmp_path)] == [
        "Part9",
        "Part10",
        "Traverse2/Part1",
    ]
    (tmp_path / "none").mkdir()
    assert refused(tmp_path / "none", ReadOptions(dataset="katwijk")) == (
        "there is no LocCam in PART; give the folder of a part, which holds LocCam"
    )


def test_a_part_without_gps_or_imu_needs_poses(part):
    (part / "gps-latlong.txt").unlink()
    assert refused(part) == (
        "no GPS: there is neither gps-latlong.txt nor gps-utm31.txt in PART; restore the file, or give --poses FILE "
        "(TUM text, T_world_camera of the left camera in UTM)"
    )
    shutil.copy(part / "odometry.txt", part / "gps-utm31.txt")
    assert refused(part).startswith("613 of 613 lines cannot be read in PART/gps-utm31.txt; restore the file, or")
    (part / "imu.txt").unlink()
    (part / "gps-utm31.txt").write_text("2015_11_26_12_53_34_617 RTK_FIXED 52.2141 4.4003 6.242 0.005 0.004 0.009\n")
    assert refused(part).startswith("no imu.txt in PART; restore the file, or give --poses")


def test_damaged_lines_are_left_out_sorted_and_counted(part, made):
    def damage(lines: list[bytes]) -> list[bytes]:
        lines[100] = lines[100][:30]
        lines[200] = b"\x00\xff\xfe" + lines[200]
        lines[300] = b" ".join([*lines[300].split()[:-1], b"nan"])
        lines[400] = b" ".join([lines[400].split()[0], *[b"1e300"] * 9])
        lines[500], lines[501] = lines[501], lines[500]
        lines[600] = lines[599]
        return lines

    rewrite(part / "imu.txt", damage)
    rewrite(part / "odometry.txt", lambda lines: [*lines[: len(lines) // 2], lines[-2][:50]])
    # A fix of the next century, and one in the void.
    rewrite(part / "gps-latlong.txt", lambda lines: [*lines[:-1], lines[3].replace(b"2015", b"2115"), b"2015_11 x 5 5"])
    sequence = open_sequence(part)
    total = len((part / "imu.txt").read_bytes().splitlines())
    assert set(sequence.notes[2:]) == {
        "gps-latlong.txt: 1 of 19 lines that cannot be read left out",
        f"imu.txt: 4 of {total} lines that cannot be read left out",
        f"imu.txt: 1 of {total} lines out of order sorted",
        f"imu.txt: 1 of {total} lines with a repeated time left out",
        "odometry.txt: 1 of 308 lines that cannot be read left out",
    }
    assert len(sequence.frames) == 6
    whole = open_sequence(made[0])
    np.testing.assert_allclose(sequence.T_world_camera[:3], whole.T_world_camera[:3], atol=0.05)


def test_frames_far_from_fixes_are_counted_and_those_in_gaps_of_the_imu_left_out(part):
    rewrite(part / "gps-latlong.txt", lambda lines: lines[:6] + lines[12:])
    rewrite(part / "imu.txt", lambda lines: lines[:3600] + lines[4200:])
    sequence = open_sequence(part)
    assert len(sequence.frames) == 5
    assert "1 of 6 frames have no GPS fix within 5 s (at most 8 s)" in sequence.notes
    assert sequence.notes[-1].startswith("1 of 6 frames have no pose and are left out")


def test_without_odometry_a_constant_speed_is_assumed_and_reported(part):
    (part / "odometry.txt").unlink()
    assert (
        "there is no odometry.txt: between the fixes the rover is assumed to keep its speed"
        in open_sequence(part).notes
    )


def test_another_clock_is_reported(part):
    for path in (part / "LocCam").iterdir():
        path.rename(path.with_name(path.name.replace("2015", "2016")))
    assert refused(part).startswith(
        "0 samples of the IMU lie near the times of the images in PART; check that both use one"
    )


def test_utm_is_reported_by_its_magnitude(part, tmp_path):
    gps, _ = read_gps(part)
    easting, northing, altitude = gps.fixes.antenna_world_m.T
    rows = list(zip(gps.fixes.timestamps_s - START_S, easting, northing, altitude, strict=True))
    for name, order in (("north_first", (1, 0)), ("east_first", (0, 1))):
        (tmp_path / name).mkdir()
        lines = [f"{time_text(t)} RTK_FIXED {xy[order[0]]} {xy[order[1]]} {z} 0.01 0.02 0.03" for t, *xy, z in rows]
        (tmp_path / name / "gps-utm31.txt").write_text("\n".join(lines))
        again, _ = read_gps(tmp_path / name)
        np.testing.assert_allclose(again.fixes.antenna_world_m, gps.fixes.antenna_world_m, atol=1e-6)
        np.testing.assert_allclose(again.fixes.sigma_m[0], [0.02, 0.01, 0.03])


def test_the_antenna_can_be_set(made):
    heights = [
        open_sequence(made[0], ReadOptions(antenna_m=(0.221, -0.052, height_m))).T_world_camera[:, 2, 3].mean()
        for height_m in (1.5785, 1.503)
    ]
    assert heights[1] - heights[0] == pytest.approx(0.0755, abs=1e-3)


def test_cameras_are_chosen_by_name(part):
    message = refused(part, ReadOptions(camera="hazcam"), UsageError)
    assert message == "katwijk has no camera 'hazcam' in --camera; choose loccam or pancam"
    assert refused(part, ReadOptions(camera="pancam")) == "there is no PanCam in PART; choose --camera loccam"


def as_pancam(part: Path) -> None:
    """Makes PanCam images of those of LocCam."""
    from PIL import Image

    (part / "PanCam").mkdir()
    Image.new("L", (1280, 960)).save(part / "black.png")
    for path in (part / "LocCam").iterdir():
        shutil.copy(part / "black.png", part / "PanCam" / path.name.replace("LocCam", "PanCam"))


def test_pancam_turns_with_pan_and_tilt(part, made):
    as_pancam(part)
    _, truth, frames_s = made
    assert refused(part, ReadOptions(camera="pancam")).startswith("no ptu.txt in PART")
    pan, tilt = 0.8, 0.3
    lines = [f"{time_text(t)} {pan} {tilt}" for t in np.arange(0, truth.times_s[-1], 0.5)]
    (part / "ptu.txt").write_text("\n".join(lines))
    sequence = open_sequence(part, ReadOptions(camera="pancam"))
    assert "pan and tilt of ptu.txt are taken for radians, positive to the left and down" in sequence.notes
    assert (sequence.camera.width_px, sequence.camera.height_px) == (1280, 960)
    R_world_body = Rotation.from_matrix(truth.at(frames_s)[:, :3, :3] @ R_BODY_IMU)
    looking = R_world_body.inv().apply(sequence.T_world_camera[:, :3, 2])
    expected = [np.cos(tilt) * np.cos(pan), np.cos(tilt) * np.sin(pan), -np.sin(tilt)]
    np.testing.assert_allclose(looking, np.tile(expected, (6, 1)), atol=0.02)
    (part / "ptu.txt").write_text("\n".join(line.replace("0.8", "45") for line in lines))
    assert "lines cannot be read in PART/ptu.txt" in refused(part, ReadOptions(camera="pancam"))


def test_pan_turns_left_and_tilt_looks_down(tmp_path):
    (tmp_path / "ptu.txt").write_text(f"{time_text(0)} 0 0\n{time_text(10)} 0.5 0.2\n")
    T, notes = body_to_camera(tmp_path, CAMERAS["pancam"], START_S + np.array([0.0, 5.0, 10.0]))
    np.testing.assert_allclose(T[0, :3, 2], [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(T[0, :3, 0], [0, -1, 0], atol=1e-9)
    np.testing.assert_allclose(np.arctan2(T[:, 1, 2], T[:, 0, 2]), [0, 0.25, 0.5], atol=1e-9)
    np.testing.assert_allclose(-np.arcsin(T[:, 2, 2]), [0, 0.1, 0.2], atol=1e-9)
    assert notes[-1] == "1 of 3 frames have no pan and tilt within 1 s"


def test_loccam_looks_ahead_and_down():
    T, _ = body_to_camera(Path(), CAMERAS["loccam"], np.zeros(3))
    np.testing.assert_allclose(T[:3, 3], [0.382, 0.078, 0.557])
    assert np.degrees(-np.arcsin(T[2, 2])) == pytest.approx(17.95, abs=0.01)
    np.testing.assert_allclose(T[:3, 0], [0, -1, 0], atol=1e-3)


def test_images_of_another_size_than_the_calibration_are_reported(part):
    calibration = config_folder() / "cameras" / "katwijk_pancam.yaml"
    assert refused(part, ReadOptions(calibration=calibration)) == (
        "images are 1024x768 px, the calibration is for 1280x960 px in PART; give the calibration of these images"
    )


def test_the_bundled_calibration_is_that_of_the_data_set():
    camera = make_rectifier(read_camera_yaml(config_folder() / "cameras" / "katwijk_loccam.yaml")).camera
    assert float(camera.fx_px) == pytest.approx(784.97, abs=0.01)
    assert float(camera.baseline_m) == pytest.approx(0.120079, abs=1e-6)
    assert (camera.width_px, camera.height_px) == (1024, 768)


@pytest.mark.realdata
def test_the_recorded_excerpts_are_read_whole(realdata):
    folder = realdata / "katwijk" / "Part1_excerpt"
    (gps, gps_notes), (imu, imu_notes), (wheels, wheel_notes) = read_gps(folder), read_imu(folder), read_wheels(folder)
    assert gps_notes == imu_notes == wheel_notes == []
    assert (len(gps.fixes.timestamps_s), len(imu.timestamps_s)) == (101, 120)
    assert wheels is not None and len(wheels.timestamps_s) == 120
    assert gps.crs == "EPSG:32631" and gps.statuses == {"RTK_FIXED": 101}
    np.testing.assert_allclose(np.diff(gps.fixes.timestamps_s), 3, atol=0.01)
    np.testing.assert_allclose(np.diff(imu.timestamps_s), 0.008, atol=0.0011)
    np.testing.assert_allclose(gps.fixes.antenna_world_m[0], [595_678, 5_785_782, 6.2], atol=5)
    assert np.linalg.norm(imu.specific_force_body_m_s2, axis=1) == pytest.approx(9.81, abs=0.1)
    assert not wheels.rolling.any()


@pytest.mark.realdata
def test_poses_of_the_simulated_traverse_are_near_the_truth(realdata):
    traverse = realdata.parent / "simdata" / "traverse_a"
    if not traverse.is_dir():
        pytest.skip(f"no simulated traverse at {traverse}")
    sequence = open_sequence(traverse / "Part1")
    truth = read_poses(traverse / "gt" / "poses_utm.tum")
    T_true, known = poses_at(truth, np.array([frame.timestamp_s for frame in sequence.frames]), 1.0)
    assert known.all() and len(known) == 14
    T = sequence.T_world_camera.copy()
    T[:, :3, 3] += sequence.site_origin
    found = pose_errors(T, T_true, T_BODY_LOCCAM)
    assert found.position_m.max() < 0.05
    assert found.heading_deg.max() < 1.5
    assert max(found.roll_deg.max(), found.pitch_deg.max()) < 1
