"""Laws of the geometric scores."""

from __future__ import annotations

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import BASELINE_M, CX_PX, CY_PX, F_PX, HEIGHT_PX, WIDTH_PX, scene_frame
from strategies import rngs

from jaxmap.evaluation.geometry_scores import depth_consistency, point_range_error, score_disparity
from jaxmap.types import make_stereo_camera

CAMERA = make_stereo_camera(
    fx_px=F_PX, cx_px=CX_PX, cy_px=CY_PX, baseline_m=BASELINE_M, width_px=WIDTH_PX, height_px=HEIGHT_PX
)


def disparities(rng: np.random.Generator, shape: tuple[int, int] = (20, 30)) -> np.ndarray:
    return np.where(rng.random(shape) < 0.8, rng.uniform(1, 30, shape), np.nan).astype(np.float32)


@given(rngs())
def test_disparity_against_itself_has_no_error(rng):
    disparity_px = disparities(rng)
    scores = score_disparity(disparity_px, disparity_px)
    assert scores.median_error_px == scores.bad_2 == 0
    assert scores.valid == pytest.approx(np.isfinite(disparity_px).mean())


@given(rngs(), st.floats(-5, 5).filter(lambda shift: abs(abs(shift) - 2) > 1e-2))
def test_a_shift_is_the_error_and_is_bad_beyond_two_pixels(rng, shift_px):
    truth = disparities(rng)
    scores = score_disparity(truth + np.float32(shift_px), truth)
    assert scores.median_error_px == pytest.approx(abs(shift_px), abs=1e-5)
    assert scores.bad_2 == float(abs(shift_px) > 2)


@given(rngs())
def test_errors_count_where_both_are_known_and_valid_counts_all_pixels(rng):
    disparity_px, truth = disparities(rng), disparities(rng)
    scores = score_disparity(disparity_px, truth)
    errors = [
        abs(float(a) - float(b))
        for a, b in zip(disparity_px.flat, truth.flat, strict=True)
        if np.isfinite(a) and np.isfinite(b)
    ]
    assert scores.median_error_px == pytest.approx(np.median(errors), abs=1e-5)
    assert scores.bad_2 == pytest.approx(np.mean(np.array(errors) > 2), abs=2 / len(errors))
    assert scores.valid == pytest.approx(np.isfinite(disparity_px).mean())


@given(rngs())
def test_swapping_the_two_keeps_the_errors(rng):
    disparity_px, truth = disparities(rng), disparities(rng)
    one, other = score_disparity(disparity_px, truth), score_disparity(truth, disparity_px)
    assert (one.median_error_px, one.bad_2) == (other.median_error_px, other.bad_2)


@settings(max_examples=5)
@given(rngs(), st.floats(0.8, 1.25))
def test_range_error_is_relative_and_the_same_from_every_pose(rng, factor):
    truth = rng.uniform(3, 30, (HEIGHT_PX, WIDTH_PX)).astype(np.float32)
    turn = jaxlie.SE3.exp(jnp.asarray(rng.uniform(-2, 2, 6), jnp.float32))
    for T_world_camera in (jaxlie.SE3.identity(), turn):
        error = point_range_error(CAMERA, T_world_camera, truth / np.float32(factor), truth)
        assert error == pytest.approx(abs(factor - 1), abs=1e-4)


def relative(a: int, b: int) -> jaxlie.SE3:
    T_b_a = np.linalg.inv(scene_frame(b).T_world_camera) @ scene_frame(a).T_world_camera
    return jaxlie.SE3.from_matrix(jnp.asarray(T_b_a, jnp.float32))


@pytest.mark.parametrize(("a", "b"), [(0, 0), (0, 1), (2, 4), (4, 2)])
def test_true_depths_agree_through_true_poses(a, b):
    errors = depth_consistency(
        CAMERA,
        scene_frame(a).disparity_px.astype(np.float32),
        scene_frame(b).disparity_px.astype(np.float32),
        relative(a, b),
    )
    assert len(errors) > 5000
    # Pixels are not where the points fall exactly: far ground differs by up to a row.
    assert np.median(np.abs(errors)) < (1e-5 if a == b else 0.02)


def test_a_wrong_pose_shows_with_its_sign():
    truth = scene_frame(0).disparity_px.astype(np.float32)
    forward = jaxlie.SE3.from_translation(jnp.array([0.0, 0.0, 0.3]))
    errors = depth_consistency(CAMERA, truth, truth, forward)
    assert np.median(errors) > 0.02
    backward = depth_consistency(CAMERA, truth, truth, forward.inverse())
    assert np.median(backward) < -0.02


def test_points_without_a_counterpart_are_left_out():
    truth = scene_frame(0).disparity_px.astype(np.float32)
    behind = jaxlie.SE3.from_translation(jnp.array([0.0, 0.0, -50.0]))
    assert len(depth_consistency(CAMERA, truth, truth, behind)) == 0
    half = truth.copy()
    half[:, : WIDTH_PX // 2] = np.nan
    known = np.isfinite(half) & (half > 0)
    assert len(depth_consistency(CAMERA, truth, half, jaxlie.SE3.identity())) == known.sum()
