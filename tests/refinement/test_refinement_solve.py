"""Least squares over rigs: derivatives, what matches recover, and what keeps its prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from refinement.synthetic import (
    CAMERA,
    HEIGHT_M,
    disturbed,
    ground_height,
    ground_points,
    match_term,
    matches_of,
    pose_errors,
    track,
    uvd_px,
)
from scipy.spatial.transform import Rotation

from jaxmap.errors import JaxmapError
from jaxmap.refinement.frames import PixelSamples
from jaxmap.refinement.ground import GroundRaster, ground_contact, height_term
from jaxmap.refinement.residuals import linearise, make_device_rig
from jaxmap.refinement.rig import displacement, make_rig, moved, vehicle_axes
from jaxmap.refinement.solver import Prior, solve

T_TRUE = track()
POSES = Prior(position_m=0.12, angle_rad=np.radians(0.6))


def aligned(T: np.ndarray) -> np.ndarray:
    """The path turned and shifted, as a whole, to the true one."""
    here, there = T[:, :3, 3], T_TRUE[:, :3, 3]
    turn, _ = Rotation.align_vectors(
        np.concatenate([there - there.mean(axis=0), *(T_TRUE[:, :3, k] for k in range(3))]),
        np.concatenate([here - here.mean(axis=0), *(T[:, :3, k] for k in range(3))]),
    )
    G = np.eye(4)
    G[:3, :3] = turn.as_matrix()
    G[:3, 3] = there.mean(axis=0) - turn.apply(here.mean(axis=0))
    return G @ T


def heights(cell_m: float = 0.05) -> GroundRaster:
    lower, shape = np.array([-1.0, -4.0]), (280, 160)
    x, y = (lower[axis] + (np.arange(shape[axis]) + 0.5) * cell_m for axis in (0, 1))
    return GroundRaster(ground_height(*np.meshgrid(x, y, indexing="ij")), lower, cell_m)


def ground_seen(T: np.ndarray, rng: np.random.Generator) -> PixelSamples:
    points = ground_points(3000, rng)
    frames, seen = [], []
    for index, one in enumerate(T):
        pixels = uvd_px(one, points)
        rows = np.flatnonzero(np.isfinite(pixels).all(axis=1))[:150]
        frames.append(np.full(len(rows), index))
        seen.append(pixels[rows])
    return PixelSamples(np.concatenate(frames), np.concatenate(seen))


def test_true_poses_leave_no_residual():
    matches = matches_of(T_TRUE, np.random.default_rng(0))
    part = linearise(make_device_rig(make_rig(T_TRUE), CAMERA, np.zeros(3)), matches.frames, matches.uvd_px)
    assert np.abs(part.residual).max() < 2e-2


def test_derivatives_equal_finite_differences():
    rng = np.random.default_rng(1)
    matches = matches_of(T_TRUE, rng, count=60)
    rig = moved(make_rig(disturbed(T_TRUE, rng, 0.1, 1.0)), rng.normal(0, 0.01, 6 * len(T_TRUE) + 8))

    def at(rig):
        return linearise(make_device_rig(rig, CAMERA, np.zeros(3)), matches.frames, matches.uvd_px)

    part, step = at(rig), 1e-3 * rng.normal(size=6 * len(T_TRUE) + 8)
    slope = (at(moved(rig, step)).residual - at(moved(rig, -step)).residual) / 2
    own = step[:-8].reshape(-1, 6)[matches.frames]
    ours = np.einsum("mrfk,mfk->mr", part.by_frames, own) + part.by_shared @ step[-8:]
    np.testing.assert_allclose(ours, slope, atol=2e-2 * np.abs(slope).max())
    pixels = matches.uvd_px.copy()
    pixels[:, 0, 2] += 0.01
    more = linearise(make_device_rig(rig, CAMERA, np.zeros(3)), matches.frames, pixels).residual - part.residual
    np.testing.assert_allclose(0.01 * part.by_disparity, more, atol=2e-2 * np.abs(more).max())


def test_a_step_and_the_displacement_undo_each_other():
    rng = np.random.default_rng(2)
    given = make_rig(T_TRUE)
    step = 0.02 * rng.normal(size=6 * len(T_TRUE) + 8)
    np.testing.assert_allclose(displacement(moved(given, step), given), step, atol=1e-9)


def test_frames_agree_again_and_the_whole_stays_where_the_given_poses_are_in_the_mean():
    rng = np.random.default_rng(3)
    given = make_rig(disturbed(T_TRUE, rng, 0.2, 1.0))
    found = solve(given, given, [match_term(matches_of(T_TRUE, rng, 0.2))], POSES)
    errors = pose_errors(aligned(found.rig.T_world_camera), T_TRUE)
    assert errors.position_m.max() < 0.01
    assert errors.angle_deg.max() < 0.05
    assert found.residuals_px[-1] < 0.05 * found.residuals_px[0]
    mean = displacement(found.rig, given)[:-8].reshape(-1, 6)[:, :3].mean(axis=0)
    np.testing.assert_allclose(mean, 0, atol=1e-3)


@pytest.mark.slow
def test_an_elevation_model_puts_it_all_in_its_place():
    rng = np.random.default_rng(4)
    given = make_rig(disturbed(T_TRUE, rng, 0.2, 1.0))
    matches = match_term(matches_of(T_TRUE, rng, 0.2))
    rig = solve(given, given, [matches], POSES).rig
    tied = height_term(ground_seen(T_TRUE, rng), CAMERA, heights(), T_TRUE[:, :3, 3].mean(axis=0), 0.25)
    errors = pose_errors(solve(rig, given, [matches, tied], POSES).rig.T_world_camera, T_TRUE)
    assert errors.position_m.max() < 0.05
    assert errors.angle_deg.max() < 0.25


def wrong_mounting(pitch_deg: float, up_m: float) -> np.ndarray:
    R = vehicle_axes(T_TRUE)
    D = np.eye(4)
    D[:3, :3] = R.T @ Rotation.from_rotvec([0, np.radians(pitch_deg), 0]).as_matrix() @ R
    D[:3, 3] = R.T @ [0, 0, up_m]
    return T_TRUE @ D


MOUNTING = Prior(position_m=0.005, angle_rad=np.radians(0.05), mounting_m=0.1, mounting_rad=np.radians(2))


@pytest.mark.slow
def test_matches_determine_the_pitch_of_a_mounting_and_an_elevation_model_its_height():
    rng = np.random.default_rng(5)
    given = make_rig(wrong_mounting(2.0, 0.1))
    matches = match_term(matches_of(T_TRUE, rng, 0.2))
    alone = solve(given, given, [matches], MOUNTING)
    assert pose_errors(alone.rig.T_world_camera, T_TRUE).angle_deg.max() < 0.2
    tied = height_term(ground_seen(T_TRUE, rng), CAMERA, heights(), T_TRUE[:, :3, 3].mean(axis=0), 0.25)
    both = solve(alone.rig, given, [matches, tied], MOUNTING)
    left = (both.rig.T_world_camera - T_TRUE)[:, 2, 3]
    assert np.abs(left).max() < 0.02
    assert pose_errors(both.rig.T_world_camera, T_TRUE).angle_deg.max() < 0.2
    axes = vehicle_axes(T_TRUE)
    sigma_up = [float(np.sqrt(axes[2] @ found.covariance[-8:-5, -8:-5] @ axes[2])) for found in (alone, both)]
    assert sigma_up[0] > 0.3 * MOUNTING.mounting_m, "level driving hardly constrains the height"
    assert sigma_up[1] < 0.1 * MOUNTING.mounting_m


@pytest.mark.slow
def test_the_ground_under_the_rover_reveals_a_wrong_height_of_the_mounting():
    rng = np.random.default_rng(6)
    T_given = wrong_mounting(0.0, 0.1)
    given = make_rig(T_given)
    # The drawings say 0.1 m more than is true, as the given poses do.
    contact = ground_contact(T_given[:, :3, 3], HEIGHT_M + 0.1)
    tied = height_term(ground_seen(T_TRUE, rng), CAMERA, contact, T_TRUE[:, :3, 3].mean(axis=0), 0.25)
    found = solve(given, given, [match_term(matches_of(T_TRUE, rng, 0.2)), tied], MOUNTING)
    assert np.abs((found.rig.T_world_camera - T_TRUE)[:, 2, 3]).max() < 0.03


def test_baseline_and_disparity_offset_are_found():
    rng = np.random.default_rng(7)
    matches = matches_of(T_TRUE, rng, 0.1)
    prior = Prior(position_m=0.002, angle_rad=np.radians(0.05), baseline_scale=0.02, offset_px=0.5)
    given = make_rig(T_TRUE)
    # Disparities of a camera whose baseline is 1 % wider, read 0.3 px too small.
    wider = matches.uvd_px.copy()
    wider[..., 2] = (wider[..., 2] + CAMERA.doffs_px) * 1.01 - CAMERA.doffs_px - 0.3
    found = solve(given, given, [match_term(matches._replace(uvd_px=wider))], prior)
    assert found.rig.log_baseline_scale == pytest.approx(np.log(1.01), abs=2e-3)
    assert found.rig.offset_px == pytest.approx(0.3, abs=0.03)


@pytest.mark.slow
def test_the_errors_of_the_poses_are_estimated_from_the_data():
    rng = np.random.default_rng(8)
    T_long = track(16, 0.4)
    given = make_rig(disturbed(T_long, rng, 0.03 * np.sqrt(3), 0.3 * np.sqrt(3)))
    found = solve(given, given, [match_term(matches_of(T_long, rng, 0.2))], Prior())
    assert found.prior_sigma[0] == pytest.approx(0.03, rel=0.5)
    assert np.degrees(found.prior_sigma[3]) == pytest.approx(0.3, rel=0.5)


def test_what_is_held_fixed_does_not_move():
    rng = np.random.default_rng(9)
    given = make_rig(disturbed(T_TRUE, rng, 0.05, 0.5))
    found = solve(given, given, [match_term(matches_of(T_TRUE, rng))], Prior(0.1, 0.0, baseline_scale=0.01))
    away = displacement(found.rig, given)
    assert not away[:-8].reshape(-1, 6)[:, 3:].any()
    assert not away[[-8, -7, -6, -5, -4, -3, -1]].any()
    assert away[:-8].reshape(-1, 6)[:, :3].any()
    assert found.covariance[-1, -1] == 0


def test_a_frame_without_matches_keeps_its_place():
    rng = np.random.default_rng(10)
    matches = matches_of(T_TRUE, rng)
    kept = ~(matches.frames == 4).any(axis=1)
    lone = matches._replace(frames=matches.frames[kept], uvd_px=matches.uvd_px[kept], pairs=matches.pairs[kept])
    given = make_rig(disturbed(T_TRUE, rng, 0.1, 0.5))
    found = solve(given, given, [match_term(lone)], POSES)
    np.testing.assert_allclose(found.rig.T_world_camera[4], given.T_world_camera[4], atol=1e-9)
    assert np.sqrt(found.covariance[24, 24]) == pytest.approx(POSES.position_m)


def test_wrong_matches_hardly_pull():
    rng = np.random.default_rng(11)
    matches = matches_of(T_TRUE, rng, 0.2)
    wrong = matches.uvd_px.copy()
    wrong[rng.random(len(wrong)) < 0.15, 1, :2] += 30.0
    given = make_rig(disturbed(T_TRUE, rng, 0.1, 0.5))
    found = solve(given, given, [match_term(matches._replace(uvd_px=wrong))], POSES)
    assert pose_errors(aligned(found.rig.T_world_camera), T_TRUE).position_m.max() < 0.01


def test_residuals_that_are_not_finite_are_refused():
    matches = matches_of(T_TRUE, np.random.default_rng(12))
    matches.uvd_px[3] = np.nan
    given = make_rig(T_TRUE)
    with pytest.raises(JaxmapError, match="diverges"):
        solve(given, given, [match_term(matches)], POSES)
    assert replace(given, offset_px=1.0).offset_px == 1.0


def test_priors_too_wide_to_solve_for_are_refused():
    given = make_rig(T_TRUE)
    with pytest.raises(JaxmapError, match="too wide") as caught:
        solve(given, given, [match_term(matches_of(T_TRUE, np.random.default_rng(13)))], Prior(1e9, 1e9))
    assert "--sigma-position-m" in str(caught.value)
