"""Estimated poses against the truth of simulated drives."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from rover_logs import (
    DRIVES,
    R_BODY_IMU,
    SITE_UTM_M,
    START_S,
    Drive,
    Sensors,
    Stretch,
    drive,
    gps_text,
    imu_text,
    odometry_text,
)
from scipy.spatial.transform import Rotation

from jaxmap.datasets.katwijk import read_gps, read_imu, read_wheels
from jaxmap.datasets.poses import make_pose_track, poses_at
from jaxmap.errors import JaxmapError
from jaxmap.evaluation.geometry_scores import PoseErrors, pose_errors
from jaxmap.localisation.estimate import estimate_poses, estimate_up, knot_times
from jaxmap.localisation.sensors import GpsFixes, ImuLog, RoverGeometry, WheelLog, in_gap, increments, time_to_nearest

GOOD_SENSORS = Sensors()
GEOMETRY = RoverGeometry(R_BODY_IMU @ np.array(Sensors().antenna_imu_m), height_m=0.543, turning_centre_m=-0.05)
T_BODY_IMU = np.eye(4)
T_BODY_IMU[:3, :3] = R_BODY_IMU
T_BODY_FRONT = np.eye(4)
T_BODY_FRONT[:3, 3] = [0.4, 0.1, 0.6]
"""A possible place of a camera on the rover."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("logs")


def recorded(folder: Path, truth: Drive, sensors=GOOD_SENSORS, seed=1) -> tuple[GpsFixes, ImuLog, WheelLog]:
    """The recordings of the simulated sensors, as the readers read them."""
    rng = np.random.default_rng(seed)
    (folder / "gps-latlong.txt").write_text(gps_text(truth, sensors, rng))
    (folder / "imu.txt").write_text(imu_text(truth, sensors, rng))
    (folder / "odometry.txt").write_text(odometry_text(truth, sensors, rng))
    gps, _ = read_gps(folder)
    wheels, _ = read_wheels(folder)
    assert wheels is not None
    return gps.fixes, read_imu(folder)[0], wheels


def errors(poses, truth: Drive, first_s=1.0, last_s=None, count=60) -> PoseErrors:
    times_s = np.linspace(first_s, last_s or truth.times_s[-1] - 1.5, count)
    times_s = truth.times_s[np.searchsorted(truth.times_s, times_s)]
    track = make_pose_track(poses.timestamps_s, poses.T_world_body)
    T, known = poses_at(track, START_S + times_s, max_gap_s=1.0)
    assert known.all()
    return pose_errors(T @ T_BODY_FRONT, truth.at(times_s) @ T_BODY_IMU @ T_BODY_FRONT, T_BODY_FRONT)


def assert_within(found: PoseErrors, position_m=0.05, heading_deg=1.5, tilt_deg=1.0) -> None:
    assert found.position_m.max() < position_m
    assert found.heading_deg.max() < heading_deg
    assert max(found.roll_deg.max(), found.pitch_deg.max()) < tilt_deg


@pytest.mark.parametrize("kind", DRIVES)
def test_poses_are_near_the_truth_on_every_kind_of_drive(folder, kind):
    # Headings start near south-west, so that several of these pass through 180 degrees.
    truth = drive(DRIVES[kind], seed=3, heading_rad=-2.9)
    poses = estimate_poses(*recorded(folder, truth), GEOMETRY)
    assert_within(errors(poses, truth))
    assert poses.heading_sigma_rad < np.radians(2)
    assert poses.outliers == 0


stretches = st.builds(
    Stretch,
    seconds=st.floats(3, 12),
    speed_m_s=st.sampled_from([0.0, 0.15, 0.3, 0.4, -0.2]),
    turn_rad_s=st.sampled_from([-1.0, 0.0, 1.0]).flatmap(
        lambda side: st.floats(0.03, 0.15).map(lambda rate: side * rate)
    ),
)


# Shrinking would take minutes.
@settings(max_examples=4, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(
    middle=st.lists(stretches, min_size=2, max_size=6), heading_rad=st.floats(-np.pi, np.pi), seed=st.integers(0, 99)
)
def test_poses_are_near_the_truth_on_any_drive(folder, middle, heading_rad, seed):
    truth = drive([Stretch(3, 0), Stretch(20), *middle, Stretch(20)], seed, heading_rad)
    found = errors(estimate_poses(*recorded(folder, truth, seed=seed), GEOMETRY), truth)
    assert_within(found, position_m=0.06)


@pytest.mark.parametrize(
    "sensors",
    [
        Sensors(gyro_bias=(0.01, -0.01, 0.01)),
        Sensors(slip=0.15, wheel_radius_m=0.13),
        Sensors(gps_every_s=1.0, gps_sigma_m=(0.02, 0.02, 0.03)),
        Sensors(force_sigma=0.2, gyro_sigma=0.006),
    ],
    ids=["gyro bias", "slip and larger wheels", "frequent worse GPS", "noisy IMU"],
)
def test_worse_sensors_are_tolerated(folder, sensors):
    truth = drive(DRIVES["all of it"], seed=5)
    assert_within(errors(estimate_poses(*recorded(folder, truth, sensors), GEOMETRY), truth), position_m=0.06)


@pytest.fixture(scope="module")
def winding(folder) -> tuple[Drive, tuple[GpsFixes, ImuLog, WheelLog]]:
    truth = drive(DRIVES["all of it"], seed=2)
    return truth, recorded(folder, truth)


def test_moving_and_turning_the_world_moves_and_turns_the_poses(winding):
    _, (fixes, imu, wheels) = winding
    poses = estimate_poses(fixes, imu, wheels, GEOMETRY)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", 2.0).as_matrix()
    centred = fixes._replace(antenna_world_m=fixes.antenna_world_m - SITE_UTM_M)
    there = centred._replace(antenna_world_m=centred.antenna_world_m @ T[:3, :3].T + [10, -20, 3])
    T[:3, 3] = [10, -20, 3]
    moved = estimate_poses(there, imu, wheels, GEOMETRY)
    expected = poses.T_world_body.copy()
    expected[:, :3, 3] -= SITE_UTM_M
    np.testing.assert_allclose(moved.T_world_body, T @ expected, atol=1e-6)


def test_another_clock_gives_the_same_poses(winding):
    _, (fixes, imu, wheels) = winding
    poses = estimate_poses(fixes, imu, wheels, GEOMETRY)
    logs = [log._replace(timestamps_s=log.timestamps_s - START_S) for log in (fixes, imu, wheels)]
    shifted = estimate_poses(*logs, GEOMETRY)
    np.testing.assert_allclose(shifted.timestamps_s + START_S, poses.timestamps_s, atol=1e-6)
    np.testing.assert_allclose(shifted.T_world_body, poses.T_world_body, atol=1e-5)


def test_a_stray_fix_counts_less(winding):
    truth, (fixes, imu, wheels) = winding
    antenna = fixes.antenna_world_m.copy()
    antenna[7] += [4.0, -3.0, 6.0]
    poses = estimate_poses(fixes._replace(antenna_world_m=antenna), imu, wheels, GEOMETRY)
    assert poses.outliers >= 1
    assert_within(errors(poses, truth), position_m=0.1)


def test_fixes_count_by_their_sigma(winding):
    truth, (fixes, imu, wheels) = winding
    rng = np.random.default_rng(4)
    antenna, sigma = fixes.antenna_world_m.copy(), fixes.sigma_m.copy()
    antenna[::3] += rng.normal(size=antenna[::3].shape)
    sigma[::3] = 1.0
    poses = estimate_poses(fixes._replace(antenna_world_m=antenna, sigma_m=sigma), imu, wheels, GEOMETRY)
    assert_within(errors(poses, truth), position_m=0.08)


def test_wheels_and_gyro_carry_the_poses_through_a_gap_of_gps(winding):
    truth, (fixes, imu, wheels) = winding
    kept = np.abs(fixes.timestamps_s - START_S - 20) > 7
    poses = estimate_poses(GpsFixes(*(values[kept] for values in fixes)), imu, wheels, GEOMETRY)
    assert_within(errors(poses, truth), position_m=0.3)


def test_without_wheels_positions_are_a_little_worse(winding):
    truth, (fixes, imu, _) = winding
    poses = estimate_poses(fixes, imu, None, GEOMETRY)
    assert np.isnan(poses.wheel_scale)
    assert_within(errors(poses, truth), position_m=0.2)


def test_a_gap_of_the_imu_holds_no_poses_and_spoils_none_outside(winding):
    truth, (fixes, imu, wheels) = winding
    start_s, end_s = START_S + 30.0, START_S + 36.0
    kept = (imu.timestamps_s < start_s) | (imu.timestamps_s > end_s)
    poses = estimate_poses(fixes, ImuLog(*(values[kept] for values in imu)), wheels, GEOMETRY)
    assert not ((poses.timestamps_s > start_s + 0.01) & (poses.timestamps_s < end_s - 0.01)).any()
    assert_within(errors(poses, truth, last_s=29), position_m=0.06, heading_deg=2)
    assert_within(errors(poses, truth, first_s=37), position_m=0.06, heading_deg=2)


def test_a_gap_of_the_wheels_is_bridged(winding):
    truth, (fixes, imu, wheels) = winding
    kept = np.abs(wheels.timestamps_s - START_S - 12) > 4
    poses = estimate_poses(fixes, imu, WheelLog(*(values[kept] for values in wheels)), GEOMETRY)
    assert_within(errors(poses, truth), position_m=0.15)


def test_a_rover_that_stands_has_no_heading(folder):
    truth = drive([Stretch(20, 0)])
    with pytest.raises(JaxmapError, match=r"heading unobservable, .* give a recording"):
        estimate_poses(*recorded(folder, truth), GEOMETRY)


def test_recordings_of_different_drives_are_reported(winding):
    _, (fixes, imu, wheels) = winding
    later = fixes._replace(timestamps_s=fixes.timestamps_s + 1e4)
    with pytest.raises(JaxmapError, match="0 GPS fixes lie within the times of the IMU, 2 are needed in part; check"):
        estimate_poses(later, imu, wheels, GEOMETRY, where="part")
    with pytest.raises(JaxmapError, match="2 samples of the IMU lie near"):
        estimate_poses(fixes, ImuLog(*(values[:2] for values in imu)), wheels, GEOMETRY)


times = st.lists(st.floats(0, 100, width=32), min_size=2, max_size=30, unique=True).map(lambda values: np.sort(values))


@given(timestamps_s=times, at_s=times)
def test_times_to_the_nearest_and_gaps(timestamps_s, at_s):
    apart = np.abs(timestamps_s[:, None] - at_s)
    np.testing.assert_array_equal(time_to_nearest(timestamps_s, at_s), apart.min(axis=0))
    for time_s, gap in zip(at_s, in_gap(timestamps_s, at_s), strict=True):
        before, after = timestamps_s[timestamps_s <= time_s], timestamps_s[timestamps_s >= time_s]
        bridged = len(before) and len(after) and after[0] - before[-1] <= 0.5
        assert gap == (not bridged)


@given(timestamps_s=times, knots_s=times)
def test_increments_add_up(timestamps_s, knots_s):
    values = np.cos(timestamps_s)
    whole = increments(timestamps_s, values, np.array([knots_s[0], knots_s[-1]]))
    np.testing.assert_allclose(increments(timestamps_s, values, knots_s).sum(), whole[0], atol=1e-9)


@given(imu_s=times, fixes_s=times)
def test_knots_hold_every_fix_and_lie_apart(imu_s, fixes_s):
    knots_s = knot_times(imu_s, fixes_s)
    assert np.isin(fixes_s, knots_s).all()
    assert np.isin(knots_s, np.concatenate([imu_s, fixes_s])).all()
    assert (np.diff(knots_s) > 0).all()


def test_up_is_where_the_inclinometer_points_and_unknown_outside_its_times():
    times_s = np.arange(0, 10, 0.01)
    up = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
    imu = ImuLog(times_s, np.zeros((len(times_s), 3)), np.tile(9.81 * up, (len(times_s), 1)))
    found = estimate_up(imu, None, np.array([-1.0, 0.5, 3.0, 11.0]))
    np.testing.assert_allclose(found[1:3], [up, up], atol=1e-3)
    assert np.isnan(found[[0, 3]]).all()
    assert np.isnan(estimate_up(imu, None, np.array([20.0]))).all()
