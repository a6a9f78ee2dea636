"""Convolutions as slices, products and transforms are the library's; their gradients are those of the definition."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxmap.models.convolutions import (
    WINOGRAD_MIN_CHANNELS,
    Axis,
    convolve,
    convolve_winograd,
    kernel_gradient,
    kernel_gradient_by_rows,
    max_pool,
    pad_amounts,
    winograd_kernel,
)
from jaxmap.models.layers import ConvBlock


def normal(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def normal32(*shape, seed=0):
    return jnp.asarray(normal(*shape, seed=seed), jnp.float32)


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


@pytest.mark.parametrize("padding", ["same", "torch"])
def test_convolutions_are_the_library_s(padding):
    images = normal32(2, 8, 11, 4)
    cases = [
        (stride, dilation, size, depthwise)
        for stride, dilation in ((1, 1), (2, 1), (1, 2), (1, 6))
        for size in (1, 3, 5)
        for depthwise in (True, False)
    ]
    kernels = [normal32(size, size, 1 if depthwise else 4, 4) for _, _, size, depthwise in cases]

    # All in one program: one for each would take most of the time.
    @jax.jit
    def results(images, kernels):
        found = []
        for (stride, dilation, size, depthwise), kernel in zip(cases, kernels, strict=True):
            ours = convolve(images, kernel, stride=stride, dilation=dilation, padding=padding, depthwise=depthwise)
            sides = "SAME" if padding == "same" else [(dilation * (size - 1) // 2,) * 2] * 2
            found.append((ours, library_convolve(images, kernel, stride, dilation, sides, 4 if depthwise else 1)))
        return found

    for case, (ours, theirs) in zip(cases, results(images, kernels), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4, err_msg=str(case))


def test_paddings_differ_at_stride_two_on_even_sizes():
    assert pad_amounts(8, 3, 2, 1, "same") == (0, 1)
    assert pad_amounts(8, 3, 2, 1, "torch") == (1, 1)
    assert pad_amounts(8, 5, 2, 1, "same") == (1, 2)
    assert pad_amounts(9, 3, 2, 1, "same") == pad_amounts(9, 3, 2, 1, "torch") == (1, 1)


def test_max_pool_takes_the_largest_of_each_window():
    images = normal(1, 7, 8, 2).astype(np.float32) - 5
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1), (0, 0)), constant_values=-np.inf)
    expected = [[padded[0, y : y + 3, x : x + 3].max(axis=(0, 1)) for x in range(0, 8, 2)] for y in range(0, 7, 2)]
    np.testing.assert_array_equal(max_pool(jnp.asarray(images))[0], expected)


def depthwise_gradients(images, kernel, back, stride, dilation, padding):
    """The slow twin: gradients of images and depthwise kernel, output by output."""
    size = kernel.shape[0]
    top, left = (pad_amounts(images.shape[axis], size, stride, dilation, padding)[0] for axis in (1, 2))
    of_images, of_kernel = np.zeros_like(images), np.zeros_like(kernel)
    for row_out, column_out in np.ndindex(back.shape[1:3]):
        for row, column in np.ndindex(size, size):
            y, x = row_out * stride + row * dilation - top, column_out * stride + column * dilation - left
            if 0 <= y < images.shape[1] and 0 <= x < images.shape[2]:
                of_images[:, y, x] += back[:, row_out, column_out] * kernel[row, column, 0]
                of_kernel[row, column, 0] += (images[:, y, x] * back[:, row_out, column_out]).sum(axis=0)
    return of_images, of_kernel


@pytest.mark.slow
@settings(max_examples=1)
@given(
    batch=st.integers(1, 3),
    height=st.integers(1, 9),
    width=st.integers(1, 9),
    size=st.sampled_from([1, 3, 5]),
    stride=st.sampled_from([1, 2, 3]),
    dilation=st.sampled_from([1, 2, 7]),
    padding=st.sampled_from(["torch", "same"]),
)
@example(batch=2, height=7, width=6, size=3, stride=2, dilation=1, padding="same")
@example(batch=2, height=6, width=7, size=3, stride=2, dilation=1, padding="torch")
@example(batch=1, height=8, width=5, size=3, stride=1, dilation=7, padding="torch")
@example(batch=3, height=1, width=9, size=5, stride=3, dilation=2, padding="same")
def test_depthwise_gradients_are_the_definition_s(batch, height, width, size, stride, dilation, padding):
    with jax.enable_x64(True):
        images, kernel = normal(batch, height, width, 3), normal(size, size, 1, 3)
        function = partial(convolve, stride=stride, dilation=dilation, padding=padding, depthwise=True)
        back = normal(*jax.eval_shape(function, images, kernel).shape, seed=1)
        axes = tuple(Axis.of(length, size, stride, dilation, padding) for length in (height, width))

        @jax.jit
        def gradients(images, kernel, back):
            return *jax.vjp(function, images, kernel)[1](back), kernel_gradient(images, back, axes=axes)

        of_images, of_kernel, elsewhere = gradients(images, kernel, back)
        expected_images, expected_kernel = depthwise_gradients(images, kernel, back, stride, dilation, padding)
        np.testing.assert_allclose(of_images, expected_images, atol=1e-12)
        np.testing.assert_allclose(of_kernel, expected_kernel, atol=1e-12)
        np.testing.assert_allclose(elsewhere, expected_kernel, atol=1e-12)


@pytest.mark.slow
def test_rows_of_several_images_are_summed_together_or_apart():
    axes = (Axis.of(2, 3, 1, 1, "torch"), Axis.of(3, 3, 1, 1, "torch"))
    # The first fits as a block of two images, the second as one image only.
    for channels in (3000, 20000):
        images, back = (normal32(4, 2, 3, channels, seed=seed) for seed in (0, 1))
        rows, whole = jax.jit(
            lambda *arrays: (kernel_gradient_by_rows(*arrays, axes=axes), kernel_gradient(*arrays, axes=axes))
        )(images, back)
        np.testing.assert_allclose(rows, whole, atol=2e-5)


def test_pointwise_gradients_are_the_definition_s():
    with jax.enable_x64(True):
        images, kernel, back = normal(2, 5, 4, 3), normal(1, 1, 3, 6), normal(2, 3, 2, 6, seed=1)
        function = partial(convolve, stride=2)
        of_images, of_kernel = jax.jit(lambda *at: jax.vjp(function, *at[:2])[1](at[2]))(images, kernel, back)
        np.testing.assert_allclose(of_kernel[0, 0], np.einsum("bhwi,bhwo->io", images[:, ::2, ::2], back), atol=1e-12)
        expected = np.zeros_like(images)
        expected[:, ::2, ::2] = back @ kernel[0, 0].T
        np.testing.assert_allclose(of_images, expected, atol=1e-12)


@pytest.mark.slow
def test_gradients_over_a_batch_of_problems_are_those_of_each():
    arrays = normal32(2, 2, 6, 5, 4), normal32(2, 3, 3, 1, 4, seed=1), normal32(2, 1, 1, 4, 5, seed=2)

    def loss(images, depthwise, pointwise):
        return jnp.sin(convolve(convolve(images, depthwise, depthwise=True, stride=2), pointwise)).sum()

    gradient = jax.grad(loss, argnums=(0, 1, 2))
    together, alone = jax.jit(jax.vmap(gradient))(*arrays), jax.jit(gradient)
    for index in range(2):
        for ours, theirs in zip(alone(*(array[index] for array in arrays)), together, strict=True):
            np.testing.assert_allclose(ours, theirs[index], atol=1e-5)


def dense(images: np.ndarray, kernel: np.ndarray, dilation: int) -> np.ndarray:
    """The slow twin: the sum over all elements of the kernel that meet the image, in double precision."""
    batch, height, width, _ = images.shape
    result = np.zeros((batch, height, width, kernel.shape[3]))
    for y, x, row, column in np.ndindex(height, width, 3, 3):
        source = y + (row - 1) * dilation, x + (column - 1) * dilation
        if 0 <= source[0] < height and 0 <= source[1] < width:
            result[:, y, x] += images[:, *source].astype(np.float64) @ kernel[row, column].astype(np.float64)
    return result


@partial(jax.jit, static_argnames="dilation")
def by_winograd(images, kernel, dilation):
    return convolve_winograd(images, winograd_kernel(kernel), dilation)


@pytest.mark.slow
@pytest.mark.parametrize(("height", "width", "dilation", "batch"), [(1, 1, 3, 1), (6, 7, 2, 2), (9, 4, 1, 1)])
def test_winograd_s_convolution_is_the_convolution_at_any_size(height, width, dilation, batch):
    images, kernel = normal32(batch, height, width, 5), normal32(3, 3, 5, 4, seed=1)
    np.testing.assert_allclose(
        by_winograd(images, kernel, dilation), dense(np.asarray(images), np.asarray(kernel), dilation), atol=1e-4
    )


def test_winograd_s_error_at_full_depth_is_that_of_float32():
    images, kernel = normal32(1, 6, 7, 512), normal32(3, 3, 512, 16, seed=1)
    expected = dense(np.asarray(images), np.asarray(kernel), 2)
    # Sums of 4608 products of this size are some 70; one rounding there is 8e-6.
    np.testing.assert_allclose(by_winograd(images, kernel, 2), expected, atol=1e-5 * float(np.abs(expected).max()))


def test_only_large_dense_kernels_are_transformed():
    wide = WINOGRAD_MIN_CHANNELS
    assert ConvBlock(wide, wide, 3).transformable
    assert ConvBlock(wide, wide, 3, dilation=6).transformable
    assert not ConvBlock(wide, wide, 3, stride=2).transformable
    assert not ConvBlock(wide, wide, 1).transformable
    assert not ConvBlock(wide, wide - 1, 3).transformable
    assert not ConvBlock(wide, wide, 3, depthwise=True).transformable
