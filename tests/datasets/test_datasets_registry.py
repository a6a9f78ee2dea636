"""Choosing a reader, selecting frames, joining poses; plain folders and samples."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from jaxmap.datasets import READERS, Reader, ReadOptions, open_sequence, register
from jaxmap.datasets.base import FrameRef, assemble, read_stereo_pair
from jaxmap.datasets.pose_axes import T_Z_UP_SOURCE
from jaxmap.datasets.poses import make_pose_track, write_tum
from jaxmap.datasets.samples import motorcycle_disparity
from jaxmap.errors import FrameError, JaxmapError, UsageError
from jaxmap.types import make_stereo_camera

CAMERA = {"image_size_px": [9, 6], "fx_px": 8.0, "cx_px": 4, "cy_px": 2.5, "baseline_m": 0.1}


def track_of(count: int, start_m=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Level cameras that look north (+y) and move along it by 1 m each."""
    T = np.tile(T_Z_UP_SOURCE["camera"], (count, 1, 1))
    T[:, :3, 3] = np.asarray(start_m) + np.arange(count)[:, None] * [0.0, 1.0, 0.0]
    return T


def plain_folder(root: Path, names=None, times="0\n0.1\n0.2\n0.3\n0.4\n", start_m=(0.0, 0.0, 0.0), poses=5) -> Path:
    folder = root / "drive"
    for side in ("left", "right"):
        (folder / side).mkdir(parents=True)
        for name in names or [f"f{index}" for index in range(5)]:
            Image.fromarray(np.full((6, 9), 7, np.uint8)).save(folder / side / f"{name}.png")
    (folder / "camera.yaml").write_text(yaml.safe_dump(CAMERA))
    if times:
        (folder / "times.txt").write_text(times)
    if poses:
        write_tum(folder / "poses.tum", np.arange(float(poses)) / 10, track_of(poses, start_m))
    return folder


def refused(source, options=None, kind=JaxmapError) -> str:
    with pytest.raises(kind) as caught:
        open_sequence(source, options)
    assert "\n" not in str(caught.value)
    return str(caught.value).replace(str(source), "SOURCE")


def test_a_plain_folder_opens(tmp_path):
    sequence = open_sequence(str(plain_folder(tmp_path)))
    assert (sequence.name, sequence.dataset) == ("drive", "folder")
    assert [frame.name for frame in sequence.frames] == ["f0", "f1", "f2", "f3", "f4"]
    assert [frame.timestamp_s for frame in sequence.frames] == [0.0, 0.1, 0.2, 0.3, 0.4]
    np.testing.assert_array_equal(sequence.T_world_camera, track_of(5))
    np.testing.assert_array_equal(sequence.T_world_source, np.eye(4))
    assert sequence.site_origin.tolist() == [0, 0, 0]
    assert sequence.crs is None
    assert sequence.notes == ("times of the frames from times.txt",)
    assert sequence.read_pair(sequence.frames[0]).left.shape == (6, 9)


def test_frames_are_chosen_like_a_slice_and_share_one_world(tmp_path):
    folder = plain_folder(tmp_path, start_m=(458074.6, 5429380.2, 162.9))
    whole = open_sequence(folder)
    assert whole.site_origin.tolist() == [458074, 5429380, 162]
    np.testing.assert_allclose(whole.T_world_camera[0, :3, 3], [0.6, 0.2, 0.9], atol=1e-6)
    part = open_sequence(folder, ReadOptions(start=1, stop=-1, stride=2))
    assert [frame.name for frame in part.frames] == ["f1", "f3"]
    np.testing.assert_array_equal(part.T_world_camera, whole.T_world_camera[[1, 3]])
    np.testing.assert_array_equal(part.site_origin, whole.site_origin)


@pytest.mark.parametrize(("per_second", "unit"), [(1e3, "milliseconds"), (1e9, "nanoseconds")])
def test_frames_in_another_unit_than_the_poses_are_refused_though_the_first_has_a_pose(tmp_path, per_second, unit):
    times = "".join(f"{round(index / 10 * per_second)}\n" for index in range(5))
    message = refused(plain_folder(tmp_path, times=times))
    assert f"times of the frames look like {unit}, so that 20% of the frames have a pose" in message
    assert "times.txt" in message


def test_a_world_is_levelled_by_its_up_and_the_map_keeps_the_turn(tmp_path):
    sequence = open_sequence(plain_folder(tmp_path), ReadOptions(poses_up=(0.0, 0.6, 0.8)))
    np.testing.assert_allclose(sequence.T_world_source[:3, :3] @ [0, 0.6, 0.8], [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(sequence.T_world_camera, sequence.T_world_source @ track_of(5), atol=1e-9)
    assert sequence.pose_reading.poses_world == "z_up"


def test_an_empty_selection_reports_how_many_frames_there_are(tmp_path):
    message = refused(plain_folder(tmp_path), ReadOptions(start=5))
    assert message == "start 5, stop None, stride 1 select none of 5 frames in SOURCE; choose another range"


def test_frames_without_a_pose_are_left_out_and_counted(tmp_path):
    folder = plain_folder(tmp_path, poses=3)
    sequence = open_sequence(folder)
    assert [frame.name for frame in sequence.frames] == ["f0", "f1", "f2"]
    assert sequence.notes[-1] == (
        "2 of 5 frames have no pose and are left out: the frames span 0.000 to 0.400 s, the poses 0.000 to 0.200 s"
    )
    np.testing.assert_array_equal(sequence.T_world_camera, track_of(3))
    message = refused(folder, ReadOptions(start=3))
    assert message.startswith(
        "none of 2 frames has a pose: the frames span 0.300 to 0.400 s, the poses 0.000 to 0.200 s in SOURCE/poses.tum;"
    )


def test_poses_are_interpolated_at_the_times_of_the_frames_but_not_across_gaps(tmp_path):
    folder = plain_folder(tmp_path, times="0.05\n0.15\n0.25\n0.35\n0.4\n")
    positions = open_sequence(folder).T_world_camera[:, 1, 3]
    np.testing.assert_allclose(positions, [0.5, 1.5, 2.5, 3.5, 4.0])
    sequence = open_sequence(folder, ReadOptions(max_pose_gap_s=0.01))
    assert [frame.name for frame in sequence.frames] == ["f4"]


def test_given_poses_and_calibration_go_first(tmp_path):
    folder = plain_folder(tmp_path)
    given = tmp_path / "given.tum"
    write_tum(given, np.arange(5.0) / 10, track_of(5, (0.0, 100.0, 0.0)))
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(CAMERA | {"fx_px": 5.0}))
    sequence = open_sequence(folder, ReadOptions(poses=given, calibration=tmp_path / "camera.yaml"))
    assert sequence.T_world_camera[0, 1, 3] == 100
    assert float(sequence.camera.fx_px) == 5.0


def test_poses_in_a_camera_world_are_turned_and_noted(tmp_path):
    folder = plain_folder(tmp_path, poses=0)
    given = tmp_path / "given.tum"
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, 2, 3] = np.arange(5.0)
    write_tum(given, np.arange(5.0) / 10, T)
    sequence = open_sequence(folder, ReadOptions(poses=given))
    np.testing.assert_array_equal(sequence.T_world_camera, track_of(5))
    np.testing.assert_array_equal(sequence.T_world_source, T_Z_UP_SOURCE["camera"])
    assert "the poses' world is taken for camera-like (y down) and turned z-up" in sequence.notes
    kept = open_sequence(folder, ReadOptions(poses=given, poses_world="z_up"))
    np.testing.assert_array_equal(kept.T_world_camera, T)
    assert len(kept.notes) == 1


def test_missing_poses_and_poses_of_a_body_are_reported(tmp_path):
    folder = plain_folder(tmp_path, poses=0)
    assert refused(folder) == (
        "the sequence has no poses: there is no file SOURCE/poses.tum; give them with --poses FILE (TUM text, "
        "T_world_camera of the left camera), or estimate them from the images: --poses odometry"
    )
    csv = tmp_path / "data.csv"
    csv.write_text("0,0,0,0,1,0,0,0\n")
    assert "a csv of EuRoC's form holds poses of the body, not" in refused(folder, ReadOptions(poses=csv))


def test_missing_calibration_is_reported(tmp_path):
    folder = plain_folder(tmp_path)
    (folder / "camera.yaml").unlink()
    assert refused(folder) == (
        "no calibration: there is no file SOURCE/camera.yaml; write camera.yaml, or give --calibration FILE"
    )


def test_images_of_another_size_than_the_calibration_are_reported(tmp_path):
    folder = plain_folder(tmp_path)
    (folder / "camera.yaml").write_text(yaml.safe_dump(CAMERA | {"image_size_px": [10, 6]}))
    assert refused(folder) == (
        "images are 9x6 px, the calibration is for 10x6 px in SOURCE; give the calibration of these images"
    )


def test_a_missing_right_image_is_reported_when_it_is_read(tmp_path):
    folder = plain_folder(tmp_path)
    (folder / "right" / "f1.png").unlink()
    sequence = open_sequence(folder)
    assert len(sequence.frames) == 5
    with pytest.raises(FrameError, match=r"the image is missing in .*right/f1\.png"):
        sequence.read_pair(sequence.frames[1])


@pytest.mark.parametrize(
    ("names", "poses", "expected_s", "note"),
    [
        (["0.1", "0.25", "0.3"], 5, [0.1, 0.25, 0.3], "from the file names"),
        (["100000000", "100000001"], 0, [1e8, 1e8 + 1], "from the file names"),
        (["100000000000", "100000000100"], 0, [1e8, 1e8 + 0.1], "from the file names"),
        (["1403715273262142", "1403715273312142"], 0, [1403715273.262142, 1403715273.312142], "from the file names"),
        (["1403715273262142976"], 0, [1403715273.262143], "from the file names"),
        (["9", "10", "11"], 3, [0.0, 0.1, 0.2], "from the poses, one for each"),
        (["b", "a"], 2, [0.0, 0.1], "from the poses, one for each"),
    ],
)
def test_times_are_found_without_a_file_of_times(tmp_path, names, poses, expected_s, note):
    folder = plain_folder(tmp_path, names=names, times="", poses=poses)
    if not poses:
        write_tum(folder / "poses.tum", np.array(expected_s), track_of(len(names)))
    sequence = open_sequence(folder)
    np.testing.assert_allclose([frame.timestamp_s for frame in sequence.frames], expected_s, rtol=1e-15, atol=1e-6)
    assert [frame.name for frame in sequence.frames] == (["a", "b"] if "a" in names else names)
    assert sequence.notes == (f"times of the frames {note}",)


def test_poses_without_times_number_the_frames(tmp_path):
    folder = plain_folder(tmp_path, times="", poses=0)
    given = tmp_path / "poses.txt"
    np.savetxt(given, track_of(5)[:, :3].reshape(5, 12))
    sequence = open_sequence(folder, ReadOptions(poses=given))
    assert [frame.timestamp_s for frame in sequence.frames] == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(sequence.T_world_camera, track_of(5))
    assert sequence.notes == ("frames numbered 0, 1, 2 ... s, as no times are known",)


def test_counters_are_not_taken_for_times(tmp_path):
    folder = plain_folder(tmp_path, names=["000000", "000001"], times="", poses=5)
    assert refused(folder) == (
        "no times: no times.txt or timestamps.txt, the file names are not times, and there are 5 poses for 2 left "
        "images in SOURCE; write times.txt with one time in seconds per line"
    )


def test_counts_and_orders_that_disagree_are_reported(tmp_path):
    folder = plain_folder(tmp_path)
    (folder / "times.txt").write_text("0\n1\n")
    assert refused(folder) == "2 times for 5 left images in SOURCE/times.txt; write one line for each image"
    (folder / "times.txt").write_text("0\n1\n1\n2\n3\n")
    assert refused(folder).startswith(
        "the time of frame f2 (1.000000 s) does not come after the one before it in SOURCE; correct the times"
    )
    (folder / "times.txt").unlink()
    (folder / "timestamps.txt").write_text("0\n1\n2\n3\n4\n")
    np.savetxt(folder / "poses.tum", track_of(4)[:, :3].reshape(4, 12))
    assert refused(folder).startswith("4 poses for 5 frames in SOURCE/poses.tum; poses without times need exactly")


def test_an_offset_takes_poses_of_a_body_to_the_camera(tmp_path):
    folder = plain_folder(tmp_path)
    sequence = open_sequence(folder)
    T_body_camera = T_Z_UP_SOURCE["camera"].copy()
    T_body_camera[:3, 3] = [0.1, 0.2, 0.3]
    T_world_body = np.tile(np.eye(4), (5, 1, 1))
    T_world_body[:, 0, 3] = np.arange(5.0)
    offset = assemble(
        name="a",
        dataset="a",
        where="a",
        frames=sequence.frames,
        track=make_pose_track(np.arange(5.0) / 10, T_world_body, child="body"),
        camera=sequence.camera,
        options=ReadOptions(),
        T_child_camera=T_body_camera,
    )
    np.testing.assert_allclose(offset.T_world_camera[2, :3, 3], [2.1, 0.2, 0.3])
    np.testing.assert_array_equal(offset.T_world_camera[2, :3, :3], T_Z_UP_SOURCE["camera"][:3, :3])


def test_unknown_sources_are_refused_with_the_known_formats(tmp_path):
    assert refused(tmp_path / "none").startswith("there is no folder SOURCE; give the folder of one sequence")
    (tmp_path / "file").write_text("")
    assert refused(tmp_path / "file").startswith("SOURCE is a file, but no bag; give the folder of one sequence")
    (tmp_path / "empty").mkdir()
    message = refused(tmp_path / "empty")
    assert message.startswith("no data set is recognised: looked for what marks kitti, euroc, ")
    assert all(name in message for name in READERS) and "jaxmap info says what each must hold" in message


def test_a_folder_that_two_readers_fit_needs_a_choice(tmp_path):
    folder = plain_folder(tmp_path)
    (folder / "calib.txt").write_text("")
    (folder / "image_0").mkdir()
    assert refused(folder) == "kitti and folder both fit in SOURCE; choose one with --dataset"
    assert open_sequence(folder, ReadOptions(dataset="folder")).dataset == "folder"


@pytest.mark.parametrize(
    "options",
    [
        {"poses_world": "ned"},
        {"stride": 0},
        {"max_pose_gap_s": 0.0},
        {"max_pose_gap_s": float("nan")},
        {"antenna_m": (0.0, 0.0, float("nan"))},
        {"antenna_m": (0.0, 0.0)},
        {"starts": 3},
    ],
)
def test_options_are_checked_when_made(options):
    with pytest.raises(UsageError, match=next(iter(options))):
        ReadOptions(**options)


def test_unknown_names_are_usage_errors(tmp_path):
    assert refused(tmp_path, ReadOptions(dataset="nuscenes"), UsageError).startswith(
        "there is no reader 'nuscenes' in --dataset; choose auto, kitti, euroc, folder"
    )
    assert refused(tmp_path, ReadOptions(crs="mars"), UsageError).startswith(
        "'mars' is not a coordinate reference system in --crs"
    )


def test_readers_can_be_added_once(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxmap.datasets.registry.READERS", dict(READERS))
    folder = plain_folder(tmp_path)
    opened = open_sequence(folder)
    (tmp_path / "HazCam").mkdir()
    rover = Reader(
        "rover", "a folder with HazCam", lambda path: (path / "HazCam").is_dir(), lambda path, options: opened
    )
    register(rover)
    assert open_sequence(tmp_path) is opened
    with pytest.raises(ValueError, match="rover is registered already"):
        register(rover)


def test_the_motorcycle_opens():
    sequence = open_sequence("sample:motorcycle")
    assert (sequence.name, sequence.dataset, len(sequence.frames)) == ("motorcycle", "sample", 1)
    assert sequence.frames[0].timestamp_s == 0.0
    np.testing.assert_array_equal(sequence.T_world_camera, T_Z_UP_SOURCE["camera"][None])
    pair = sequence.read_pair(sequence.frames[0])
    assert pair.left.shape == pair.right.shape == (500, 741, 3)
    camera = sequence.camera
    assert (camera.width_px, camera.height_px) == (741, 500)
    assert float(camera.doffs_px) == pytest.approx(31.086)


def test_the_motorcycles_true_disparity_maps_left_to_right():
    disparity_px = motorcycle_disparity()
    assert (disparity_px.shape, disparity_px.dtype) == ((500, 741), np.float32)
    known = np.isfinite(disparity_px)
    assert not np.isinf(disparity_px).any()
    assert 0.9 < known.mean() < 1.0
    pair = read_stereo_pair(open_sequence("sample:motorcycle").frames[0])
    v, u = np.nonzero(known)
    u_right = np.round(u - disparity_px[v, u]).astype(int)
    seen = u_right >= 0
    difference = np.abs(pair.left[v, u][seen].astype(int) - pair.right[v, u_right][seen].astype(int))
    assert np.median(difference) < 5


def test_unknown_samples_are_reported(tmp_path):
    assert refused("sample:vespa") == "there is no sample 'vespa'; choose motorcycle, traverse"
    message = refused("sample:motorcycle", ReadOptions(dataset="kitti"), UsageError)
    assert message == "a sample is not read as kitti in --dataset; leave the option out"
    write_tum(tmp_path / "late.tum", np.array([5.0]), track_of(1))
    assert "none of 1 frames has a pose" in refused("sample:motorcycle", ReadOptions(poses=tmp_path / "late.tum"))


def test_an_unreadable_first_image_does_not_stop_a_sequence(tmp_path):
    folder = plain_folder(tmp_path)
    (folder / "left" / "f0.png").write_bytes(b"")
    assert len(open_sequence(folder).frames) == 5


def test_assembling_checks_the_size_against_a_rectified_camera(tmp_path):
    image = tmp_path / "a.png"
    Image.fromarray(np.zeros((6, 9), np.uint8)).save(image)
    camera = make_stereo_camera(fx_px=1, cx_px=0, cy_px=0, baseline_m=1, width_px=8, height_px=6)
    with pytest.raises(JaxmapError, match="images are 9x6 px, the calibration is for 8x6 px"):
        assemble(
            name="a",
            dataset="a",
            where="a",
            frames=[FrameRef("a", 0.0, image, image)],
            track=make_pose_track(None, np.eye(4)[None]),
            camera=camera,
            options=ReadOptions(),
        )
