"""Pose files and pose tracks: laws, formats, error texts."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxmap.datasets import pose_axes as A
from jaxmap.datasets import poses as P
from jaxmap.errors import JaxmapError

seeds = st.integers(0, 2**32 - 1)
origins = st.sampled_from([(0.0, 0.0, 0.0), (458074.6, 5429380.2, 162.9), (-7e6, 3e6, -400.0)])


def random_poses(seed: int, count: int, origin=(0.0, 0.0, 0.0)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    T[:, :3, 3] = np.asarray(origin) + rng.normal(0, 50, (count, 3))
    return T


def random_times(seed: int, count: int) -> np.ndarray:
    return 1.7e9 + np.cumsum(np.random.default_rng(seed).uniform(0.05, 0.4, count))


def assert_rigid(T: np.ndarray) -> None:
    R = T[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(T), 1, 1)), atol=1e-9)
    assert (np.linalg.det(R) > 0).all()
    np.testing.assert_array_equal(T[:, 3], np.tile([0.0, 0, 0, 1], (len(T), 1)))


def refused(path: Path, text: str | bytes) -> str:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(JaxmapError) as caught:
        P.read_poses(path)
    assert "\n" not in str(caught.value)
    return str(caught.value).replace(str(path), "FILE")


@given(seed=seeds, count=st.integers(1, 20), origin=origins)
def test_tum_files_bring_back_every_pose(tmp_path_factory, seed, count, origin):
    path = tmp_path_factory.mktemp("tum") / "poses.tum"
    T, times_s = random_poses(seed, count, origin), random_times(seed, count)
    P.write_tum(path, times_s, T)
    track = P.read_poses(path)
    np.testing.assert_array_equal(track.timestamps_s, times_s)
    np.testing.assert_array_equal(track.T[:, :3, 3], T[:, :3, 3])
    np.testing.assert_allclose(track.T, T, rtol=0, atol=1e-12)
    assert track.child == "camera"
    assert [file.name for file in path.parent.iterdir()] == ["poses.tum"]


@given(seed=seeds, count=st.integers(1, 20))
def test_kitti_files_bring_back_every_pose(tmp_path_factory, seed, count):
    path = tmp_path_factory.mktemp("kitti") / "poses.txt"
    T = random_poses(seed, count)
    np.savetxt(path, T[:, :3].reshape(count, 12), fmt="%.17g")
    track = P.read_poses(path)
    assert track.timestamps_s is None
    np.testing.assert_allclose(track.T, T, rtol=0, atol=1e-12)


@given(seed=seeds, count=st.integers(1, 20))
def test_euroc_files_bring_back_every_pose(tmp_path_factory, seed, count):
    path = tmp_path_factory.mktemp("euroc") / "data.csv"
    T = random_poses(seed, count)
    times_ns = 1403715273262142976 + 50_000_000 * np.arange(count)
    q = Rotation.from_matrix(T[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    rows = [
        ", ".join([str(time), *(repr(float(x)) for x in [*row[:3, 3], *wxyz]), "0.0", "0.0"])
        for time, row, wxyz in zip(times_ns, T, q, strict=True)
    ]
    path.write_text("#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z\r\n" + "\r\n".join(rows) + "\r\n")
    track = P.read_poses(path)
    assert track.child == "body"
    np.testing.assert_array_equal(track.timestamps_s, [int(time) / 1e9 for time in times_ns])
    np.testing.assert_allclose(track.T, T, rtol=0, atol=1e-12)


@given(seed=seeds, count=st.integers(1, 12), origin=origins)
def test_a_pose_at_its_own_time_is_exact(seed, count, origin):
    track = P.make_pose_track(random_times(seed, count), random_poses(seed, count, origin))
    T, has_pose = P.poses_at(track, track.timestamps_s, max_gap_s=0.2)
    assert has_pose.all()
    np.testing.assert_array_equal(T, track.T)


@given(seed=seeds, count=st.integers(2, 12), origin=origins)
def test_between_poses_the_pose_is_rigid_and_between(seed, count, origin):
    track = P.make_pose_track(random_times(seed, count), random_poses(seed, count, origin))
    share = np.random.default_rng(seed).uniform(0.01, 0.99, count - 1)
    T, has_pose = P.poses_at(track, track.timestamps_s[:-1] + share * np.diff(track.timestamps_s), max_gap_s=1.0)
    assert has_pose.all()
    assert_rigid(T)
    lower = np.minimum(track.T[:-1, :3, 3], track.T[1:, :3, 3])
    upper = np.maximum(track.T[:-1, :3, 3], track.T[1:, :3, 3])
    assert ((T[:, :3, 3] >= lower - 1e-6) & (T[:, :3, 3] <= upper + 1e-6)).all()


def test_rotation_is_shared_along_the_shortest_arc():
    T = np.tile(np.eye(4), (2, 1, 1))
    T[:, :3, :3] = Rotation.from_euler("z", [[170], [190]], degrees=True).as_matrix()
    T[1, :3, 3] = [4, 0, 0]
    between, _ = P.poses_at(P.make_pose_track(np.array([0.0, 1.0]), T), np.array([0.25]), 1.0)
    np.testing.assert_allclose(
        Rotation.from_matrix(between[0, :3, :3]).as_euler("zyx", degrees=True)[0], 175, atol=1e-9
    )
    np.testing.assert_allclose(between[0, :3, 3], [1, 0, 0], atol=1e-12)


def test_no_pose_outside_the_track_or_inside_a_gap():
    track = P.make_pose_track(np.array([0.0, 1.0, 5.0, 6.0]), random_poses(0, 4))
    asked_s = np.array([-0.1, -0.0005, 0.5, 1.0005, 1.2, 3.0, 4.9996, 5.5, 6.0005, 6.1])
    T, has_pose = P.poses_at(track, asked_s, max_gap_s=1.0)
    assert has_pose.tolist() == [False, True, True, True, False, False, True, True, True, False]
    assert np.isnan(T[~has_pose]).all()
    np.testing.assert_array_equal(T[[1, 3, 6, 8]], track.T[[0, 1, 2, 3]])


def test_a_single_pose_serves_its_own_time_alone():
    track = P.make_pose_track(np.array([2.0]), random_poses(0, 1))
    assert P.poses_at(track, np.array([1.0, 2.0, 3.0]), 10.0)[1].tolist() == [False, True, False]


def test_poses_without_times_cannot_be_interpolated_but_can_be_given_times():
    track = P.make_pose_track(None, random_poses(0, 3), where="poses.txt")
    with pytest.raises(JaxmapError, match=r"poses without times in poses\.txt; give poses with times"):
        P.poses_at(track, np.zeros(1), 1.0)
    with pytest.raises(JaxmapError, match=r"3 poses for 2 frames in poses\.txt"):
        P.with_timestamps(track, np.zeros(2))
    assert P.poses_at(P.with_timestamps(track, np.arange(3.0)), np.arange(3.0), 1.0)[1].all()


@given(seed=seeds, count=st.integers(1, 8), world=st.sampled_from(["z_up", "camera", "auto"]))
def test_turning_z_up_is_rigid_and_once_is_enough(seed, count, world):
    T = random_poses(seed, count)
    turned, T_world_source = A.to_z_up(T, world)
    assert_rigid(turned)
    np.testing.assert_array_equal(turned, T_world_source @ T)
    np.testing.assert_array_equal(np.linalg.inv(T_world_source) @ turned, T)
    if world == "auto":
        again, T_again = A.to_z_up(turned, "auto")
        np.testing.assert_array_equal(again, turned)
        np.testing.assert_array_equal(T_again, np.eye(4))


@pytest.mark.parametrize("yaw_deg", [0, 90, 180, 270])
@pytest.mark.parametrize("pitch_down_deg", [0, 18, 35])
def test_auto_distinguishes_a_z_up_world_from_a_camera_world(yaw_deg, pitch_down_deg):
    pitched = Rotation.from_euler("x", -pitch_down_deg, degrees=True).as_matrix()
    in_camera_world = np.eye(4)[None].copy()
    in_camera_world[0, :3, :3] = Rotation.from_euler("y", yaw_deg, degrees=True).as_matrix() @ pitched
    turned, T_world_source = A.to_z_up(in_camera_world, "auto")
    np.testing.assert_array_equal(T_world_source, A.T_Z_UP_SOURCE["camera"])
    up_world = -turned[0, :3, 1]
    assert up_world[2] > 0.8
    # The same camera, given in its z-up world, stays as it is.
    np.testing.assert_array_equal(A.to_z_up(turned, "auto")[0], turned)


def test_a_camera_world_turns_right_to_x_forward_to_y_up_to_z():
    right_down_forward = np.tile(np.eye(4), (3, 1, 1))
    right_down_forward[:, :3, 3] = np.eye(3)
    turned, _ = A.to_z_up(right_down_forward, "camera")
    np.testing.assert_array_equal(turned[:, :3, 3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]])


@given(seed=seeds, count=st.integers(1, 20), origin=origins)
def test_the_site_origin_adds_back_exactly(seed, count, origin):
    T = random_poses(seed, count, origin)
    # Quarter millimetres have few bits, so that float64 holds sums of them exactly.
    T[:, :3, 3] = np.round(T[:, :3, 3] * 4096) / 4096
    relative, site_origin = P.split_site_origin(T)
    np.testing.assert_array_equal(relative[:, :3, 3] + site_origin, T[:, :3, 3])
    np.testing.assert_array_equal(relative[:, :3, :3], T[:, :3, :3])
    np.testing.assert_array_equal(site_origin, np.round(site_origin))
    assert np.abs(relative[:, :3, 3]).max() < P.MAX_LOCAL_RANGE_M
    assert (site_origin == 0).all() == (origin == (0.0, 0.0, 0.0))


def test_a_track_is_checked():
    T = random_poses(0, 3)
    with pytest.raises(JaxmapError, match=r"timestamps go back or repeat at row 3 in poses; sort"):
        P.make_pose_track(np.array([0.0, 1.0, 1.0]), T)
    with pytest.raises(JaxmapError, match="3 poses with 2 timestamps"):
        P.make_pose_track(np.zeros(2), T)
    with pytest.raises(JaxmapError, match="a timestamp that is not finite at row 2"):
        P.make_pose_track(np.array([0.0, np.nan, 1.0]), T)
    with pytest.raises(JaxmapError, match="no poses"):
        P.make_pose_track(None, np.zeros((0, 4, 4)))
    with pytest.raises(JaxmapError, match="4x4"):
        P.make_pose_track(None, np.zeros((2, 3, 4)))
    for broken in (2 * T[1], np.diag([1.0, 1, -1, 1]), np.full((4, 4), 1e300)):
        with pytest.raises(JaxmapError, match="not a rotation and a translation at row 2"):
            P.make_pose_track(None, np.stack([T[0], broken]))


def test_rounded_rotations_become_exact_ones():
    T = random_poses(0, 5)
    T[:, :3] = np.round(T[:, :3], 4)
    assert_rigid(P.make_pose_track(None, T).T)


TUM = "0 1 2 3 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no poses in FILE; give TUM text (8 columns), KITTI 3x4 text (12), EuRoC csv"),
        ("# only\n\n# comments\n", "no poses in FILE; give TUM text (8 columns), KITTI 3x4 text (12), EuRoC csv"),
        ("1 2 3\n", "3 columns do not make a pose in FILE line 1; give TUM text (8 columns)"),
        ("# c\n1,2,3\n", "3 comma-separated columns do not make a pose in FILE line 2; give TUM"),
        (TUM + "\n# c\n1 1 2 3 0 0 1\n", "7 columns, not 8 in FILE line 4; correct or restore the file"),
        (TUM + "1 1 2 x 0 0 0 1\n", "could not convert string to float: 'x' in FILE line 2; correct"),
        (TUM + "1 1 2 3 0 0 0 2\n", "the quaternion has norm 2, not 1 in FILE line 2; check the order of the columns"),
        ("1 0 0 0 0 1 0 0 0 0 2 0\n", "the pose is not a rotation and a translation at line 1 in FILE; give rigid"),
        (
            "0.5,0,0,0,1,0,0,0,0\n",
            "'0.5' is not a time in whole nanoseconds, as EuRoC's csv has in FILE line 1; correct",
        ),
        ("0 nan 2 3 0 0 0 1\n", "no poses in FILE; give at least one pose"),
        ("1,0,0,0,1,0,0,0\n2,0,0\n", "3 columns, not 8 in FILE line 2; correct or restore the file"),
        (b"\x89PNG\r\n\x1a\n\0\0\0", "not a text file in FILE; give a UTF-8 text file"),
        (b"0 1 2 3 \xff\xfe 0 0 1\n", "not a text file in FILE; give a UTF-8 text file"),
    ],
)
def test_faulty_pose_files_are_reported_by_line(tmp_path, text, message):
    assert message in refused(tmp_path / "poses.txt", text)


def test_a_missing_pose_file_is_reported(tmp_path):
    with pytest.raises(JaxmapError, match=r"there is no file .*none\.tum; check the path"):
        P.read_poses(tmp_path / "none.tum")
    with pytest.raises(JaxmapError, match="cannot be read"):
        P.read_poses(tmp_path)


def test_poses_that_cannot_be_written_are_reported(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(JaxmapError, match=r"poses\.tum"):
        P.write_tum(tmp_path / "file" / "poses.tum", np.zeros(1), np.eye(4)[None])


def test_times_are_read_one_per_line(tmp_path):
    path = tmp_path / "times.txt"
    path.write_text("# s\n0.5\n1e1\n")
    assert P.read_timestamps(path).tolist() == [0.5, 10.0]
    for text, message in (("1\n2 3\n", "2 columns, not 1"), ("1\ninf\n", "inf is not a time"), ("\n\nab\n", "line 3")):
        path.write_text(text)
        with pytest.raises(JaxmapError, match=message):
            P.read_timestamps(path)


@settings(max_examples=150)
@given(
    seed=seeds,
    start=st.sampled_from(["tum", "kitti", "euroc", "junk"]),
    edits=st.lists(st.tuples(st.integers(0, 400), st.binary(min_size=0, max_size=6)), min_size=1, max_size=4),
    length=st.integers(0, 400),
)
def test_corrupted_pose_files_read_or_are_refused(tmp_path_factory, seed, start, edits, length):
    T = random_poses(seed % 7, 3)
    q = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    rows = {
        "tum": "\n".join(" ".join(f"{x:.6g}" for x in [i, *T[i, :3, 3], *q[i]]) for i in range(3)),
        "kitti": "\n".join(" ".join(f"{x:.6g}" for x in T[i, :3].ravel()) for i in range(3)),
        "euroc": "\n".join(",".join([str(i), *(f"{x:.6g}" for x in [*T[i, :3, 3], *q[i]])]) for i in range(3)),
        "junk": "",
    }
    data = bytearray(rows[start].encode())
    for place, junk in edits:
        data[place : place + len(junk)] = junk
    path = tmp_path_factory.mktemp("junk") / "poses.txt"
    path.write_bytes(bytes(data[:length]))
    try:
        track = P.read_poses(path)
        assert_rigid(track.T[track.usable])
    except JaxmapError as fault:
        assert "\n" not in str(fault)


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "count", "child", "first_position"),
    [
        ("KITTI_00_gt.txt", 4541, "camera", (0, 0, 0)),
        ("freiburg1_xyz-groundtruth.txt", 3000, "camera", (1.3563, 0.6305, 1.6380)),
        ("georeferenced.tum", 1000, "camera", (458074.604, 5429380.172, 162.906)),
        ("V102_groundtruth.csv", 16702, "body", (0.515356, 1.996773, 0.971104)),
    ],
)
def test_real_pose_files_read(realdata, name, count, child, first_position):
    track = P.read_poses(realdata / "pose_formats" / name)
    assert (len(track.T), track.child) == (count, child)
    np.testing.assert_allclose(track.T[0, :3, 3], first_position, atol=1e-3)
    assert_rigid(track.T)
    steps_m = np.linalg.norm(np.diff(track.T[:, :3, 3], axis=0), axis=1)
    assert steps_m.max() < 10
    if track.timestamps_s is not None:
        assert track.timestamps_s[0] > 1.3e9
        assert np.diff(track.timestamps_s).max() < 10


@pytest.mark.realdata
def test_real_files_that_hold_no_poses_are_refused(realdata):
    with pytest.raises(JaxmapError, match="not a text file"):
        P.read_poses(realdata / "pose_formats" / "ROS_example.bag")
    with pytest.raises(JaxmapError, match="1 columns do not make a pose"):
        P.read_poses(realdata / "pose_formats" / "KITTI_00_gt_times.txt")


@pytest.mark.realdata
def test_a_georeferenced_track_gets_a_site_origin_and_comes_back(realdata, tmp_path):
    track = P.read_poses(realdata / "pose_formats" / "georeferenced.tum")
    relative, site_origin = P.split_site_origin(track.T)
    assert site_origin.tolist() == [458074, 5429380, 162]
    assert np.abs(relative[:, :3, 3]).max() < 5000
    P.write_tum(tmp_path / "again.tum", track.timestamps_s, track.T)
    again = P.read_poses(tmp_path / "again.tum")
    np.testing.assert_array_equal(again.timestamps_s, track.timestamps_s)
    np.testing.assert_array_equal(again.T[:, :3, 3], track.T[:, :3, 3])
    np.testing.assert_allclose(again.T, track.T, rtol=0, atol=1e-12)
