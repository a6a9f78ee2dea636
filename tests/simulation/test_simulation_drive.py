"""The drive, its cameras and its sensors: what the files say integrates back to where the rover was."""

from __future__ import annotations

import calendar
import re

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxmap.errors import JaxmapError
from jaxmap.simulation.camera_rig import (
    GPS_ANTENNA_BODY_M,
    T_BODY_LEFT_POSITION_M,
    body_from_left,
    distorted,
    left_from_right,
    loccam,
    scaled,
    undistorted_pixels,
)
from jaxmap.simulation.draw import draw_world
from jaxmap.simulation.drive import STANDSTILL_S, Drive, make_path
from jaxmap.simulation.rover import rover_mesh
from jaxmap.simulation.sensors import WHEEL_RADIUS_M, time_stamp, true_motion, write_sensors
from jaxmap.simulation.terrain import Ground
from jaxmap.simulation.world import WHEEL_FEEL_M, bare_ground
from jaxmap.stereo.rectify import make_rectifier


def drive_of(seed: int, length_m: float = 4.0) -> Drive:
    recipe = draw_world(seed, "random")
    ground = Ground(recipe.relief, recipe.sand, recipe.backdrop)
    return Drive(recipe.drive, make_path(recipe.drive, length_m), length_m, bare_ground(ground, WHEEL_FEEL_M))


@pytest.fixture(scope="module")
def drive() -> Drive:
    return drive_of(17)


@pytest.fixture(scope="module")
def sensors(drive, tmp_path_factory) -> dict[str, list[list[str]]]:
    folder = tmp_path_factory.mktemp("part")
    write_sensors(folder, drive, seed=3)
    return {path.stem: [line.split(" ") for line in path.read_text().splitlines()] for path in folder.iterdir()}


def unix_s(stamp: str) -> float:
    *fields, milliseconds = map(int, stamp.split("_"))
    return calendar.timegm((*fields, 0, 0, 0)) + milliseconds / 1000


@given(milliseconds=st.integers(0, 2_000_000_000_000))
def test_time_stamps_read_back(milliseconds):
    stamp = time_stamp(milliseconds / 1000)
    assert round(unix_s(stamp) * 1000) == milliseconds
    assert stamp.rsplit("_", 1)[1] == str(milliseconds % 1000)


def test_the_rover_stands_drives_and_stands(drive):
    times = np.linspace(0, drive.duration_s, 4000)
    arc = drive.arc_m(times)
    assert np.diff(arc).min() > -1e-6
    assert arc[times < STANDSTILL_S].max() < 1e-6
    assert arc[-1] == pytest.approx(drive.length_m, abs=1e-3) and arc[times > times[-1] - 1].min() > arc[-1] - 1e-3
    speed = np.diff(arc) / np.diff(times)
    assert speed.max() == pytest.approx(drive.recipe.speed_m_s, rel=0.01)


def test_frames_lie_where_they_were_asked_for(drive):
    places = np.array([0.1, 1.0, 2.5])
    times = drive.times_at(places)
    assert np.abs(drive.arc_m(times) - places).max() < 1e-3
    assert np.array_equal(np.round(times, 3), times)


@given(seed=st.integers(0, 2**31 - 1))
def test_poses_are_rigid_and_stand_on_the_ground(seed):
    drive = drive_of(seed, 2.0)
    T = drive.T_world_body(np.linspace(0, drive.duration_s, 50))
    R = T[:, :3, :3]
    assert np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() < 1e-9 and np.linalg.det(R).min() > 0.999
    assert R[:, 2, 2].min() > np.cos(np.deg2rad(35))
    # Backward is against the direction of travel, and right is on the right.
    heading = drive.path.heading_rad[0]
    forward = np.array([np.cos(heading), np.sin(heading), 0])
    assert -R[0, :, 0] @ forward > 0.8
    assert R[0, :, 1] @ [np.sin(heading), -np.cos(heading), 0] > 0.8


def test_the_camera_looks_ahead_and_down():
    T = body_from_left()
    forward = T[:3, 2]
    assert np.rad2deg(np.arcsin(-forward[2])) == pytest.approx(17.95, abs=0.02)
    assert forward[0] < -0.9 and np.abs(T[:3, 0] - (0, 1, 0)).max() < 1e-3
    assert np.array_equal(T[:3, 3], T_BODY_LEFT_POSITION_M)


def test_the_pair_rectifies_as_the_data_set_does():
    rectifier = make_rectifier(loccam())
    assert float(rectifier.camera.fx_px) == pytest.approx(784.97, abs=0.01)
    assert float(rectifier.camera.baseline_m) == pytest.approx(0.120079, abs=1e-6)
    assert left_from_right(loccam())[0, 3] == pytest.approx(0.12, abs=0.001)


def test_every_pixel_of_the_lens_is_undistorted_and_back():
    rig = scaled(loccam(), 128)
    rays = undistorted_pixels(rig.K_left, rig.distortion_left, rig.width_px, rig.height_px)
    points = np.concatenate([rays, np.ones_like(rays[:1])]).reshape(3, -1).T
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), rig.K_left, rig.distortion_left)[0].reshape(-1, 2)
    v, u = np.mgrid[0 : rig.height_px, 0 : rig.width_px]
    assert np.abs(pixels - np.stack([u.ravel(), v.ravel()], axis=1)).max() < 1e-6


@given(x=st.floats(-0.5, 0.5), y=st.floats(-0.5, 0.5), p=st.floats(-0.01, 0.01), k3=st.floats(-0.02, 0.02))
def test_the_lens_bends_rays_as_opencv_does(x, y, p, k3):
    coefficients = np.array([-0.36, 0.17, p, -p / 2, k3])
    bent = distorted(np.array([[x], [y]]), coefficients)[:, 0]
    theirs = cv2.projectPoints(np.array([[x, y, 1.0]]), np.zeros(3), np.zeros(3), np.eye(3), coefficients)[0].ravel()
    assert np.abs(bent - theirs).max() < 1e-12


def test_a_lens_that_folds_is_refused():
    with pytest.raises(JaxmapError, match="folds"):
        undistorted_pixels(np.diag([50.0, 50.0, 1.0]), np.array([-3.0, 0.0, 0.0, 0.0]), 96, 96)


def test_a_smaller_image_sees_the_same():
    whole, half = loccam(), scaled(loccam(), 512)
    assert (half.width_px, half.height_px) == (512, 384)
    corner = np.array([-0.5, -0.5, 1.0])
    for K_whole, K_half in ((whole.K_left, half.K_left), (whole.K_right, half.K_right)):
        assert np.allclose(np.linalg.inv(K_whole) @ corner, np.linalg.inv(K_half) @ corner)


def test_the_body_is_behind_the_cameras():
    T_left_body = np.linalg.inv(body_from_left())
    vertices = rover_mesh().vertices_m.astype(np.float64)
    depth = (vertices @ T_left_body[:3, :3].T + T_left_body[:3, 3])[:, 2]
    above = vertices[:, 2] > T_BODY_LEFT_POSITION_M[2] - 0.2
    assert depth[above].max() < 0.35


def test_sensor_files_have_the_columns_and_rates_of_the_data_set(sensors, drive):
    assert {name: len(rows[0]) for name, rows in sensors.items()} == {
        "gps-latlong": 8,
        "imu": 10,
        "odometry": 34,
        "ptu": 3,
    }
    for name, period_s in (("gps-latlong", 3.0), ("imu", 0.008), ("odometry", 0.08), ("ptu", 0.1)):
        rows = sensors[name]
        times = np.array([unix_s(row[0]) for row in rows])
        assert np.diff(times) == pytest.approx(period_s, abs=0.0011)
        assert times[0] == pytest.approx(drive.recipe.start_time_s, abs=1e-3)
        assert all(re.fullmatch(r"RTK_FIXED|-?\d+(\.\d+)?", word) for row in rows for word in row[1:])


def test_gps_tells_where_the_antenna_was(sensors, drive):
    from rasterio.warp import transform

    rows = sensors["gps-latlong"]
    latitude, longitude, altitude = (np.array([float(row[column]) for row in rows]) for column in (2, 3, 4))
    east, north = map(np.array, transform("EPSG:4326", "EPSG:32631", longitude, latitude)[:2])
    measured = np.stack([east, north, altitude], axis=1) - drive.recipe.site_utm_m
    T = drive.T_world_body(np.array([unix_s(row[0]) for row in rows]) - drive.recipe.start_time_s)
    error = measured - (T[:, :3, :3] @ np.array(GPS_ANTENNA_BODY_M) + T[:, :3, 3])
    assert 0.001 < np.abs(error[:, :2]).mean() < 0.03 and np.abs(error).max() < 0.1
    assert all(row[1] == "RTK_FIXED" and 0.004 < float(row[5]) < 0.02 for row in rows)


def test_turn_rates_integrate_to_the_attitude(drive):
    times = np.arange(0, drive.duration_s, 0.008)
    rate = true_motion(drive, times)[1]
    R = drive.T_world_body(times)[:, :3, :3]
    turned = Rotation.from_matrix(R[0])
    for turn in rate[:-1] * 0.008:
        turned = turned * Rotation.from_rotvec(turn)
    assert (turned.inv() * Rotation.from_matrix(R[-1])).magnitude() < np.deg2rad(0.3)


def test_the_inclinometer_tells_roll_and_pitch_at_rest(sensors, drive):
    rows = [row for row in sensors["imu"] if unix_s(row[0]) - drive.recipe.start_time_s < STANDSTILL_S]
    force = np.array([[float(word) for word in row[7:]] for row in rows]).mean(axis=0)
    up_body = drive.T_world_body(np.array([0.0]))[0][:3, :3].T @ [0, 0, 1]
    assert np.rad2deg(np.arccos(force @ up_body / np.linalg.norm(force))) < 0.5
    assert np.linalg.norm(force) == pytest.approx(9.81, abs=0.1)


def test_wheels_tell_the_distance_driven(sensors, drive):
    rows = sensors["odometry"]
    angles = np.array([[float(row[1 + 3 * wheel]) for wheel in range(6)] for row in rows])
    driven = (angles[-1] - angles[0]).mean() * WHEEL_RADIUS_M
    assert driven == pytest.approx(drive.length_m, rel=0.06)
    rates = np.array([[float(row[2 + 3 * wheel]) for wheel in range(6)] for row in rows])
    assert np.abs(rates.mean(axis=0) * len(rows) * 0.08 - (angles[-1] - angles[0])).max() < 1.5


def test_sensor_files_are_the_same_for_the_same_seed(drive, tmp_path):
    for folder, seed in (("a", 1), ("b", 1), ("c", 2)):
        write_sensors(tmp_path / folder, drive, seed)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()
    assert (tmp_path / "a" / "imu.txt").read_bytes() != (tmp_path / "c" / "imu.txt").read_bytes()
