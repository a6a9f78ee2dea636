"""What is computed another way to be fast is what the plain way gives, at any size."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmap.models import mobilenet_v2
from jaxmap.models.architecture import torch_architecture
from jaxmap.models.bands import by_bands, rows_per_band
from jaxmap.models.convolutions import convolve, resize_bilinear
from jaxmap.models.deeplab import fold_batch_norm, inference_network, initial_weights, pure_network
from jaxmap.models.layers import ConvBlock
from jaxmap.models.upsampled import separable_on_upsampled
from jaxmap.models.winograd import MIN_CHANNELS, convolve_transformed, transformed_kernel


def normal(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape).astype(np.float32))


@settings(max_examples=12)
@given(height=st.integers(1, 11), width=st.integers(1, 11), dilation=st.sampled_from([1, 2, 3]), batch=st.integers(1, 2))
def test_the_transformed_convolution_is_the_convolution(height, width, dilation, batch):
    images, kernel = normal(0, batch, height, width, 5), normal(1, 3, 3, 5, 4)
    result = convolve_transformed(images, transformed_kernel(kernel), dilation)
    np.testing.assert_allclose(result, convolve(images, kernel, dilation=dilation), atol=1e-4)


def upsampled_plainly(coarse, fine, depthwise, pointwise, align_corners):
    joined = jnp.concatenate([resize_bilinear(coarse, *fine.shape[1:3], align_corners=align_corners), fine], axis=-1)
    return jnp.dot(convolve(joined, depthwise, depthwise=True), pointwise)


@settings(max_examples=12)
@given(
    coarse_size=st.tuples(st.integers(1, 4), st.integers(1, 4)),
    fine_size=st.tuples(st.integers(1, 13), st.integers(1, 13)),
    size=st.sampled_from([1, 3, 5]),
    batch=st.integers(1, 2),
    align_corners=st.booleans(),
)
def test_upsampling_after_the_products_is_upsampling_before(coarse_size, fine_size, size, batch, align_corners):
    coarse, fine = normal(0, batch, *coarse_size, 3), normal(1, batch, *fine_size, 2)
    depthwise, pointwise = normal(2, size, size, 1, 5), normal(3, 5, 4)
    result = separable_on_upsampled(coarse, fine, depthwise, pointwise, jnp.abs, align_corners=align_corners)
    expected = jnp.abs(upsampled_plainly(coarse, fine, depthwise, pointwise, align_corners))
    np.testing.assert_allclose(result, expected, atol=1e-4)


def test_upsampling_after_the_products_has_the_same_gradient():
    coarse, fine = normal(0, 1, 2, 3, 3), normal(1, 1, 9, 11, 2)
    kernels = normal(2, 3, 3, 1, 5), normal(3, 5, 4)

    def fast(*arrays):
        return (separable_on_upsampled(*arrays, jnp.tanh, align_corners=True) ** 2).sum()

    def plain(*arrays):
        return (jnp.tanh(upsampled_plainly(*arrays, True)) ** 2).sum()

    arrays = (coarse, fine, *kernels)
    for ours, theirs in zip(*(jax.grad(f, argnums=(0, 1, 2, 3))(*arrays) for f in (fast, plain)), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


@settings(max_examples=20)
@given(rows=st.integers(1, 20), band=st.integers(1, 20))
def test_bands_are_the_rows(rows, band):
    band = min(rows, band)
    image = normal(0, 2, rows, 3, 1)
    result = by_bands(lambda first: 2 * jax.lax.dynamic_slice_in_dim(image, first, band, axis=1), rows, band)
    np.testing.assert_array_equal(result, 2 * image)


@given(rows=st.integers(1, 500), row_bytes=st.integers(1, 1 << 22), limit=st.integers(1, 1 << 22))
def test_bands_fill_the_rows_and_keep_to_the_limit(rows, row_bytes, limit):
    band = rows_per_band(rows, row_bytes, limit)
    assert 1 <= band <= rows
    assert band == 1 or band * row_bytes <= limit


@pytest.mark.parametrize("padding", ["torch", "same"])
@pytest.mark.parametrize(("stride", "dilation"), [(1, 1), (2, 1), (1, 2)])
@pytest.mark.parametrize("size", [(13, 6), (8, 9), (2, 5)])
def test_a_unit_in_bands_is_the_unit(size, stride, dilation, padding, monkeypatch):
    record = fold_batch_norm(torch_architecture("mobilenet_v2", ["sand", "rock"]), {})[0]
    record = record.__class__(**{**record.__dict__, "padding": padding})
    unit = mobilenet_v2.InvertedResidual(4, 4, 6, stride, dilation, record)
    for seed, block in enumerate((unit.expand, unit.depthwise, unit.project)):
        block.kernel[...] = normal(seed, *block.kernel.shape)
        block.bias[...] = normal(seed + 3, *block.bias.shape)
    images = normal(9, 2, *size, 4)
    whole = unit(images)
    monkeypatch.setattr(mobilenet_v2, "HIDDEN_BYTES", 1)
    np.testing.assert_allclose(unit(images), whole, atol=1e-4)


@pytest.mark.parametrize("dilation", [1, 6])
def test_only_large_dense_kernels_are_transformed(dilation):
    wide = MIN_CHANNELS
    assert ConvBlock(wide, wide, 3, dilation=dilation).transformable
    assert not ConvBlock(wide, wide, 3, stride=2).transformable
    assert not ConvBlock(wide, wide, 1).transformable
    assert not ConvBlock(wide, wide - 1, 3).transformable
    assert not ConvBlock(wide, wide, 3, depthwise=True).transformable


@pytest.mark.parametrize("backbone", ["mobilenet_v2", "resnet18"])
def test_the_network_for_inference_gives_the_same_logits(backbone):
    record = torch_architecture(backbone, ["sand", "rock"])
    weights = initial_weights(record, jax.random.key(0))
    image = np.random.default_rng(0).integers(0, 256, (1, 49, 70, 3)).astype(np.uint8)
    plain, fast = pure_network(record, weights), inference_network(record, weights)
    logits = np.asarray(jax.jit(plain.apply)(plain.weights, image))
    np.testing.assert_allclose(
        jax.jit(fast.apply)(fast.weights, image), logits, atol=1e-4 * max(1.0, float(np.abs(logits).max()))
    )
