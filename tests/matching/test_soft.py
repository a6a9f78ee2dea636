"""Soft matching: it tends to the hard mode, its gradients are finite differences, and its memory is bounded."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.ndimage import gaussian_filter
from scipy.special import logsumexp

from jaxmap.matching.aggregate import aggregate
from jaxmap.matching.costs import cost_volume
from jaxmap.matching.design import MatchDesign, MatchParams, make_match_params
from jaxmap.matching.mccnn import Convolution
from jaxmap.matching.select import select
from jaxmap.matching.soft import SoftMatch, aggregate_soft, select_soft, soft_match, soft_minimum

DISPARITIES, TRUE_PX = 8, 3
STEPS = {4: [(1, 0), (-1, 0), (0, 1), (0, -1)]}
STEPS[8] = STEPS[4] + [(1, 1), (1, -1), (-1, 1), (-1, -1)]
COSTS = ("census", "bt", "mccnn")


def pair(height: int = 14, width: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """A textured pair whose disparity is a step, rounded to grey levels."""
    rng = np.random.default_rng(8)
    texture = gaussian_filter(rng.normal(size=(height, width + 8)), 0.8)
    grey = np.round((texture - texture.min()) / np.ptp(texture) * 255)
    near = grey[:, TRUE_PX : TRUE_PX + width].copy()
    near[:, width // 2 :] = grey[:, TRUE_PX + 2 + width // 2 : TRUE_PX + 2 + width]
    return grey[:, :width], near


def design_of(cost: str, **more: object) -> MatchDesign:
    small: dict = {"num_disparities": DISPARITIES, "speckle_window_px": 0, "edge_step_px": 0.0, "soft": True}
    return MatchDesign(cost=cost, census_window_px=(3, 5), **small | more)  # type: ignore[arg-type]


def params_of(cost: str, temperature: float, dtype: type = np.float64) -> MatchParams:
    rng = np.random.default_rng(5)
    shapes = [(3, 3, 1, 4), (3, 3, 4, 4)]
    network = tuple((Convolution(rng.normal(size=shape), rng.normal(size=shape[-1])),) for shape in shapes)
    params = make_match_params(cost, temperature=temperature, weights=network if cost == "mccnn" else None)  # type: ignore[arg-type]
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), params)


def reference_aggregate(volume: np.ndarray, p1: float, p2: float, temperature: float, paths: int) -> np.ndarray:
    """The recurrence pixel by pixel, path by path."""
    height, width, count = volume.shape

    def softest(costs: list[float] | np.ndarray) -> float:
        return -temperature * logsumexp(-np.asarray(costs) / temperature)

    total = np.zeros_like(volume)
    for down, along in STEPS[paths]:
        ends = np.zeros_like(volume)
        for v in range(height) if down >= 0 else reversed(range(height)):
            for u in range(width) if along >= 0 else reversed(range(width)):
                inside = 0 <= v - down < height and 0 <= u - along < width
                before = ends[v - down, u - along] if inside else np.zeros(count)
                stay = before - softest(before)
                for d in range(count):
                    ways = [stay[d], p2, *(stay[e] + p1 for e in (d - 1, d + 1) if 0 <= e < count)]
                    ends[v, u, d] = volume[v, u, d] + softest(ways)
        total += ends
    return total / paths


@given(costs=hnp.arrays(np.float32, 6, elements=st.floats(0, 2, width=32)), temperature=st.floats(0.01, 1))
def test_a_soft_minimum_is_a_little_below_the_minimum(costs, temperature):
    soft = float(soft_minimum(jnp.asarray(costs), temperature))
    assert costs.min() - temperature * np.log(len(costs)) - 1e-5 <= soft <= costs.min() + 1e-5


@pytest.mark.parametrize("paths", [4, 8])
def test_paths_are_those_of_the_definition(paths):
    volume = np.random.default_rng(1).uniform(size=(5, 6, 4)).astype(np.float32)
    expected = reference_aggregate(volume.astype(np.float64), 0.1, 0.6, 0.07, paths)
    np.testing.assert_allclose(aggregate_soft(jnp.asarray(volume), 0.1, 0.6, 0.07, paths), expected, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("cost", COSTS)
def test_it_tends_to_the_hard_mode(cost):
    """As the temperature goes to 0: costs, disparities with their fractions, and what is called unique."""
    left, right = pair()
    with jax.enable_x64(True):
        design, params = design_of(cost), params_of(cost, 2e-5)
        volume = cost_volume(design, jnp.asarray(left), jnp.asarray(right), params)
        hard = aggregate(volume, params.p1, params.p2, 8) / 8
        soft = aggregate_soft(volume, params.p1, params.p2, params.temperature)
        np.testing.assert_allclose(soft, hard, atol=2e-3)
        expected, found = select(design, hard, params), select_soft(design, soft, params)
        certain = np.abs(np.asarray(found.confidence) - 0.5) > 0.49
        assert certain.mean() > 0.9
        unique = np.where(found.confidence > 0.5, found.disparity_px, np.nan)
        np.testing.assert_allclose(unique[certain], np.asarray(expected)[certain], atol=0.02)
        assert np.isfinite(expected).mean() > 0.3


@pytest.mark.slow
@pytest.mark.parametrize("cost", ["census", "bt"])
@pytest.mark.parametrize("block_size", [1, 3])
def test_soft_costs_tend_to_those_of_the_hard_mode(cost, block_size):
    left, right = pair()
    with jax.enable_x64(True):
        params = params_of(cost, 1e-4)
        costs = [
            cost_volume(
                design_of(cost, soft=soft, block_size=block_size), jnp.asarray(left), jnp.asarray(right), params
            )
            for soft in (False, True)
        ]
        steps = design_of(cost).cost_steps
        np.testing.assert_allclose(costs[1], np.asarray(costs[0], np.float64) / steps, atol=1.01 / steps)


def weighed(found: SoftMatch) -> jax.Array:
    """Any smooth number of all disparities and confidences."""
    known = jnp.isfinite(found.disparity_px)
    place = jnp.arange(known.size).reshape(known.shape)
    return (jnp.where(known, found.disparity_px, 0.0) * found.confidence * jnp.cos(place)).sum()


@pytest.mark.slow
@pytest.mark.parametrize("cost", COSTS)
def test_gradients_are_finite_differences(cost):
    """To penalties, uniqueness, temperature, the network's weights and both images, each along a random direction."""
    with jax.enable_x64(True):
        design, params = design_of(cost, left_right_max_diff_px=-1), params_of(cost, 0.05)
        # No two grey levels alike: Birchfield and Tomasi's ranges have kinks there.
        rng = np.random.default_rng(2)
        images = [jnp.asarray(image + rng.uniform(-0.4, 0.4, image.shape)) for image in pair(7, 16)]
        value = jax.jit(lambda params, images: weighed(soft_match(design, *images, params)))
        gradient = jax.jit(jax.grad(value, argnums=(0, 1)))(params, images)
        point, leaves = jax.tree.flatten((params, images))[1], jax.tree.leaves((params, images))
        for number, (leaf, slope) in enumerate(zip(leaves, jax.tree.leaves(gradient), strict=True)):
            direction = rng.normal(size=leaf.shape)
            step = 1e-6
            moved = [
                point.unflatten([*leaves[:number], leaf + sign * step * direction, *leaves[number + 1 :]])
                for sign in (1, -1)
            ]
            difference = (value(*moved[0]) - value(*moved[1])) / (2 * step)
            np.testing.assert_allclose((slope * direction).sum(), difference, rtol=1e-4, atol=1e-5)
            assert np.abs(slope).max() > 0


@pytest.mark.slow
def test_gradients_are_finite_where_there_is_nothing_to_match():
    design, params = design_of("census"), params_of("census", 0.05, np.float32)
    blank = jnp.full((9, 20), 100.0)
    gradient = jax.jit(
        jax.grad(lambda params, image: weighed(soft_match(design, image, image, params)), argnums=(0, 1))
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient(params, blank)))


@pytest.mark.slow
def test_a_gradient_takes_little_memory():
    """Of 256 x 192 pixels and 32 disparities, less than 2 GiB."""
    design = MatchDesign(num_disparities=32, soft=True)
    image = jnp.zeros((192, 256))

    @partial(jax.grad, argnums=(0, 1, 2))
    def slopes(params: MatchParams, left: jax.Array, right: jax.Array) -> jax.Array:
        return weighed(soft_match(design, left, right, params))

    lowered = jax.jit(slopes).lower(params_of("census", 0.05, np.float32), image, image)
    assert lowered.compile().memory_analysis().temp_size_in_bytes < 2 * 2**30
