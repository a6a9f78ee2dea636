"""Which convention of poses agrees with measured motions: wrong readings are told, right ones are left alone."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxmap.checks.motions import Motion, angle_deg, choose_steps, ground_normal
from jaxmap.checks.pose_convention import pose_convention, pose_findings
from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.datasets.pose_axes import (
    T_CHILD_CAMERA,
    T_Z_UP_SOURCE,
    PoseReading,
    rigid_inverse,
    with_other_quaternions,
)
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import StereoOptions
from jaxmap.types import make_stereo_camera

DEPTH_M, PITCH_DEG = 3.0, 18.0


def drive(seed: int, count: int = 8, step_m: float = 0.4) -> np.ndarray:
    """A rover that turns left and right on gentle slopes, its camera pitched down; T_world_camera, z up."""
    rng = np.random.default_rng(seed)
    yaw = rng.uniform(0, 360) + np.cumsum(rng.choice([-6.0, -4.0, 4.0, 6.0], count))
    pitch, roll = rng.normal(0, 3, (2, count))
    level = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1), degrees=True)
    T = np.tile(np.eye(4), (count, 1, 1))
    down = Rotation.from_euler("y", PITCH_DEG, degrees=True).as_matrix()
    T[:, :3, :3] = level.as_matrix() @ down @ T_CHILD_CAMERA["body"][:3, :3]
    T[:, :3, 3] = np.cumsum(step_m * level.as_matrix()[:, :, 0], axis=0)
    T[:, :3, 3] += 2.0, 1.0, 1.1
    return T


def seen(T: np.ndarray, noise: float = 0.01, seed: int = 0) -> list[Motion]:
    """Motions between neighbours, with errors of so many metres and radians."""
    rng = np.random.default_rng(seed)
    motions = []
    for i, T_i_j in enumerate(rigid_inverse(T[:-1]) @ T[1:]):
        measured = T_i_j.copy()
        measured[:3, :3] = measured[:3, :3] @ Rotation.from_rotvec(rng.normal(0, noise / 5, 3)).as_matrix()
        measured[:3, 3] += rng.normal(0, noise, 3)
        motions.append(Motion(i, i + 1, measured, 200, DEPTH_M))
    return motions


def normals_of(T: np.ndarray) -> list[tuple[int, np.ndarray]]:
    return [(i, R.T[:, 2]) for i, R in enumerate(T[:, :3, :3])]


WRONG = [
    PoseReading(*fields)
    for fields in product(T_CHILD_CAMERA, T_Z_UP_SOURCE, ("T_world_camera", "T_camera_world"), ("xyzw", "wxyz"))
    if fields != PoseReading()
]


def misread(T: np.ndarray, truth: PoseReading) -> np.ndarray:
    """What poses that mean T become when a file of other conventions is read by the defaults."""
    return with_other_quaternions(truth.file_poses(T_Z_UP_SOURCE[truth.poses_world].T @ T), truth.quaternion, "xyzw")


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1), truth=st.sampled_from(WRONG))
def test_a_wrong_reading_is_told_with_options_under_which_all_agrees(seed, truth):
    T = drive(seed)
    found = pose_convention(misread(T, truth), seen(T), normals_of(T))
    assert [finding.kind for finding in found] == ["pose-convention"]
    assert found[0].stops
    # Once in a while fewer changes fit nearly as well; they are as level and move alike.
    options = {
        words[0]: words[1] for words in (option.split() for option in found[0].fix.split(" or ")[0][2:].split(" --"))
    }
    named = {name.replace("-", "_"): value for name, value in options.items()}
    again = PoseReading()._replace(**named)
    T_file = with_other_quaternions(misread(T, truth), "xyzw", again.quaternion)
    read = T_Z_UP_SOURCE[again.poses_world] @ again.camera_poses(T_file)
    assert not pose_convention(read, seen(T), normals_of(T))


@pytest.mark.parametrize(
    ("truth", "fix"),
    [
        (PoseReading(poses_world="z_down"), "--poses-world z_down"),
        (PoseReading(poses_world="y_up"), "--poses-world y_up"),
        (PoseReading(poses_world="camera"), "--poses-world camera"),
        (PoseReading("body"), "--pose-convention body"),
        (PoseReading("opengl"), "--pose-convention opengl"),
        (PoseReading("opengl", "y_up"), "--pose-convention opengl --poses-world y_up"),
        (PoseReading("frd", "z_down"), "--pose-convention frd --poses-world z_down"),
        (PoseReading(poses_are="T_camera_world"), "--poses-are T_camera_world"),
        (PoseReading(quaternion="wxyz"), "--quaternion wxyz"),
    ],
)
def test_the_options_of_common_conventions_are_named(truth, fix):
    T = drive(3)
    (finding,) = pose_convention(misread(T, truth), seen(T), normals_of(T))
    assert finding.fix == fix
    assert finding.confidence > 0.8


def test_an_option_that_does_harm_is_taken_back():
    T = drive(3)
    used = PoseReading("body", "z_down")
    read = T_Z_UP_SOURCE["z_down"] @ used.camera_poses(T)
    (finding,) = pose_convention(read, seen(T), normals_of(T), reading=used)
    assert finding.fix == "--pose-convention optical --poses-world z_up"


@given(
    seed=st.integers(0, 2**32 - 1),
    step_m=st.sampled_from([0.0, 0.05, 0.4, 1.5]),
    pose_noise=st.sampled_from([0.0, 0.01, 0.05]),
    count=st.integers(1, 8),
)
@settings(max_examples=15)
def test_right_poses_are_left_alone(seed, step_m, pose_noise, count):
    T = drive(seed, count, step_m)
    rng = np.random.default_rng(seed)
    given_T = T.copy()
    given_T[:, :3, 3] += rng.normal(0, pose_noise * step_m, (count, 3))
    for normals in ([], normals_of(T)):
        assert not pose_convention(given_T, seen(T, noise=0.005), normals)


def test_cameras_that_look_down_hang_or_face_a_wall_are_believed():
    T = drive(1)
    looks_down = T.copy()
    looks_down[:, :3, :3] = T[:, :3, :3] @ Rotation.from_euler("x", -(90 - PITCH_DEG), degrees=True).as_matrix()
    assert not pose_convention(looks_down, seen(looks_down))
    assert not pose_convention(looks_down, seen(looks_down), normals_of(looks_down))
    hangs = T.copy()
    hangs[:, :3, :3] = T[:, :3, :3] @ np.diag([-1.0, -1.0, 1.0])
    assert not pose_convention(hangs, seen(hangs), normals_of(hangs))
    assert not pose_convention(T, seen(T), [(0, np.array([0.0, 0.0, -1.0]))])


def test_poses_alone_tell_of_cameras_on_their_heads_with_less_confidence():
    T = drive(1)
    (finding,) = pose_convention(misread(T, PoseReading(poses_world="z_down")), [])
    assert "stand on their heads" in finding.what
    assert "--poses-world z_down" in finding.fix
    assert finding.confidence < 0.5


def test_units_of_baseline_and_poses_are_told_by_the_lengths_of_steps():
    T = drive(2)
    in_mm = T.copy()
    in_mm[:, :3, 3] *= 1000
    (finding,) = pose_convention(in_mm, seen(T), normals_of(T), baseline_m=0.2)
    assert (finding.kind, finding.fix) == ("scale", "--poses-unit mm")
    long = [motion._replace(T_i_j=_scaled(motion.T_i_j, 100), depth_m=100 * DEPTH_M) for motion in seen(T)]
    (finding,) = pose_convention(T, long, normals_of(T), baseline_m=20.0)
    assert (finding.kind, finding.fix, finding.stops) == ("scale", "--baseline-unit cm", True)
    odd = T.copy()
    odd[:, :3, 3] *= 7
    (finding,) = pose_convention(odd, seen(T), normals_of(T), baseline_m=0.2)
    assert "a single camera" in finding.fix


def _scaled(T: np.ndarray, factor: float) -> np.ndarray:
    scaled = T.copy()
    scaled[:3, 3] *= factor
    return scaled


def test_a_camera_that_is_pitched_on_the_body_of_the_poses_is_told_with_its_mounting():
    T = drive(2)
    pitched = np.eye(4)
    pitched[:3, :3] = Rotation.from_euler("x", -PITCH_DEG, degrees=True).as_matrix()
    T_world_level = T @ pitched.T
    body = T_world_level @ T_CHILD_CAMERA["body"].T
    convention, mounting = pose_convention(body, seen(T), normals_of(T))
    assert (convention.fix, mounting.kind, mounting.stops) == ("--pose-convention body", "camera-mounting", True)
    assert "(+18 down)" in mounting.what
    vector = np.array(mounting.fix.split("rotation_vector_rad: [")[1].split("]")[0].split(", "), float)
    np.testing.assert_allclose(vector, [-np.radians(PITCH_DEG), 0, 0], atol=0.03)
    (alone,) = pose_convention(T_world_level, seen(T), normals_of(T), reading=PoseReading("body"))
    assert alone.fix == mounting.fix


def test_a_principal_point_that_turns_the_view_by_some_degrees_is_told():
    T = drive(2)
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("xy", [5, 5], degrees=True).as_matrix()
    (found,) = pose_convention(T @ turned, seen(T), normals_of(T))
    assert (found.kind, found.stops) == ("camera-mounting", False)
    assert "principal point" in found.fix


def test_poses_of_another_drive_disagree_by_no_convention():
    found = pose_convention(drive(5), seen(drive(6)[:, :, [1, 2, 0, 3]] @ np.eye(4)), [])
    assert all(finding.kind in ("poses-disagree", "pose-convention") for finding in found)
    assert found


def test_steps_are_spread_and_take_the_sharpest_turns():
    T = drive(4, count=30)
    steps = choose_steps(T, 5)
    assert len(steps) == 5
    assert steps == sorted(set(steps))
    assert all(0 <= i < j < 30 for i, j in steps)
    assert choose_steps(T[:1], 5) == []
    still = np.tile(T[:1], (30, 1, 1))
    assert choose_steps(still, 1) == [(0, 10)]


def test_the_normal_of_a_plane_points_to_the_camera():
    camera = make_stereo_camera(fx_px=200.0, cx_px=99.5, cy_px=74.5, baseline_m=0.2, width_px=200, height_px=150)
    normal = Rotation.from_euler("x", 20, degrees=True).as_matrix() @ [0, -1, 0]
    v, u = np.mgrid[0:150, 0:200]
    rays = np.stack([(u - 99.5) / 200, (v - 74.5) / 200, np.ones(u.shape)], axis=-1)
    disparity_px = (200 * 0.2 / np.maximum(-1.0 / np.minimum(rays @ normal, -1e-6), 1e-6)).astype(np.float32)
    disparity_px[rays @ normal > -0.01] = np.nan
    found = ground_normal(camera, disparity_px)
    assert found is not None
    np.testing.assert_allclose(found, normal, atol=1e-3)
    assert ground_normal(camera, np.full((150, 200), np.nan, np.float32)) is None


def findings_of(source, **options):
    sequence = open_sequence(source, ReadOptions(**options))
    return pose_findings(sequence, StereoFrontEnd(sequence.camera, StereoOptions()), steps=1)


def test_angles_of_rotations():
    turns = Rotation.from_euler("z", [[0], [30], [180]], degrees=True).as_matrix()
    np.testing.assert_allclose(angle_deg(turns), [0, 30, 180], atol=1e-6)


@pytest.mark.slow
def test_the_bundled_drive_agrees_with_its_images():
    sequence = open_sequence("sample:traverse")
    assert not pose_findings(sequence, StereoFrontEnd(sequence.camera, StereoOptions()))


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("case", "options", "fix"),
    [
        ("01-world-z-down", {"poses": "poses.tum"}, "--poses-world z_down"),
        ("02-pose-of-body-axes", {"poses": "poses.tum"}, "--pose-convention body"),
        ("14-baseline-in-mm", {"calibration": "camera_mm.yaml"}, "--baseline-unit mm"),
    ],
)
def test_cases_name_the_option_that_mends_them(realdata, case, options, fix):
    folder = realdata.parent / "cases" / case
    wrong = {name: folder / file for name, file in options.items()}
    assert [finding.fix for finding in findings_of(folder / "seq", **wrong)] == [fix]
    assert not findings_of(folder / "seq")
    name, value = fix[2:].split()
    assert not findings_of(folder / "seq", **wrong, **{name.replace("-", "_"): value})
