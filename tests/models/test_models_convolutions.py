"""Convolutions as slices and products are the convolutions of the library; resizing is bilinear."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmap.models.convolutions import convolve, max_pool, pad_amounts, resize_bilinear


def library_convolve(images, kernel, stride, dilation, padding, groups):
    return jax.lax.conv_general_dilated(
        images,
        kernel,
        (stride, stride),
        padding,
        rhs_dilation=(dilation, dilation),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        feature_group_count=groups,
    )


@settings(max_examples=12)
@given(
    height=st.integers(5, 12),
    width=st.integers(5, 12),
    stride=st.sampled_from([1, 2]),
    dilation=st.sampled_from([1, 2, 6]),
    size=st.sampled_from([1, 3]),
    depthwise=st.booleans(),
)
def test_same_padding_is_the_library_s(height, width, stride, dilation, size, depthwise):
    draw = np.random.default_rng(0)
    images = draw.normal(size=(2, height, width, 4)).astype(np.float32)
    kernel = draw.normal(size=(size, size, 1 if depthwise else 4, 4)).astype(np.float32)
    images, kernel = jnp.asarray(images), jnp.asarray(kernel)
    ours = convolve(images, kernel, stride=stride, dilation=dilation, padding="same", depthwise=depthwise)
    theirs = library_convolve(images, kernel, stride, dilation, "SAME", 4 if depthwise else 1)
    np.testing.assert_allclose(ours, theirs, atol=1e-4)


@pytest.mark.parametrize("depthwise", [True, False])
@pytest.mark.parametrize(("stride", "dilation"), [(1, 1), (2, 1), (1, 3)])
def test_torch_padding_is_the_same_on_both_sides(stride, dilation, depthwise):
    draw = np.random.default_rng(0)
    images = draw.normal(size=(1, 8, 11, 3)).astype(np.float32)
    kernel = draw.normal(size=(3, 3, 1 if depthwise else 3, 3)).astype(np.float32)
    images, kernel = jnp.asarray(images), jnp.asarray(kernel)
    ours = convolve(images, kernel, stride=stride, dilation=dilation, depthwise=depthwise)
    both = [(dilation, dilation)] * 2
    np.testing.assert_allclose(
        ours, library_convolve(images, kernel, stride, dilation, both, 3 if depthwise else 1), atol=1e-4
    )


def test_paddings_differ_at_stride_two_on_even_sizes():
    assert pad_amounts(8, 3, 2, 1, "same") == (0, 1)
    assert pad_amounts(8, 3, 2, 1, "torch") == (1, 1)
    assert pad_amounts(9, 3, 2, 1, "same") == pad_amounts(9, 3, 2, 1, "torch") == (1, 1)


def test_max_pool_takes_the_largest_of_each_window():
    images = np.random.default_rng(0).normal(size=(1, 7, 8, 2)).astype(np.float32) - 5
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1), (0, 0)), constant_values=-np.inf)
    expected = [[padded[0, y : y + 3, x : x + 3].max(axis=(0, 1)) for x in range(0, 8, 2)] for y in range(0, 7, 2)]
    np.testing.assert_array_equal(max_pool(jnp.asarray(images))[0], expected)


@pytest.mark.parametrize("align_corners", [True, False])
def test_a_ramp_stays_a_ramp(align_corners):
    ramp = jnp.broadcast_to(jnp.arange(5.0)[:, None], (5, 4))[None, :, :, None]
    result = np.asarray(resize_bilinear(ramp, 20, 8, align_corners=align_corners))[0, :, 0, 0]
    position = np.arange(20) * 4 / 19 if align_corners else ((np.arange(20) + 0.5) / 4 - 0.5).clip(0, 4)
    np.testing.assert_allclose(result, position, atol=1e-5)


def test_a_constant_stays_constant_at_any_size():
    for size in ((1, 1), (1, 7), (9, 2)):
        images = jnp.full((1, *size, 2), 3.0)
        for align_corners in (True, False):
            resized = resize_bilinear(images, 11, 13, align_corners=align_corners)
            np.testing.assert_allclose(resized, 3.0, rtol=1e-6)
