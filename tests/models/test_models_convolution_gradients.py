"""Gradients of convolutions and of resizing are those of their definitions."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxmap.models.convolution_gradients import Sliding, kernel_gradient, kernel_gradient_by_rows
from jaxmap.models.convolutions import convolve, pad_amounts, resize_bilinear


def twin(images, kernel, back, stride, dilation, padding):
    """Gradients of images and depthwise kernel, output by output."""
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


def normal(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


@settings(max_examples=25)
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
def test_depthwise_gradients_are_the_definition_s(batch, height, width, size, stride, dilation, padding):
    with jax.enable_x64(True):
        images, kernel = normal(batch, height, width, 3), normal(size, size, 1, 3)
        function = partial(convolve, stride=stride, dilation=dilation, padding=padding, depthwise=True)
        back = normal(*jax.eval_shape(function, images, kernel).shape, seed=1)
        # Compiled as a whole: operation by operation it would take many programs for each size.
        of_images, of_kernel = jax.jit(lambda *at: jax.vjp(function, *at[:2])[1](at[2]))(images, kernel, back)
        expected_images, expected_kernel = twin(images, kernel, back, stride, dilation, padding)
        np.testing.assert_allclose(of_images, expected_images, atol=1e-12)
        np.testing.assert_allclose(of_kernel, expected_kernel, atol=1e-12)
        before = tuple(pad_amounts(length, size, stride, dilation, padding)[0] for length in (height, width))
        elsewhere = kernel_gradient(images, back, sliding=Sliding(size, stride, dilation, before))
        np.testing.assert_allclose(elsewhere, expected_kernel, atol=1e-12)


def test_rows_of_several_images_are_summed_together_or_apart():
    # The first fits as a block of all images, the last not as a block of two.
    for channels in (8, 3000, 20000):
        images, back = (jnp.asarray(normal(4, 2, 3, channels, seed=seed), jnp.float32) for seed in (0, 1))
        sliding = Sliding(3, 1, 1, (1, 1))
        rows = jax.jit(partial(kernel_gradient_by_rows, sliding=sliding))(images, back)
        np.testing.assert_allclose(rows, kernel_gradient(images, back, sliding=sliding), atol=2e-5)


@pytest.mark.parametrize("stride", [1, 2])
def test_pointwise_gradients_are_the_definition_s(stride):
    with jax.enable_x64(True):
        images, kernel = normal(2, 5, 4, 3), normal(1, 1, 3, 6)
        result, backward = jax.vjp(partial(convolve, stride=stride), jnp.asarray(images), jnp.asarray(kernel))
        back = normal(*result.shape, seed=1)
        of_images, of_kernel = backward(jnp.asarray(back))
        met = images[:, ::stride, ::stride]
        np.testing.assert_allclose(of_kernel[0, 0], np.einsum("bhwi,bhwo->io", met, back), atol=1e-12)
        expected = np.zeros_like(images)
        expected[:, ::stride, ::stride] = back @ kernel[0, 0].T
        np.testing.assert_allclose(of_images, expected, atol=1e-12)


@pytest.mark.parametrize("options", [{"depthwise": True}, {"depthwise": True, "stride": 2}, {}], ids=str)
def test_gradients_over_a_batch_of_problems_are_those_of_each(options):
    kernels = jnp.asarray(normal(2, 3, 3, 1, 4) if options else normal(2, 1, 1, 4, 5), jnp.float32)
    images = jnp.asarray(normal(2, 2, 6, 5, 4, seed=1), jnp.float32)

    def loss(images, kernel):
        return jnp.sin(convolve(images, kernel, **options)).sum()

    gradient = jax.jit(jax.grad(loss, argnums=(0, 1)))
    together = jax.jit(jax.vmap(jax.grad(loss, argnums=(0, 1))))(images, kernels)
    for index in range(2):
        for ours, theirs in zip(gradient(images[index], kernels[index]), together, strict=True):
            np.testing.assert_allclose(ours, theirs[index], atol=1e-5)


@settings(max_examples=15)
@given(
    height=st.integers(1, 5),
    width=st.integers(1, 5),
    rows=st.integers(1, 11),
    columns=st.integers(1, 11),
    align_corners=st.booleans(),
)
def test_resizing_backward_is_its_transpose(height, width, rows, columns, align_corners):
    with jax.enable_x64(True):

        def resize(images):
            return resize_bilinear(images, rows, columns, align_corners=align_corners)

        images = jnp.asarray(normal(2, height, width, 3))
        back = jnp.asarray(normal(2, rows, columns, 3, seed=1))
        # Linear: <resize(x), y> = <x, backward(y)> for all x, one pixel of one channel at a time.
        (ours,) = jax.jit(lambda images, back: jax.vjp(resize, images)[1](back))(images, back)
        pixels = jnp.eye(height * width).reshape(-1, 1, height, width, 1)
        of_pixels = jax.jit(jax.vmap(resize))(jnp.broadcast_to(pixels, (height * width, 1, height, width, 1)))
        expected = jnp.einsum("phw,bhwc->bpc", of_pixels[:, 0, :, :, 0], back).reshape(ours.shape)
        np.testing.assert_allclose(ours, expected, atol=1e-6)
