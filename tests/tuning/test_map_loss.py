"""The loss of a map: near the scores it stands for, smooth, and finite whatever the map holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import truth_files
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from jaxmap.datasets.label_raster import LabelRaster
from jaxmap.errors import JaxmapError
from jaxmap.evaluation.cells import map_cells
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams, make_fusion_params
from jaxmap.fusion.query import top_down
from jaxmap.tuning.map_loss import MapTruth, make_map_truth, map_loss, soft_cells
from jaxmap.tuning.options import MapLossOptions, Softness
from jaxmap.tuning.soft_view import columns_of_list, soft_columns, soft_columns_of_map
from jaxmap.types import make_grid, make_voxel_map

CLASSES = truth_files.CLASSES
ROCK = CLASSES.index("rock")
GRID = make_grid([0, 0, -0.4], [2.0, 1.6, 0.4], (0.1, 0.1, 0.2))
PARAMS = make_fusion_params(CLASSES, occupancy_prior=0.4, class_prior=[0.3, 0.5, 0.2], class_threshold=0.6)
RULES = [FusionRule(column=column, priority_classes=first) for column in ("sum", "max") for first in (("rock",), ())]
IDS = [f"{rule.column}-{'-'.join(rule.priority_classes)}" for rule in RULES]
HARD = MapLossOptions(softness=Softness(1e-4, 1e-4, 1e-4))
STEP = 1e-6
SOME_RULES = [
    pytest.param(rule, id=name, marks=[pytest.mark.slow] if index else [])
    for index, (rule, name) in enumerate(zip(RULES, IDS, strict=True))
]
"""The others run with --all."""


def raster(seed: int = 0) -> LabelRaster:
    """Labels of 0.05 m over the grid, in blocks, with some ground unlabelled."""
    rng = np.random.default_rng(seed)
    blocks = rng.choice([0, 1, 2], p=[0.1, 0.5, 0.4], size=(8, 10)).astype(np.uint8)
    return LabelRaster(blocks.repeat(4, 0).repeat(4, 1), np.array([[0.05, 0, 0], [0, -0.05, 1.6], [0, 0, 1]]))


TRUTH, _, CELLS = make_map_truth(GRID, raster(), np.zeros(3), None)


def a_map(seed: int, scale: float = 2.0):
    """Evidence of any sign in half of the voxels."""
    rng = np.random.default_rng(seed)
    empty = make_voxel_map(GRID, CLASSES)
    evidence = rng.normal(0, scale, empty.log_odds.shape) * (rng.random(GRID.shape) < 0.5)
    return replace(empty, log_odds=jnp.asarray(evidence, jnp.float32))


@pytest.mark.parametrize("rule", SOME_RULES)
@pytest.mark.parametrize("seed", range(3))
def test_it_goes_to_what_is_scored_as_decisions_harden(rule, seed):
    voxel_map = a_map(seed)
    view = top_down(voxel_map, PARAMS, rule)
    prior = jax.nn.sigmoid(PARAMS.class_prior[ROCK])
    hard = map_cells(view.label == ROCK, view.probability[ROCK], view.observed, TRUTH.shares, float(prior))
    columns = soft_columns_of_map(voxel_map, PARAMS, rule, ROCK, HARD.softness)
    soft = soft_cells(columns, TRUTH.shares, prior, HARD)
    np.testing.assert_array_equal(np.asarray(soft.area) > 1e-6, hard.observed)
    np.testing.assert_allclose(soft.probability, hard.probability, atol=2e-3)
    clear = np.abs(np.asarray(hard.share) - 0.5) > 1e-3
    np.testing.assert_allclose(np.asarray(soft.called)[clear], hard.called()[clear], atol=1e-3)


@pytest.mark.parametrize("rule", RULES, ids=IDS)
def test_a_list_of_voxels_says_what_its_grid_says(rule):
    voxel_map = a_map(5)
    dense = soft_columns_of_map(voxel_map, PARAMS, rule, ROCK, Softness())
    touched = np.flatnonzero(np.asarray(voxel_map.log_odds[0]))
    touched = np.random.default_rng(0).permutation(touched)
    listed = soft_columns(
        voxel_map.log_odds.reshape(4, -1)[:, touched],
        jnp.ones(len(touched), bool),
        columns_of_list(jnp.asarray(touched // GRID.shape[2]), GRID.shape[:2]),
        PARAMS,
        rule,
        CLASSES,
        ROCK,
        Softness(),
    )
    for name, one, other in zip(dense._fields, dense, listed, strict=True):
        empty = np.asarray(voxel_map.log_odds[0] == 0).all(axis=-1)
        np.testing.assert_allclose(np.where(empty, 0, one), np.where(empty, 0, other), atol=1e-5, err_msg=name)


def test_the_loss_is_that_of_its_definition():
    weighed = dict(driving_weight=0.3, missed_rock_m=8.0, detour_m=2.0)
    voxel_map, options = a_map(1), MapLossOptions(nll_weight=0.7, iou_weight=0.4, class_weight=3.0, **weighed)
    loss, parts = map_loss(voxel_map, PARAMS, RULES[0], TRUTH, ROCK, options)
    columns = soft_columns_of_map(voxel_map, PARAMS, RULES[0], ROCK, options.softness)
    said = soft_cells(columns, TRUTH.shares, jax.nn.sigmoid(PARAMS.class_prior[ROCK]), options)
    nll = weights = both = either = driving_m = cells = 0.0
    for place in np.ndindex(*TRUTH.truly.shape):
        if not (TRUTH.counted[place] and said.area[place] > 1e-6):
            continue
        p, called, truly = float(said.probability[place]), float(said.called[place]), bool(TRUTH.truly[place])
        nll -= 3.0 * np.log(p) if truly else np.log(1 - p)
        weights += 3.0 if truly else 1.0
        both += called * truly
        either += called + truly - called * truly
        driving_m += called * 2.0 + (1 - called) * truly * 8.0
        cells += 1
    np.testing.assert_allclose(parts.nll, nll / weights, rtol=1e-4)
    np.testing.assert_allclose(parts.soft_iou, both / either, rtol=1e-4)
    np.testing.assert_allclose(parts.driving_m, driving_m / cells, rtol=1e-4)
    expected = 0.7 * nll / weights + 0.4 * (1 - both / either) + 0.3 * driving_m / cells
    np.testing.assert_allclose(loss, expected, rtol=1e-4)


def test_a_map_of_the_truth_itself_has_hardly_a_loss_and_its_contrary_a_great_one():
    share = np.asarray(TRUTH.truly).repeat(2, 0).repeat(2, 1)[..., None]
    sign = np.zeros((4, *GRID.shape))
    sign[0, ..., 1] = 1.0
    sign[1:, ..., 1] = np.array([-1, -1, 1]).reshape(3, 1, 1) * (2 * share[..., 0] - 1)
    empty = make_voxel_map(GRID, CLASSES)
    right, _ = map_loss(replace(empty, log_odds=jnp.asarray(20 * sign, jnp.float32)), PARAMS, RULES[0], TRUTH, ROCK)
    wrong = sign * np.array([1, -1, -1, -1]).reshape(4, 1, 1, 1)
    contrary, _ = map_loss(replace(empty, log_odds=jnp.asarray(20 * wrong, jnp.float32)), PARAMS, RULES[0], TRUTH, ROCK)
    assert float(right) < 0.02
    assert float(contrary) > 5.0


def doubled(tree):
    """The same values with float64 leaves."""
    return jax.tree.map(
        lambda leaf: jnp.asarray(leaf, jnp.float64) if jnp.result_type(leaf) == jnp.float32 else leaf, tree
    )


@partial(jax.jit, static_argnums=3)
def loss_of(params: FusionParams, log_odds: jax.Array, truth: MapTruth, rule: FusionRule) -> jax.Array:
    voxel_map = replace(make_voxel_map(GRID, CLASSES), log_odds=log_odds)
    return map_loss(voxel_map, params, rule, truth, ROCK, MapLossOptions(softness=Softness(0.5, 0.5, 0.1)))[0]


slopes = jax.jit(jax.grad(loss_of, argnums=(0, 1)), static_argnums=3)


def slope_of(loss_at: Callable[[float], Any]) -> float:
    """The slope at 0 of what is smooth there; other examples, with a tie within a step, are left out."""
    behind, here, ahead = (float(loss_at(step)) for step in (-STEP, 0.0, STEP))
    slope = (ahead - behind) / (2 * STEP)
    assume(abs(ahead - 2 * here + behind) / (2 * STEP) <= 3e-4 * abs(slope) + 10 * STEP)
    return slope


@pytest.mark.slow
@pytest.mark.parametrize("rule", SOME_RULES)
@given(seed=st.integers(0, 2**16))
@settings(max_examples=8, deadline=None)
def test_gradients_equal_finite_differences(rule, seed):
    with jax.enable_x64(True):
        kernel = np.random.default_rng(seed).uniform(-0.2, 0.3, (len(CLASSES), 3, 3))
        params = doubled(replace(PARAMS, class_kernel=jnp.asarray(kernel, jnp.float32)))
        log_odds, truth = doubled(a_map(seed)).log_odds, doubled(TRUTH)
        of_params, of_map = slopes(params, log_odds, truth, rule)
        rng = np.random.default_rng(seed)
        touched = np.asarray(log_odds != 0)
        direction = rng.normal(size=log_odds.shape) * touched
        slope = slope_of(lambda step: loss_of(params, log_odds + step * direction, truth, rule))
        np.testing.assert_allclose((of_map * direction).sum(), slope, rtol=1e-4, atol=1e-7)
        for field in fields(FusionParams):
            leaf, ours = getattr(params, field.name), getattr(of_params, field.name)
            direction = rng.normal(size=leaf.shape)

            def loss_at(step, field=field, leaf=leaf, direction=direction):
                return loss_of(replace(params, **{field.name: leaf + step * direction}), log_odds, truth, rule)

            slope = slope_of(loss_at)
            np.testing.assert_allclose((ours * direction).sum(), slope, rtol=1e-4, atol=1e-7, err_msg=field.name)


@pytest.mark.parametrize("rule", SOME_RULES)
@pytest.mark.parametrize("scale", [0.0, 1e-3, 1e5])
def test_loss_and_gradients_are_finite_in_empty_and_saturated_maps(rule, scale):
    log_odds = a_map(3, scale).log_odds
    assert np.isfinite(loss_of(PARAMS, log_odds, TRUTH, rule))
    for leaf in jax.tree.leaves(slopes(PARAMS, log_odds, TRUTH, rule)):
        assert np.isfinite(leaf).all()


def test_unlabelled_and_unobserved_cells_do_not_count():
    voxel_map = a_map(2)
    nothing = TRUTH._replace(counted=jnp.zeros_like(TRUTH.counted))
    loss, parts = map_loss(voxel_map, PARAMS, RULES[0], nothing, ROCK)
    assert float(parts.cells) == 0.0
    assert float(parts.nll) == 0.0 and np.isfinite(loss)
    log_odds = voxel_map.log_odds.at[:, :10].set(0.0)
    _, half = map_loss(replace(voxel_map, log_odds=log_odds), PARAMS, RULES[0], TRUTH, ROCK)
    assert float(half.cells) <= float(TRUTH.counted[5:].sum())


def test_a_truth_elsewhere_is_refused():
    far = LabelRaster(raster().labels, np.array([[0.05, 0, 500], [0, -0.05, 900], [0, 0, 1]]), name="far.tif")
    with pytest.raises(JaxmapError, match=r"no cell of the map is labelled in far\.tif; check"):
        make_map_truth(GRID, far, np.zeros(3), None)
