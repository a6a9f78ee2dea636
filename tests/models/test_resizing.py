"""Resizing is bilinear; its gradient is its transpose."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxmap.models.resizing import resize_area, resize_bilinear, resize_rows


@pytest.mark.parametrize("align_corners", [True, False])
def test_a_ramp_stays_a_ramp(align_corners):
    ramp = jnp.broadcast_to(jnp.arange(5.0)[:, None], (5, 4))[None, :, :, None]
    result = np.asarray(resize_bilinear(ramp, 20, 8, align_corners=align_corners))[0, :, 0, 0]
    position = np.arange(20) * 4 / 19 if align_corners else ((np.arange(20) + 0.5) / 4 - 0.5).clip(0, 4)
    np.testing.assert_allclose(result, position, atol=1e-5)


@given(st.integers(1, 40), st.integers(1, 40), st.booleans())
def test_the_matrix_of_an_axis_averages_two_neighbours(source, target, align_corners):
    matrix = resize_rows(np.eye(source), target, align_corners=align_corners)
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-6)
    assert matrix.min() >= -1e-9 and (matrix > 1e-9).sum(axis=1).max() <= 2


@settings(max_examples=4)
@given(
    before=st.tuples(st.integers(1, 5), st.integers(1, 5)),
    after=st.tuples(st.integers(1, 11), st.integers(1, 11)),
    align_corners=st.booleans(),
)
@example(before=(1, 1), after=(1, 7), align_corners=True)
@example(before=(5, 3), after=(11, 2), align_corners=True)
@example(before=(5, 3), after=(2, 9), align_corners=False)
def test_resizing_is_its_matrices_and_its_gradient_their_transposes(before, after, align_corners):
    draw = np.random.default_rng(0)
    with jax.enable_x64(True):
        images, back = draw.normal(size=(2, *before, 3)), draw.normal(size=(2, *after, 3))

        @jax.jit
        def both(images, back):
            resized, backward = jax.vjp(lambda x: resize_bilinear(x, *after, align_corners=align_corners), images)
            return resized, backward(back)[0]

        rows, columns = (
            resize_rows(np.eye(old), new, align_corners=align_corners) for old, new in zip(before, after, strict=True)
        )
        resized, gradient = both(images, back)
    np.testing.assert_allclose(resized, np.einsum("vr,uc,brcn->bvun", rows, columns, images), atol=1e-6)
    np.testing.assert_allclose(gradient, np.einsum("vr,uc,bvun->brcn", rows, columns, back), atol=1e-6)


@given(
    before=st.tuples(st.integers(1, 12), st.integers(1, 12)), after=st.tuples(st.integers(1, 12), st.integers(1, 12))
)
@settings(max_examples=5)
@example(before=(8, 6), after=(4, 2))
@example(before=(5, 2), after=(3, 4))
def test_shrinking_averages_and_growing_interpolates(before, after):
    images = np.random.default_rng(0).normal(size=(2, *before, 3)).astype(np.float32)
    expected = images
    for axis, (old, new) in enumerate(zip(before, after, strict=True), start=1):
        if old <= new:
            matrix = resize_rows(np.eye(old), new, align_corners=False)
        else:
            # Each pixel is cut into as many pieces as there are new ones, and old pieces make a new pixel.
            matrix = np.repeat(np.eye(old), new, axis=0).reshape(new, old, old).mean(axis=1)
        expected = np.moveaxis(np.tensordot(matrix, expected, (1, axis)), 0, axis)
    np.testing.assert_allclose(resize_area(jnp.asarray(images), *after), expected, atol=1e-5)
