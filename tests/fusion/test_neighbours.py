"""Evidence spread over neighbouring columns: its loops, its laws, and how maps are read with it."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from strategies import CLASSES, rngs

from jaxmap.errors import JaxmapError
from jaxmap.fusion.neighbours import spread_evidence
from jaxmap.fusion.options import FusionOptions, FusionRule
from jaxmap.fusion.params import fusion_attribute, make_fusion_params, stored_fusion
from jaxmap.fusion.query import top_down, voxel_labels
from jaxmap.types import make_grid, make_voxel_map

SAME = np.pad(np.ones((3, 1, 1)), ((0, 0), (1, 1), (1, 1)))


def looped(evidence: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Column by column and neighbour by neighbour."""
    out, reach = np.zeros_like(evidence, np.float64), kernel.shape[1] // 2
    for c, x, y in np.ndindex(*evidence.shape[:3]):
        for i, j in np.ndindex(*kernel.shape[1:]):
            u, v = x + i - reach, y + j - reach
            if 0 <= u < evidence.shape[1] and 0 <= v < evidence.shape[2]:
                out[c, x, y] += kernel[c, i, j] * evidence[c, u, v]
    return out


@given(rngs())
def test_it_equals_its_loops(rng):
    for shape, size in (((3, 6, 7), 3), ((3, 6, 7, 2), 5)):
        evidence, kernel = rng.normal(size=shape), rng.normal(size=(3, size, size))
        ours = spread_evidence(jnp.asarray(evidence, jnp.float32), jnp.asarray(kernel, jnp.float32))
        np.testing.assert_allclose(ours, looped(evidence, kernel), atol=1e-4)


def a_map(seed: int = 0):
    empty = make_voxel_map(make_grid([0, 0, 0], [1, 1.2, 0.6], 0.2), CLASSES)
    rng = np.random.default_rng(seed)
    evidence = rng.normal(0, 2, empty.log_odds.shape) * (rng.random(empty.log_odds.shape[1:]) < 0.7)
    return replace(empty, log_odds=jnp.asarray(evidence, jnp.float32))


@pytest.mark.parametrize("column", ["sum", "max"])
def test_a_kernel_of_one_in_the_middle_changes_nothing(column):
    voxel_map, rule = a_map(), FusionRule(column=column)
    plain, kernel = make_fusion_params(CLASSES), make_fusion_params(CLASSES, class_kernel=SAME)
    for one, other in zip(top_down(voxel_map, plain, rule), top_down(voxel_map, kernel, rule), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(voxel_labels(voxel_map, plain, rule), voxel_labels(voxel_map, kernel, rule))


def test_a_column_takes_its_neighbours_evidence_and_nothing_is_seen_that_was_not():
    voxel_map, weights = a_map(), np.full((3, 3, 3), 0.5)
    weights[:, 1, 1] = 1.0
    plain, kernel = (make_fusion_params(CLASSES, class_prior=0.5, class_kernel=one) for one in (None, weights))
    before, after = (top_down(voxel_map, params, FusionRule()) for params in (plain, kernel))
    np.testing.assert_array_equal(before.observed, after.observed)
    np.testing.assert_array_equal(before.height_m, after.height_m)
    evidence = np.log(np.asarray(before.probability)) - np.log1p(-np.asarray(before.probability))
    spread = np.where(before.observed, looped(np.where(before.observed, evidence, 0), weights), 0)
    np.testing.assert_allclose(after.probability, 1 / (1 + np.exp(-spread)), atol=1e-5)


@pytest.mark.parametrize("priority", [None, (), ("sand",)])
def test_priors_and_threshold_of_the_priority_classes_survive_being_stored(priority):
    options = FusionOptions(priority_classes=priority)
    rule = options.rule(CLASSES)
    params, again = stored_fusion(fusion_attribute(options, rule), CLASSES, "map.zarr")
    assert again == rule
    expected = make_fusion_params(CLASSES, options)
    np.testing.assert_array_equal(params.class_prior, expected.class_prior)
    np.testing.assert_array_equal(params.class_threshold, expected.class_threshold)


def test_a_kernel_survives_being_stored():
    params, _ = stored_fusion({"params": {"class_kernel": SAME.tolist()}}, CLASSES, "map.zarr")
    np.testing.assert_array_equal(params.class_kernel, SAME)


@pytest.mark.parametrize(
    ("kernel", "says"),
    [
        *(
            (np.ones(shape), "is not 3 finite squares of one odd size in fusion")
            for shape in ((3, 2, 2), (2, 3, 3), (3, 3, 5))
        ),
        (np.full((3, 3, 3), np.nan), "input should be a finite number"),
        ([[1], [1, 2]], "input should be a valid tuple"),
    ],
)
def test_other_kernels_are_refused(kernel, says):
    with pytest.raises(JaxmapError, match=f"class_kernel.* {says}"):
        make_fusion_params(CLASSES, class_kernel=kernel)
