"""The transformed convolution is the convolution; the network for inference is the network."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmap.models.architecture import torch_architecture
from jaxmap.models.deeplab import fold_batch_norm, inference_network, initial_weights, pure_network
from jaxmap.models.layers import ConvBlock
from jaxmap.models.winograd import MIN_CHANNELS, convolve_transformed, transformed_kernel


def normal(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def convolved(images: np.ndarray, kernel: np.ndarray, dilation: int) -> np.ndarray:
    """The slow twin: the sum over all elements of the kernel that meet the image, in double precision."""
    batch, height, width, _ = images.shape
    result = np.zeros((batch, height, width, kernel.shape[3]))
    for y, x, row, column in np.ndindex(height, width, 3, 3):
        source = y + (row - 1) * dilation, x + (column - 1) * dilation
        if 0 <= source[0] < height and 0 <= source[1] < width:
            result[:, y, x] += images[:, *source].astype(np.float64) @ kernel[row, column].astype(np.float64)
    return result


# One program for each size, where every operation by itself would be one.
compiled = jax.jit(convolve_transformed, static_argnames="dilation")


@settings(max_examples=12, deadline=None)
@given(height=st.integers(1, 9), width=st.integers(1, 9), dilation=st.sampled_from([1, 2, 3]), batch=st.integers(1, 2))
def test_the_transformed_convolution_is_the_convolution_at_any_size(height, width, dilation, batch):
    images, kernel = normal(0, batch, height, width, 5), normal(1, 3, 3, 5, 4)
    result = compiled(jnp.asarray(images), transformed_kernel(jnp.asarray(kernel)), dilation)
    np.testing.assert_allclose(result, convolved(images, kernel, dilation), atol=1e-4)


def test_its_error_at_full_depth_is_that_of_float32():
    images, kernel = normal(0, 1, 6, 7, 512), normal(1, 3, 3, 512, 16)
    result = convolve_transformed(jnp.asarray(images), transformed_kernel(jnp.asarray(kernel)), 2)
    expected = convolved(images, kernel, 2)
    # Sums of 4608 products of this size are some 70; one rounding there is 8e-6.
    np.testing.assert_allclose(result, expected, atol=1e-5 * float(np.abs(expected).max()))


@pytest.mark.parametrize("dilation", [1, 6])
def test_only_large_dense_kernels_are_transformed(dilation):
    wide = MIN_CHANNELS
    assert ConvBlock(wide, wide, 3, dilation=dilation).transformable
    assert not ConvBlock(wide, wide, 3, stride=2).transformable
    assert not ConvBlock(wide, wide, 1).transformable
    assert not ConvBlock(wide, wide - 1, 3).transformable
    assert not ConvBlock(wide, wide, 3, depthwise=True).transformable


def test_the_network_for_inference_gives_the_same_logits_at_an_odd_size():
    record = torch_architecture("resnet18", ["sand", "rock"])
    weights = initial_weights(record, jax.random.key(0))
    image = np.random.default_rng(0).integers(0, 256, (2, 49, 70, 3)).astype(np.uint8)
    plain, fast = pure_network(*fold_batch_norm(record, weights)), inference_network(record, weights)
    changed = [name for name, kernel in fast.weights.items() if kernel.shape != plain.weights[name].shape]
    assert len(changed) == 10 and all(fast.weights[name].shape[:2] == (4, 4) for name in changed)
    logits = np.asarray(jax.jit(plain.apply)(plain.weights, image))
    np.testing.assert_allclose(
        jax.jit(fast.apply)(fast.weights, image), logits, atol=1e-4 * max(1.0, float(np.abs(logits).max()))
    )
