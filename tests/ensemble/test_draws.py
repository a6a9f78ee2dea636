"""What members draw: of the spread that was asked for, the same for the same key, and nothing at all without spread."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import reference_ensemble
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import CLASSES, NO_SPREAD, poses

from jaxmap.ensemble.draws import disparity_noise, displaced, draw_ensemble_params, draw_pose_errors
from jaxmap.ensemble.options import EnsembleOptions
from jaxmap.fusion.params import make_fusion_params

KEY = jax.random.key(3)
FUSION = make_fusion_params(CLASSES)


@pytest.mark.slow
def test_errors_of_poses_have_the_spread_and_the_correlation_that_were_asked_for():
    options = EnsembleOptions(
        members=250, position_sigma_m=0.1, tilt_sigma_rad=0.02, heading_sigma_rad=0.3, pose_correlation_s=2.0
    )
    timestamps_s = np.array([0.0, 1.0, 1.5, 5.5])
    keys = jax.random.split(KEY, 6)
    errors = np.concatenate([draw_pose_errors(key, timestamps_s, options) for key in keys], axis=1, dtype=np.float64)
    sigma = np.array([0.1, 0.1, 0.1, 0.02, 0.02, 0.3])
    np.testing.assert_allclose(errors.std(axis=1), np.tile(sigma, (4, 1)), rtol=0.08)
    assert np.abs(errors.mean(axis=1) / sigma).max() < 0.12
    for one, other in ((0, 1), (1, 2), (0, 3)):
        expected = np.exp(-(timestamps_s[other] - timestamps_s[one]) / 2.0)
        found = (errors[one] * errors[other]).mean(axis=0) / sigma**2
        np.testing.assert_allclose(found, np.full(6, expected), atol=0.12)


@pytest.mark.slow
def test_errors_of_poses_are_offsets_or_noise_at_the_ends_of_the_correlation():
    timestamps_s = np.arange(5.0)
    lasting = draw_pose_errors(KEY, timestamps_s, EnsembleOptions(members=2, pose_correlation_s=1e6))
    np.testing.assert_allclose(lasting, np.broadcast_to(lasting[:1], lasting.shape), atol=1e-4)
    white = draw_pose_errors(KEY, timestamps_s, EnsembleOptions(members=256, pose_correlation_s=1e-3)).astype(
        np.float64
    )
    assert abs(np.corrcoef(white[0, :, 0], white[1, :, 0])[0, 1]) < 0.15


@pytest.mark.slow
@given(st.integers(0, 5), st.integers(1, 4), st.integers(0, 4))
@settings(max_examples=6)
def test_more_members_and_more_frames_leave_the_others_as_they_are(seed, members, frames):
    key = jax.random.key(seed)
    many, long = EnsembleOptions(members=5), np.arange(6.0)
    few = replace(many, members=members)
    errors, part = draw_pose_errors(key, long, many), draw_pose_errors(key, long[:frames], few)
    np.testing.assert_array_equal(part, errors[:frames, :members])
    params, some = draw_ensemble_params(key, FUSION, many), draw_ensemble_params(key, FUSION, few)
    for whole, leaf in zip(jax.tree.leaves(params.sensor), jax.tree.leaves(some.sensor), strict=True):
        np.testing.assert_array_equal(leaf, whole[:members])


def test_without_spread_members_are_the_map():
    errors = draw_pose_errors(KEY, np.arange(4.0), NO_SPREAD)
    assert errors.shape == (4, 3, 6) and not errors.any()
    sensor = draw_ensemble_params(KEY, FUSION, NO_SPREAD).sensor
    for member in range(3):
        for leaf, own in zip(jax.tree.leaves(sensor.fusion), jax.tree.leaves(FUSION), strict=True):
            np.testing.assert_array_equal(leaf[member], own)
    assert (sensor.temperature == 1).all() and not sensor.bias.any()


@given(st.floats(0, 1e6), st.floats(0, 1e6))
@settings(max_examples=10)
def test_no_spread_is_too_wide_for_finite_numbers_of_the_right_sign(increment_sigma, temperature_sigma):
    options = EnsembleOptions(members=4, increment_sigma=increment_sigma, temperature_sigma=temperature_sigma)
    sensor = draw_ensemble_params(KEY, FUSION, options).sensor
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(sensor))
    assert (sensor.temperature > 0).all() and (sensor.fusion.occupancy_hit > 0).all()
    assert (sensor.fusion.occupancy_miss < 0).all()
    np.testing.assert_array_equal(
        np.sign(sensor.fusion.class_increments), np.broadcast_to(np.sign(FUSION.class_increments), (4, 3, 3))
    )


def test_how_maps_are_read_is_not_in_doubt():
    sensor = draw_ensemble_params(KEY, FUSION, EnsembleOptions(members=2, increment_sigma=1.0)).sensor
    for name in ("occupancy_prior", "class_prior", "occupancy_threshold", "class_threshold"):
        drawn = getattr(sensor.fusion, name)
        np.testing.assert_array_equal(drawn, jnp.broadcast_to(getattr(FUSION, name), drawn.shape))


@given(poses())
@settings(max_examples=10)
def test_a_pose_without_error_is_the_pose_bit_for_bit(pose):
    moved = displaced(pose, jnp.zeros(6))
    np.testing.assert_array_equal(moved.translation(), pose.translation())
    # A zero may change its sign.
    np.testing.assert_array_equal(moved.rotation().wxyz, pose.rotation().wxyz)


@given(poses(), st.floats(-0.5, 0.5))
@settings(max_examples=10)
def test_the_third_turn_is_heading_about_the_camera(pose, heading_rad):
    moved = displaced(pose, jnp.array([0.1, -0.2, 0.3, 0.0, 0.0, heading_rad]))
    np.testing.assert_allclose(moved.translation() - pose.translation(), [0.1, -0.2, 0.3], atol=1e-6)
    turn = (moved.rotation() @ pose.rotation().inverse()).as_matrix()
    expected = jaxlie.SO3.from_z_radians(heading_rad).as_matrix()
    np.testing.assert_allclose(turn, expected, atol=1e-5)


@pytest.mark.parametrize("block_px", [1, 3, 8, 40])
def test_noise_of_disparities_is_shared_by_blocks(block_px):
    shape = (24, 32)
    noise = np.asarray(disparity_noise(KEY, shape, block_px))
    corner_key, noise_key = jax.random.split(KEY)
    corner = np.asarray(jax.random.randint(corner_key, (2,), 0, block_px))
    blocks = jax.random.normal(noise_key, tuple(-(-size // block_px) + 1 for size in shape))
    np.testing.assert_allclose(noise, reference_ensemble.noise_of_blocks(blocks, corner, shape, block_px), rtol=1e-6)


@pytest.mark.slow
def test_noise_of_disparities_is_standard_normal_and_correlated_within_a_block():
    keys = jax.random.split(KEY, 3000)
    noise = np.asarray(jax.vmap(lambda key: disparity_noise(key, (6, 9), 4))(keys), np.float64)
    np.testing.assert_allclose(noise.std(axis=0), np.ones((6, 9)), atol=0.06)
    for dx, expected in ((1, 0.75), (3, 0.25), (4, 0.0)):
        assert abs((noise[:, 0, 0] * noise[:, 0, dx]).mean() - expected) < 0.08
