"""Pose texts of other programs: separators, headers, units of time, lines without a pose."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.datasets.base import read_pose_track
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.poses import poses_at, read_poses
from jaxmap.datasets.units import unit_by_size, unit_that_overlaps
from jaxmap.errors import JaxmapError

HALF = 0.5**0.5
POSITIONS = np.array([[1.0, 2.0, 3.0], [1.5, 2.0, 3.0]])
QUATERNIONS_XYZW = np.array([[HALF, 0, 0, HALF], [0, 0, 0.6, 0.8]])


def text_of(times, separator=" ", order="xyzw", end="", header=""):
    columns = QUATERNIONS_XYZW if order == "xyzw" else QUATERNIONS_XYZW[:, [3, 0, 1, 2]]
    rows = [
        separator.join([time, *(f"{x:.9f}" for x in [*position, *q])]) + end
        for time, position, q in zip(times, POSITIONS, columns, strict=True)
    ]
    return header + "\n".join(rows) + "\n"


SECONDS, NANOSECONDS = ["1700000000.0", "1700000000.5"], ["1700000000000000000", "1700000000500000000"]
ROS_HEADER = (
    "%time,field.header.seq,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
    "field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w\n"
)


@pytest.mark.parametrize(
    ("text", "child"),
    [
        (text_of(SECONDS), "camera"),
        (text_of(SECONDS, "\t"), "camera"),
        (text_of(SECONDS, ","), "camera"),
        (text_of(SECONDS, ", ", end=","), "camera"),
        (text_of(SECONDS, ";").replace(".", ","), "camera"),
        (text_of(SECONDS, header="time tx ty tz qx qy qz qw\n"), "camera"),
        (text_of(SECONDS, order="wxyz", header="# timestamp [s] tx ty tz qw qx qy qz\n"), "camera"),
        (text_of(SECONDS, ",", order="wxyz", header='"timestamp","x","y","z","q_w","q_x","q_y","q_z"\n'), "camera"),
        (text_of(NANOSECONDS), "camera"),
        (text_of([time + ".000000" for time in NANOSECONDS]), "camera"),
        (text_of([time[:-6] for time in NANOSECONDS]), "camera"),
        (text_of([time[:-3] for time in NANOSECONDS]), "camera"),
        (text_of(NANOSECONDS, ",", order="wxyz"), "body"),
        (text_of(NANOSECONDS, ",", order="wxyz", end=","), "body"),
        (text_of(NANOSECONDS, ",", order="wxyz", end=",0.1,0.2,0.3,"), "body"),
        (text_of([f"{time},7" for time in NANOSECONDS], ",", header=ROS_HEADER), "camera"),
        (text_of(["1,7,5", "2,8,6"], ",", header=ROS_HEADER).replace("1,7,5", "5e8,7").replace("2,8,6", "1e9,8"), None),
    ],
)
def test_forms_of_other_programs_read_as_the_same_poses(tmp_path, text, child):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    track = read_poses(path)
    np.testing.assert_allclose(track.T[:, :3, 3], POSITIONS)
    np.testing.assert_allclose(track.T[0, :3, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-8)
    np.testing.assert_allclose(track.T[1, :3, 0], [0.28, 0.96, 0], atol=1e-8)
    if child is not None:
        assert track.child == child
        np.testing.assert_allclose(track.timestamps_s, [1700000000.0, 1700000000.5], rtol=0, atol=1e-6)
    assert not track.faults


def test_a_matrix_of_four_rows_reads_as_one_of_three(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("1 0 0 4 0 1 0 5 0 0 1 6 0 0 0 1\n")
    np.testing.assert_array_equal(read_poses(path).T[0, :3, 3], [4, 5, 6])


def test_order_and_unit_that_are_told_are_taken(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text(text_of(["1000", "1500"], order="wxyz"))
    track = read_poses(path, "wxyz", "ms")
    np.testing.assert_array_equal(track.timestamps_s, [1.0, 1.5])
    np.testing.assert_allclose(track.T[1, :3, 0], [0.28, 0.96, 0], atol=1e-8)
    assert (track.quaternion, track.time_unit) == ("wxyz", "ms")


def test_a_unit_that_is_guessed_is_told(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text(text_of(NANOSECONDS))
    assert read_poses(path).notes == ("times of the poses are taken for nanoseconds, by their size",)


TUM = "0 1 2 3 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "usable", "fault"),
    [
        (TUM + "1 nan nan nan nan nan nan nan\n", [1, 0], "1 of 2 poses with a number that is not finite (line 2) is"),
        (TUM + "1 1 2 inf 0 0 0 1\n", [1, 0], "1 of 2 poses with a number that is not finite (line 2) is left out"),
        (TUM + "1 1 2 -nan(ind) 0 0 0 1\n", [1, 0], "1 of 2 poses with a number that is not finite (line 2) is left"),
        (TUM + "1 1 2 3 0 0 0 0\n", [1, 0], "1 of 2 poses with a rotation of zeros (line 2) is left out"),
        (TUM + "nan 1 2 3 0 0 0 1\n", [1], "1 of 2 poses without a time (line 2) is left out"),
        (TUM + TUM, [1], "1 of 2 poses of a time that is there already (line 2) is left out"),
        ("1" + TUM[1:] + TUM, [1, 1], "times of the poses go back 1 times (line 2): sorted"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n" + "0 " * 12 + "\n", [1, 0], "1 of 2 poses with a rotation of zeros (line 2) is"),
    ],
)
def test_lines_without_a_pose_are_left_out_and_counted(tmp_path, text, usable, fault):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    track = read_poses(path)
    assert track.usable.tolist() == [bool(known) for known in usable]
    assert len(track.faults) == 1
    assert track.faults[0].startswith(f"poses.txt: {fault}")


def test_a_frame_at_a_lost_time_has_no_pose_though_others_are_near(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("0 0 0 0 0 0 0 1\n0.5 nan 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    T, has_pose = poses_at(read_poses(path), np.array([0.0, 0.3, 0.5, 1.0]), max_gap_s=1.0)
    assert has_pose.tolist() == [True, True, False, True]
    assert T[1, 0, 3] == pytest.approx(0.3)
    assert np.isnan(T[2]).all()


def test_a_csv_of_a_body_is_taken_for_the_camera_where_it_stands_upright_or_is_told(tmp_path):
    upright, lying = tmp_path / "upright.csv", tmp_path / "lying.csv"
    upright.write_text("1700000000000000000,0,0,1,-0.573576,0.819152,0,0,\n")
    lying.write_text("1700000000000000000,0,0,1,1,0,0,0,\n")
    track = read_pose_track(ReadOptions(poses=upright), upright)
    assert track.child == "camera"
    assert "stand upright as those of a camera's optical axes" in track.notes[0]
    with pytest.raises(JaxmapError, match="--pose-convention: optical if"):
        read_pose_track(ReadOptions(poses=lying), lying)
    track = read_pose_track(ReadOptions(poses=lying, pose_convention="body"), lying)
    np.testing.assert_array_equal(track.T[0, :3, 2], [1, 0, 0])


@given(seconds=st.floats(1e9, 4e9), unit=st.sampled_from(["s", "ms", "us", "ns"]))
def test_units_of_unix_times_are_known_by_size(seconds, unit):
    per_second = {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    assert (unit_by_size(seconds * per_second) or "s") == unit
    assert unit_that_overlaps(np.array([seconds * per_second]), np.array([0.0, 1e10]), "s") in (
        None if unit == "s" else unit,
        *({"ms", "us", "ns"} if unit == "s" else {}),
    )
