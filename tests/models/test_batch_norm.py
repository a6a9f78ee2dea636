"""Batch norm and bias: gradients of the plain formulas, running statistics by torch's rule."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from jaxmap.models.batch_norm import BatchNorm, activate, add_bias, normalise, normalise_by_batch

ACTIVATIONS = ("none", "relu", "relu6")
EPS = 1e-3


def normal(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


def plain_activate(values, activation):
    return {"none": lambda x: x, "relu": jax.nn.relu, "relu6": jax.nn.relu6}[activation](values)


def plain_by_batch(images, scale, bias, activation):
    mean, variance = images.mean((0, 1, 2)), images.var((0, 1, 2))
    return plain_activate((images - mean) / jnp.sqrt(variance + EPS) * scale + bias, activation)


def assert_same_gradients(ours, plain, *arguments):
    """Of a function of the result that weighs every pixel its own way."""
    weights = normal(*plain(*arguments).shape, seed=9)
    every = tuple(range(len(arguments)))

    def gradient(function):
        return jax.jit(jax.grad(lambda *values: (function(*values) * weights).sum(), argnums=every))(*arguments)

    for one, other in zip(gradient(ours), gradient(plain), strict=True):
        assert jnp.abs(other).max() > 1e-3
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_gradients_through_the_batch_are_autodiff_s(activation):
    with jax.enable_x64(True):
        images, scale, bias = 4 * normal(3, 4, 5, 6) + 2, 2 + normal(6, seed=1), 1 + normal(6, seed=2)
        assert_same_gradients(
            lambda *values: normalise_by_batch(*values, EPS, activation)[0],
            lambda *values: plain_by_batch(*values, activation),
            images,
            scale,
            bias,
        )


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_gradients_at_fixed_statistics_are_autodiff_s(activation):
    with jax.enable_x64(True):
        arguments = (4 * normal(2, 3, 5, 4), normal(4, seed=1), 1 + normal(4, seed=2) ** 2, *normal(2, 4, seed=3))
        assert_same_gradients(
            lambda *values: normalise(*values, activation),
            lambda images, mean, inverse_std, scale, bias: plain_activate(
                (images - mean) * inverse_std * scale + bias, activation
            ),
            *arguments,
        )


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_gradients_of_a_bias_are_autodiff_s(activation):
    with jax.enable_x64(True):
        assert_same_gradients(
            lambda images, bias: add_bias(images, bias, activation),
            lambda images, bias: plain_activate(images + bias, activation),
            5 * normal(2, 3, 5, 4),
            normal(4, seed=1),
        )


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_activations_are_the_library_s(activation):
    values = jnp.linspace(-8, 8, 33)
    np.testing.assert_array_equal(activate(values, activation), plain_activate(values, activation))


@pytest.mark.slow
def test_gradients_of_several_batches_at_once_are_those_of_each():
    images, scale, bias = normal(2, 3, 4, 4, 5).astype(jnp.float32), jnp.ones(5), jnp.zeros(5)

    def loss(images):
        return (normalise_by_batch(images, scale, bias, EPS, "relu")[0] ** 3).sum()

    together = jax.jit(jax.vmap(jax.grad(loss)))(images)
    for index in range(2):
        np.testing.assert_allclose(together[index], jax.grad(loss)(images[index]), rtol=1e-4, atol=1e-5)


def learning_norm(channels, momentum=0.9):
    return BatchNorm(channels, use_running_average=False, momentum=momentum, epsilon=1e-5, rngs=nnx.Rngs(0))


def test_running_statistics_follow_torch_s_rule():
    # torch.nn.BatchNorm2d(momentum=0.1): normalises by the population's variance, remembers the sample's.
    norm, images = learning_norm(2), normal(2, 1, 3, 2).astype(jnp.float32)
    norm(images)
    values = np.asarray(images, np.float64).reshape(-1, 2)
    np.testing.assert_allclose(norm.mean[...], 0.1 * values.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(norm.var[...], 0.9 + 0.1 * values.var(axis=0, ddof=1), rtol=1e-5)


def test_what_ran_long_on_one_batch_normalises_as_the_batch_does():
    norm, images = learning_norm(3, momentum=0.0), 3 * normal(4, 8, 8, 3).astype(jnp.float32) + 1
    by_batch = norm(images)
    norm.use_running_average = True
    np.testing.assert_allclose(norm(images), by_batch, atol=0.01)


def test_a_single_pixel_leaves_finite_statistics():
    norm = learning_norm(2)
    assert jnp.isfinite(norm(jnp.ones((1, 1, 1, 2)))).all()
    np.testing.assert_allclose(norm.var[...], 0.9, rtol=1e-6)


def test_a_mean_far_from_zero_does_not_drown_the_variance():
    values = np.random.default_rng(0).normal(size=(2, 16, 16, 1)) + 3e4
    _, mean, variance = normalise_by_batch(jnp.asarray(values, jnp.float32), jnp.ones(1), jnp.zeros(1), EPS, "none")
    np.testing.assert_allclose(mean, values.mean(), rtol=1e-6)
    np.testing.assert_allclose(variance, values.var(), rtol=0.01)


@pytest.mark.slow
def test_no_gradient_flows_through_the_statistics():
    images = normal(1, 2, 2, 3).astype(jnp.float32)
    gradient = jax.grad(lambda x: sum(part.sum() for part in normalise_by_batch(x, *jnp.ones((2, 3)), EPS, "none")[1:]))
    assert not gradient(images).any()
