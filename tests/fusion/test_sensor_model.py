from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st
from strategies import CLASSES, GRID_SHAPE, cameras, grids, rngs

from jaxmap.fusion import sensor_model
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.geometry.camera import depth_at_sigma, depth_sigma

weight_of = jax.jit(sensor_model.range_weight)
evidence_of = jax.jit(sensor_model.frame_evidence, static_argnames="rule")
PER_FRAME = ["sum", "once", "majority", "mean"]


def random_counts(rng: np.random.Generator, classes: int) -> np.ndarray:
    """Points per label, with half of the voxels empty."""
    counts = rng.integers(0, 5, (classes + 1, *GRID_SHAPE)) * (rng.random(GRID_SHAPE) < 0.5)
    return counts.astype(np.float32)


def random_params(rng: np.random.Generator, classes: tuple[str, ...]):
    """Increments without any pattern, priors other than one half."""
    return make_fusion_params(
        classes,
        occupancy_prior=rng.uniform(0.2, 0.8),
        class_increments=rng.normal(0, 1, (len(classes), len(classes))),
        class_prior=rng.uniform(0.1, 0.9, len(classes)),
        full_evidence_points=rng.uniform(0.5, 9),
    )


@pytest.mark.parametrize("classes", [(), CLASSES, tuple(f"class {n}" for n in range(21))], ids=len)
@pytest.mark.parametrize("per_frame", PER_FRAME)
def test_evidence_equals_the_twin(per_frame, classes):
    rng = np.random.default_rng(len(classes))
    counts, free = random_counts(rng, len(classes)), rng.random(GRID_SHAPE) < 0.5
    params, rule = random_params(rng, classes), FusionRule(per_frame)
    expected = reference.frame_evidence(counts, free, params, rule)
    np.testing.assert_allclose(evidence_of(counts, free, params, rule), expected, rtol=1e-4, atol=1e-4)
    unfreed = reference.frame_evidence(counts, None, params, rule)
    np.testing.assert_allclose(evidence_of(counts, None, params, rule), unfreed, rtol=1e-4, atol=1e-4)


@given(rngs(), st.sampled_from(PER_FRAME))
def test_a_voxel_that_nothing_says_anything_of_stays_exactly_zero(rng, per_frame):
    counts, free = random_counts(rng, 3), rng.random(GRID_SHAPE) < 0.3
    evidence = np.asarray(evidence_of(counts, free, random_params(rng, CLASSES), FusionRule(per_frame)))
    untouched = (counts.sum(axis=0) == 0) & ~free
    assert np.all(evidence[:, untouched] == 0)


@given(rngs(), st.sampled_from(PER_FRAME))
def test_a_hit_voxel_is_not_free_all_the_same(rng, per_frame):
    counts, params = random_counts(rng, 3), random_params(rng, CLASSES)
    everywhere = np.ones(GRID_SHAPE, bool)
    carved = np.asarray(evidence_of(counts, everywhere, params, FusionRule(per_frame)))
    plain = np.asarray(evidence_of(counts, None, params, FusionRule(per_frame)))
    hit = counts.sum(axis=0) > 0
    np.testing.assert_array_equal(carved[:, hit], plain[:, hit])


@given(rngs())
def test_mean_is_bounded_by_one_increment(rng):
    counts = random_counts(rng, 3) * rng.choice([1, 1000])
    params = make_fusion_params(CLASSES, full_evidence_points=float(rng.uniform(0.5, 20)))
    evidence = np.asarray(evidence_of(counts, None, params, FusionRule("mean")))
    assert np.all(evidence[0] <= float(params.occupancy_hit) * (1 + 1e-6))
    assert np.all(np.abs(evidence[1:]) <= np.abs(params.class_increments).max() * (1 + 1e-6))


@given(rngs(), st.integers(2, 1000), st.sampled_from(["once", "majority"]))
def test_once_and_majority_do_not_depend_on_the_number_of_points(rng, factor, per_frame):
    counts, params = random_counts(rng, 3), random_params(rng, CLASSES)
    few, many = (evidence_of(c, None, params, FusionRule(per_frame)) for c in (counts, counts * factor))
    np.testing.assert_array_equal(few, many)


@given(rngs())
def test_the_majority_is_one_label_or_none_whatever_the_order_of_the_classes(rng):
    counts, order = random_counts(rng, 3), rng.permutation(3)
    chosen = np.asarray(sensor_model.majority(jnp.asarray(counts)))
    assert set(np.unique(chosen)) <= {0.0, 1.0} and chosen.sum(axis=0).max() <= 1
    others = np.asarray(sensor_model.majority(jnp.asarray(counts[[*order, 3]])))
    np.testing.assert_array_equal(others, chosen[order])


def test_the_majority_needs_more_points_than_any_other_label_and_than_no_label():
    counts = np.array([[3, 2, 2, 0, 0.5], [2, 2, 0, 0, 0.75], [0, 1, 3, 0, 0.25]], np.float32).reshape(3, 5, 1, 1)
    chosen = sensor_model.majority(jnp.asarray(counts))[..., 0, 0]
    np.testing.assert_array_equal(chosen, [[1, 0, 0, 0, 0], [0, 0, 0, 0, 1]])


def test_prior_is_taken_off_each_observation_as_the_standard_filter_does():
    # Eq. 3 with the standard sign: an observation no better than the prior changes nothing.
    # What a label adds to its class is given with the prior already taken off.
    params = make_fusion_params(
        ("a",), occupancy_hit=np.log(4.0), occupancy_prior=0.8, class_prior=0.1, class_hit=0.9, class_miss=-0.9
    )
    counts = np.zeros((2, 1, 1, 1), np.float32)
    counts[0] = 1
    evidence = evidence_of(counts, None, params, FusionRule("once"))
    np.testing.assert_allclose(evidence[:, 0, 0, 0], [0.0, 0.9], atol=1e-6)


@given(cameras(), grids(), rngs())
def test_range_weight_equals_the_twin_and_falls_with_depth(camera, grid, rng):
    depth_m = np.sort(rng.uniform(0.2, 60, 64)).astype(np.float32)
    params = make_fusion_params(CLASSES, disparity_sigma_px=float(rng.uniform(0.1, 2)))
    weight = np.asarray(weight_of(grid, depth_sigma(camera, jnp.asarray(depth_m), params.disparity_sigma_px)))
    np.testing.assert_allclose(weight, reference.range_weight(camera, grid, depth_m, params), rtol=1e-5)
    assert np.all(np.diff(weight) <= 0)
    assert np.all((weight > 0) & (weight <= 1))


@given(cameras(), grids())
def test_range_weight_is_one_half_where_noise_equals_the_voxel(camera, grid):
    depth_m = depth_at_sigma(camera, float(grid.voxel_size_m.mean()), 0.5)
    np.testing.assert_allclose(weight_of(grid, depth_sigma(camera, depth_m, 0.5)), 0.5, rtol=1e-5)


@given(rngs())
def test_total_weight_is_the_sum_over_labels(rng):
    counts = random_counts(rng, 3)
    np.testing.assert_array_equal(sensor_model.total_weight(jnp.asarray(counts)), counts.sum(axis=0))
