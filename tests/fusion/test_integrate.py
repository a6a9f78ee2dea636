from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st
from strategies import (
    BAD_NUMBERS,
    CLASSES,
    GRID_SHAPE,
    POINTS,
    grids,
    hard_labels,
    integer_weights,
    points_in,
    random_map,
    rngs,
    soft_labels,
)

from jaxmap.fusion import integrate as kernels
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.geometry.grid import view_window, window_shape
from jaxmap.types import PointLabels, make_grid, make_stereo_camera, make_voxel_map

fuse = jax.jit(kernels.integrate, static_argnames="rule")
count = jax.jit(kernels.count_points, static_argnames="class_count")
PARAMS = make_fusion_params(CLASSES)
SUM = FusionRule("sum")
CAMERA = dict(fx_px=30, cx_px=15.5, cy_px=11.5, baseline_m=0.2, width_px=32, height_px=24)
PAPER = make_fusion_params(
    CLASSES,
    occupancy_hit=0.9,
    occupancy_miss=0.0,
    class_hit=0.9,
    class_miss=-0.9,
    class_prior=0.5,
    class_threshold=0.7,
)
PAPER_RULE = FusionRule("majority", carve=False, range_weighting=False)
RULES = [FusionRule("sum"), FusionRule("once"), FusionRule("majority"), FusionRule("mean")]


def taken(labels: PointLabels, which) -> PointLabels:
    """The labels of some of the points."""
    return jax.tree.map(lambda leaf: leaf[which], labels)


@given(grids(), rngs(), st.booleans())
def test_counts_equal_the_twin(grid, rng, soft):
    labels = (soft_labels if soft else hard_labels)(rng)
    points, weights = points_in(grid, rng), rng.uniform(0.1, 2, POINTS).astype(np.float32)
    expected = reference.count_points(grid, points, labels, weights, 3)
    np.testing.assert_allclose(count(grid, points, labels, weights, class_count=3), expected, atol=1e-5)


@given(grids(), rngs(), st.sampled_from(RULES))
def test_map_equals_the_twin(grid, rng, rule):
    before, labels, points = random_map(grid, rng), hard_labels(rng), points_in(grid, rng)
    weights, free = integer_weights(rng), rng.random(GRID_SHAPE) < 0.3
    after, hits = fuse(before, points, labels, weights, PARAMS, rule, free=free)
    expected = reference.integrate(before.log_odds, grid, points, labels, weights, PARAMS, rule, free)
    np.testing.assert_allclose(after.log_odds, expected, atol=2e-5)
    np.testing.assert_allclose(hits, reference.count_points(grid, points, labels, weights, 3).sum(axis=0))
    assert after.frames_fused == before.frames_fused + 1


@pytest.mark.parametrize("classes", [(), CLASSES, tuple(f"class {n}" for n in range(21))], ids=len)
@pytest.mark.parametrize("soft", [False, True])
def test_any_number_of_classes_works(classes, soft):
    rng, grid = np.random.default_rng(1), make_grid([0, 0, 0], GRID_SHAPE, 1.0)
    labels = (soft_labels if soft else hard_labels)(rng, len(classes))
    points, weights, params = points_in(grid, rng), integer_weights(rng), make_fusion_params(classes)
    after, _ = fuse(make_voxel_map(grid, classes), points, labels, weights, params, SUM)
    expected = reference.integrate(np.zeros(after.log_odds.shape), grid, points, labels, weights, params, SUM)
    np.testing.assert_allclose(after.log_odds, expected, atol=1e-4)


@given(grids(), rngs(), st.sampled_from(RULES))
def test_order_of_points_does_not_matter(grid, rng, rule):
    labels, points, order = hard_labels(rng), points_in(grid, rng), rng.permutation(POINTS)
    exact, rough = integer_weights(rng), rng.uniform(0.1, 2, POINTS).astype(np.float32)
    before = make_voxel_map(grid, CLASSES)
    for weights, tolerance in ((exact, 0.0), (rough, 1e-5)):
        one, _ = fuse(before, points, labels, weights, PARAMS, rule)
        other, _ = fuse(before, points[order], taken(labels, order), weights[order], PARAMS, rule)
        np.testing.assert_allclose(one.log_odds, other.log_odds, rtol=0, atol=tolerance)


@given(grids(), rngs())
def test_evidence_adds_up_over_splits(grid, rng):
    labels, points, weights = hard_labels(rng), points_in(grid, rng), integer_weights(rng)
    before, part = random_map(grid, rng), rng.random(POINTS) < 0.5
    whole, _ = fuse(before, points, labels, weights, PARAMS, SUM)
    parts = before
    for chosen in (part, ~part):
        kept = labels._replace(keep=labels.keep & chosen)
        parts, _ = fuse(parts, points, kept, weights, PARAMS, SUM)
    np.testing.assert_allclose(parts.log_odds, whole.log_odds, atol=2e-5)


@given(grids(), rngs(), st.booleans())
def test_evidence_is_conserved(grid, rng, soft):
    labels, points, weights = (soft_labels if soft else hard_labels)(rng), points_in(grid, rng), integer_weights(rng)
    counts = np.asarray(count(grid, points, labels, weights, class_count=3))
    _, inside = reference.world_to_voxel(grid, points)
    np.testing.assert_allclose(counts.sum(), weights[inside & np.asarray(labels.keep)].sum(), rtol=1e-6)


@given(grids(), rngs(), st.sampled_from(RULES), st.booleans())
def test_points_that_are_no_place_or_weigh_nothing_finite_change_no_bit(grid, rng, rule, soft):
    labels = (soft_labels if soft else hard_labels)(rng)
    points, weights, before = points_in(grid, rng), integer_weights(rng), random_map(grid, rng)
    bad = rng.random(POINTS) < 0.5
    expected, _ = fuse(before, points, labels._replace(keep=labels.keep & ~bad), weights, PARAMS, rule)
    lost = points.copy()
    lost[bad, rng.integers(3)] = rng.choice(BAD_NUMBERS, bad.sum())
    for arguments in ((lost, weights), (points, np.where(bad, rng.choice([np.nan, np.inf, -np.inf]), weights))):
        after, _ = fuse(before, arguments[0], labels, arguments[1], PARAMS, rule)
        np.testing.assert_array_equal(after.log_odds, expected.log_odds)


@pytest.mark.parametrize("bad_number", [np.nan, np.inf])
def test_points_whose_probabilities_are_not_finite_do_not_spoil_their_voxel(bad_number):
    rng, grid = np.random.default_rng(5), make_grid([0, 0, 0], GRID_SHAPE, 1.0)
    labels, points, weights = soft_labels(rng), points_in(grid, rng, spill=0), integer_weights(rng)
    spoilt = labels._replace(probabilities=labels.probabilities.at[:5, 1].set(bad_number))
    after, _ = fuse(make_voxel_map(grid, CLASSES), points, spoilt, weights, PARAMS, SUM)
    assert np.isfinite(after.log_odds).all()


@given(grids(), rngs(), st.tuples(*[st.integers(-9, 9)] * 3))
def test_shifting_grid_and_points_by_whole_voxels_shifts_the_map(grid, rng, shift):
    labels, points, weights = hard_labels(rng), points_in(grid, rng), integer_weights(rng)
    move_m = np.array(shift) * np.asarray(grid.voxel_size_m)
    here, _ = fuse(make_voxel_map(grid, CLASSES), points, labels, weights, PARAMS, SUM)
    # The grid moved with the points: the same map.
    moved_grid = replace(grid, lattice_m=grid.lattice_m + move_m)
    moved, _ = fuse(make_voxel_map(moved_grid, CLASSES), points + move_m, labels, weights, PARAMS, SUM)
    np.testing.assert_array_equal(moved.log_odds, here.log_odds)
    # The points alone moved by one voxel: the map shifts along.
    one = np.array([np.sign(shift[0]), 0, 0]) * np.asarray(grid.voxel_size_m)
    beside, _ = fuse(make_voxel_map(grid, CLASSES), points + one.astype(np.float32), labels, weights, PARAMS, SUM)
    step, inner = int(np.sign(shift[0])), slice(1, -1)
    shifted = np.roll(np.asarray(here.log_odds), step, axis=1)
    np.testing.assert_array_equal(np.asarray(beside.log_odds)[:, inner], shifted[:, inner])


@given(grids(), rngs(), st.sampled_from(RULES))
def test_a_window_that_holds_the_points_gives_the_map_of_the_whole_grid(grid, rng, rule):
    before, labels, weights = random_map(grid, rng), hard_labels(rng), integer_weights(rng)
    start, shape = np.array([rng.integers(4), rng.integers(4), rng.integers(3)]), (5, 4, 3)
    index = start + rng.integers(0, shape, (POINTS, 3))
    points = np.asarray(grid.origin_m) + (index + rng.integers(1, 16, (POINTS, 3)) / 16) * np.asarray(grid.voxel_size_m)
    points = points.astype(np.float32)
    window = replace(grid, first=jnp.asarray(start, jnp.int32), shape=shape)
    box = tuple(slice(a, a + n) for a, n in zip(start, shape, strict=True))
    free = np.zeros(GRID_SHAPE, bool)
    free[box] = rng.random(shape) < 0.5
    whole, hits = fuse(before, points, labels, weights, PARAMS, rule, free=free)
    windowed, part_hits = fuse(before, points, labels, weights, PARAMS, rule, window=window, free=free[box])
    np.testing.assert_array_equal(windowed.log_odds, whole.log_odds)
    np.testing.assert_array_equal(part_hits, np.asarray(hits)[box])


def test_points_on_voxel_faces_fall_into_the_same_voxel_through_any_window():
    # Voxels of 0.2 m: no face is exact in float32, and a flat floor may lie on one.
    grid, camera = make_grid([-9.1, -8.3, -3.7], [9.1, 8.3, 3.7], 0.2), make_stereo_camera(**CAMERA)
    face = np.random.default_rng(0).integers([45, 40, 18], [50, 45, 22], (POINTS, 3))
    points = jnp.asarray(np.asarray(grid.origin_m) + face * 0.2, jnp.float32)
    labels, weights = PointLabels(jnp.ones(POINTS, bool), jnp.full(POINTS, 2)), jnp.ones(POINTS)
    whole, _ = fuse(make_voxel_map(grid, CLASSES), points, labels, weights, PARAMS, SUM)
    for back_m in (0.3, 0.9, 1.5):
        pose = jaxlie.SE3.from_translation(jnp.array([0.1, 0.2, -back_m]))
        window = view_window(grid, camera, pose, 4.0, window_shape(grid, camera, 4.0))
        windowed, _ = fuse(make_voxel_map(grid, CLASSES), points, labels, weights, PARAMS, SUM, window=window)
        np.testing.assert_array_equal(windowed.log_odds, whole.log_odds)


@given(rngs(), st.integers(1, POINTS), st.sampled_from([1, 2]))
def test_paper_preset_adds_its_increment_once_however_many_points(rng, points_in_voxel, label):
    grid, voxel = make_grid([0, 0, 0], GRID_SHAPE, 1.0), (3, 2, 1)
    points = np.tile(np.array(voxel) + 0.5, (POINTS, 1)) + rng.uniform(-0.4, 0.4, (POINTS, 3))
    # Fewer than half of the points have another label.
    own = np.where(np.arange(POINTS) < (points_in_voxel - 1) // 2, 0, label)
    labels = PointLabels(keep=jnp.arange(POINTS) < points_in_voxel, labels=jnp.asarray(own))
    after, _ = fuse(
        make_voxel_map(grid, CLASSES), points.astype(np.float32), labels, np.ones(POINTS), PAPER, PAPER_RULE
    )
    log_odds = np.asarray(after.log_odds)
    expected = np.full(4, -0.9, np.float32)
    expected[[0, 1 + label]] = 0.9
    np.testing.assert_array_equal(log_odds[(slice(None), *voxel)], expected)
    assert np.count_nonzero(log_odds) == 4


@given(grids(), rngs(), st.sampled_from(RULES))
def test_frames_commute(grid, rng, rule):
    frames = [(points_in(grid, rng), hard_labels(rng), integer_weights(rng)) for _ in range(2)]
    forth = back = make_voxel_map(grid, CLASSES)
    for first, second in zip(frames, reversed(frames), strict=True):
        forth, _ = fuse(forth, *first, PARAMS, rule)
        back, _ = fuse(back, *second, PARAMS, rule)
    np.testing.assert_allclose(forth.log_odds, back.log_odds, atol=1e-5)


@pytest.mark.parametrize("code", [-1, 3, 254, 255])
def test_labels_that_are_no_class_count_as_points_without_one(code):
    grid = make_grid([0, 0, 0], GRID_SHAPE, 1.0)
    labels = PointLabels(keep=jnp.ones(POINTS, bool), labels=jnp.full(POINTS, code))
    counts = np.asarray(count(grid, np.full((POINTS, 3), 0.5, np.float32), labels, np.ones(POINTS), class_count=3))
    assert counts[3, 0, 0, 0] == POINTS
    assert counts.sum() == POINTS
