from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st
from strategies import CLASSES, GRID_SHAPE, grids, random_map, rngs

from jaxmap.fusion import query
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.labels import IGNORE
from jaxmap.types import make_grid, make_voxel_map

PAPER = make_fusion_params(CLASSES, occupancy_hit=0.9, occupancy_miss=0.0, class_prior=0.5, class_threshold=0.7)
PAPER_RULE = FusionRule("majority", carve=False, range_weighting=False)
RULES = [FusionRule(), PAPER_RULE, FusionRule(priority_classes=()), FusionRule(priority_classes=("sand", "rock"))]


def thresholds(rng: np.random.Generator):
    """Parameters of the decision without any pattern."""
    return make_fusion_params(
        CLASSES,
        occupancy_prior=float(rng.uniform(0.3, 0.7)),
        class_prior=rng.uniform(0.2, 0.8, 3),
        occupancy_threshold=float(rng.uniform(0.2, 0.8)),
        class_threshold=float(rng.uniform(0.2, 0.8)),
    )


def map_of(columns: dict[tuple[int, int, int], list[float]], classes: tuple[str, ...] = CLASSES):
    """A map with these log-odds and nothing else."""
    empty = make_voxel_map(make_grid([0, 0, 0], GRID_SHAPE, 1.0), classes)
    log_odds = np.zeros(empty.log_odds.shape, np.float32)
    for voxel, numbers in columns.items():
        log_odds[(slice(None), *voxel)] = numbers
    return replace(empty, log_odds=jnp.asarray(log_odds))


@given(grids(), rngs(), st.sampled_from(RULES))
def test_voxel_labels_equal_the_twin(grid, rng, rule):
    voxel_map, params = random_map(grid, rng), thresholds(rng)
    labels = query.voxel_labels(voxel_map, params, rule)
    np.testing.assert_array_equal(labels, reference.voxel_labels(voxel_map, params, rule))


@given(grids(), rngs(), st.sampled_from(RULES))
def test_the_view_from_above_equals_the_twin(grid, rng, rule):
    voxel_map, params = random_map(grid, rng), thresholds(rng)
    view = query.top_down(voxel_map, params, rule)
    probability, label, height_m, seen = reference.top_down(voxel_map, params, rule)
    np.testing.assert_array_equal(view.observed, seen)
    np.testing.assert_array_equal(view.label, label)
    np.testing.assert_allclose(view.probability, probability, atol=1e-5)
    np.testing.assert_allclose(view.height_m, height_m, rtol=1e-5)


@given(grids(), rngs())
def test_probabilities_are_the_logistic_of_evidence_and_prior(grid, rng):
    voxel_map, params = random_map(grid, rng), thresholds(rng)
    occupancy = reference.sigmoid(reference.f64(voxel_map.log_odds)[0] + float(params.occupancy_prior))
    np.testing.assert_allclose(query.occupancy_probability(voxel_map, params), occupancy, atol=1e-6)
    prior = reference.f64(params.class_prior)[:, None, None, None]
    classes = reference.sigmoid(reference.f64(voxel_map.log_odds)[1:] + prior)
    np.testing.assert_allclose(query.class_probabilities(voxel_map, params), classes, atol=1e-6)


@given(grids(), rngs())
def test_a_label_is_a_class_or_ignored_and_only_on_occupied_voxels(grid, rng):
    voxel_map, params = random_map(grid, rng), thresholds(rng)
    labels = np.asarray(query.voxel_labels(voxel_map, params, FusionRule()))
    assert labels.dtype == np.uint8
    assert set(np.unique(labels)) <= {0, 1, 2, IGNORE}
    assert np.all(labels[~np.asarray(query.occupied(voxel_map, params))] == IGNORE)


@pytest.mark.parametrize("column", ["max", "sum"])
@pytest.mark.parametrize("classes", [(), CLASSES, tuple(f"class {n}" for n in range(21))], ids=len)
def test_an_empty_map_says_nothing(classes, column):
    voxel_map, params = make_voxel_map(make_grid([0, 0, 0], GRID_SHAPE, 1.0), classes), make_fusion_params(classes)
    rule = FusionRule(column=column)
    view = query.top_down(voxel_map, params, rule)
    assert view.probability.shape == (len(classes), *GRID_SHAPE[:2])
    assert np.all(np.asarray(query.voxel_labels(voxel_map, params, rule)) == IGNORE)
    assert np.all(np.asarray(view.label) == IGNORE)
    assert np.all(np.isnan(view.height_m))
    assert not np.asarray(view.observed).any()
    assert not np.asarray(query.observed(voxel_map)).any()


@pytest.mark.parametrize("column", ["max", "sum"])
def test_geometry_alone_has_heights_and_no_labels(column):
    voxel_map = map_of({(1, 1, 2): [2.0], (1, 1, 4): [-2.0], (3, 3, 3): [-1.0]}, ())
    view = query.top_down(voxel_map, make_fusion_params(()), FusionRule(column=column))
    assert view.height_m[1, 1] == 2.5
    assert np.asarray(view.observed).sum() == 1
    assert np.all(np.asarray(view.label) == IGNORE)
    assert np.asarray(query.observed(voxel_map)).sum() == 3


def test_one_more_rock_than_sand_makes_a_cell_rock_in_the_paper_preset():
    rock, sand = np.array([0.9, -0.9, -0.9, 0.9]), np.array([0.9, -0.9, 0.9, -0.9])
    hit_once = map_of({(0, 0, 0): rock})
    assert query.voxel_labels(hit_once, PAPER, PAPER_RULE)[0, 0, 0] == 2
    assert query.top_down(hit_once, PAPER, PAPER_RULE).label[0, 0] == 2
    np.testing.assert_allclose(query.class_probabilities(hit_once, PAPER)[2, 0, 0, 0], 0.711, atol=5e-4)
    # In time, or up and down the column.
    for seen in ({(0, 0, 0): rock + sand}, {(0, 0, 0): rock, (0, 0, 1): sand}):
        assert query.top_down(map_of(seen), PAPER, PAPER_RULE).label[0, 0] != 2
    assert query.top_down(map_of({(0, 0, 0): 2 * rock, (0, 0, 1): sand}), PAPER, PAPER_RULE).label[0, 0] == 2


def test_the_threshold_decides_and_equal_is_not_enough():
    just_below = map_of({(0, 0, 0): [0.9, 0, 0.5, 0.84]})
    assert query.voxel_labels(just_below, PAPER, PAPER_RULE)[0, 0, 0] == 1
    half = make_fusion_params(CLASSES)
    assert query.voxel_labels(map_of({(0, 0, 0): [0.9, 0, 0, 0]}), half, FusionRule())[0, 0, 0] == IGNORE
    assert not np.asarray(query.occupied(map_of({(0, 0, 0): [0.0, 1.0, 0, 0]}), half)).any()


def test_columns_join_their_voxels_as_the_rule_says():
    voxel_map = map_of({(2, 3, 0): [1.0, 0, 2.0, -1.0], (2, 3, 1): [1.0, 0, 0.5, 1.5], (2, 3, 4): [-1.0, 0, 0, 9.0]})
    params = make_fusion_params(CLASSES, class_prior=0.5)
    summed = query.top_down(voxel_map, params, FusionRule(column="sum"))
    greatest = query.top_down(voxel_map, params, FusionRule(column="max"))
    # The top voxel is free: what it says of classes does not count.
    np.testing.assert_allclose(summed.probability[:, 2, 3], reference.sigmoid([0, 2.5, 0.5]), atol=1e-6)
    np.testing.assert_allclose(greatest.probability[:, 2, 3], reference.sigmoid([0, 2.0, 1.5]), atol=1e-6)
    assert summed.height_m[2, 3] == greatest.height_m[2, 3] == 1.5


def test_among_the_others_the_likeliest_with_evidence_wins_priors_and_all():
    params = make_fusion_params(CLASSES, class_prior=[0.9, 0.2, 0.5])
    voxel_map = map_of({(0, 0, 0): [1.0, 0.5, 0.6, -1.0], (1, 0, 0): [1.0, 0.0, 0.6, -1.0]})
    labels = query.voxel_labels(voxel_map, params, FusionRule())
    assert labels[0, 0, 0] == 0
    assert labels[1, 0, 0] == 1
