"""The optimiser: its schedule, and which weights it leaves alone."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from compiling import compiled_quickly
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.training.options import OptimiserOptions
from jaxmap.training.step import is_statistic, make_optimiser, poly_rate, trained_names

quickly = pytest.fixture(scope="module", autouse=True)(compiled_quickly)

PLAIN = OptimiserOptions(learning_rate=0.1, warmup_steps=0, weight_decay=0.0, clip_norm=None)
KINDS = ("adamw", "sgd")
NAMES = (
    "backbone.stem.kernel",
    "backbone.stem.norm.scale",
    "backbone.stem.norm.mean",
    "aspp.pool.kernel",
    "aspp.pool.norm.bias",
    "aspp.pool.norm.var",
    "classifier.kernel",
    "classifier.bias",
)
WEIGHTS = {name: jnp.full((2, 3), 1.0 + index) for index, name in enumerate(NAMES)}


def updates_of(options: OptimiserOptions, gradient: float, steps: int = 1) -> dict[str, np.ndarray]:
    """What the weights have moved by after some steps with the same gradient everywhere."""
    optimiser = make_optimiser(options, 100)
    weights = {name: WEIGHTS[name] for name in trained_names(WEIGHTS, options)}
    start, state = weights, optimiser.init(weights)
    for _ in range(steps):
        updates, state = optimiser.update({name: jnp.full((2, 3), gradient) for name in weights}, state, weights)
        weights = optax.apply_updates(weights, updates)
    return {name: np.asarray(weights[name] - start[name]) for name in weights}


@given(
    st.integers(1, 1000),
    st.integers(0, 1100),
    st.just(0.0) | st.floats(0.1, 3),
    st.integers(0, 200),
    st.floats(1e-6, 1, allow_subnormal=False),
)
def test_the_rate_is_the_poly_schedule_after_a_rise(steps, step, power, warmup, rate):
    options = OptimiserOptions(learning_rate=rate, power=power, warmup_steps=warmup)
    left = max(1 - step / steps, 0.0)
    expected = rate * left**power * min((step + 1) / max(warmup, 1), 1)
    assert poly_rate(options, steps)(step) == pytest.approx(expected, rel=1e-3, abs=rate * 1e-5)


def test_the_schedule_in_numbers():
    rate = poly_rate(OptimiserOptions(learning_rate=1.0, power=0.9, warmup_steps=0), 10)
    np.testing.assert_allclose(jax.vmap(rate)(jnp.array([0, 5, 9, 10, 11])), [1, 0.5**0.9, 0.1**0.9, 0, 0], atol=1e-6)
    rate = poly_rate(OptimiserOptions(learning_rate=1.0, power=0.0, warmup_steps=4), 10)
    np.testing.assert_allclose(jax.vmap(rate)(jnp.arange(6)), [0.25, 0.5, 0.75, 1, 1, 1], atol=1e-6)


def test_statistics_are_never_moved():
    assert [name for name in NAMES if is_statistic(name)] == ["backbone.stem.norm.mean", "aspp.pool.norm.var"]
    assert trained_names(NAMES, PLAIN) == {name for name in NAMES if not is_statistic(name)}


def test_a_rate_of_0_freezes_the_backbone():
    names = trained_names(NAMES, replace(PLAIN, backbone_rate=0.0))
    assert names == {"aspp.pool.kernel", "aspp.pool.norm.bias", "classifier.kernel", "classifier.bias"}


@pytest.mark.parametrize("kind", KINDS)
def test_the_backbone_has_a_rate_of_its_own(kind):
    moved = updates_of(replace(PLAIN, kind=kind, backbone_rate=0.25), 0.5, steps=3)
    for name, change in moved.items():
        factor = 0.25 if name.startswith("backbone.") else 1.0
        np.testing.assert_allclose(change, factor * moved["classifier.bias"], rtol=1e-4)
    assert (moved["classifier.bias"] < 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_only_kernels_decay(kind):
    moved = updates_of(replace(PLAIN, kind=kind, weight_decay=0.01), 0.0)
    for name, change in moved.items():
        expected = -0.1 * 0.01 * WEIGHTS[name] if name.endswith(".kernel") else np.zeros((2, 3))
        np.testing.assert_allclose(change, expected, rtol=1e-4)


def test_plain_descent_with_momentum_by_hand():
    moved = updates_of(replace(PLAIN, kind="sgd", power=0.0, momentum=0.5), 1.0, steps=3)
    np.testing.assert_allclose(moved["classifier.bias"], -0.1 * (1 + 1.5 + 1.75), rtol=1e-5)


def test_long_gradients_are_shortened_together_and_short_ones_left():
    options = replace(PLAIN, kind="sgd", momentum=0.0, clip_norm=2.0)
    long = updates_of(options, 1e4)
    assert np.sqrt(sum((change**2).sum() for change in long.values())) == pytest.approx(0.1 * 2, rel=1e-4)
    np.testing.assert_allclose(updates_of(options, 1e-2)["classifier.bias"], -1e-3, rtol=1e-4)
    np.testing.assert_allclose(updates_of(replace(options, clip_norm=None), 1e4)["classifier.bias"], -1e3, rtol=1e-4)


def test_the_first_units_of_a_backbone_may_stay_as_they_are():
    names = ("backbone.stem.kernel", "backbone.units.0.depthwise.kernel", "backbone.units.10.project.kernel", "aspp.a")
    assert trained_names(names, OptimiserOptions(frozen_units=1)) == {names[2], names[3]}
    assert trained_names(names, OptimiserOptions()) == set(names)
