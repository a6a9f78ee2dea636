"""Images made a few rows at a time are those made at once."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.models import backbones, layers
from jaxmap.models.architecture import Padding, folded, torch_architecture
from jaxmap.models.backbones import InvertedResidual, InvertedResidualNet
from jaxmap.models.bands import by_bands, rows_per_band
from jaxmap.models.layers import ConvBlock, apply_by_bands


def normal(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize(("rows", "band"), [(1, 1), (7, 7), (12, 4), (20, 6)])
def test_bands_are_the_rows(rows, band):
    image = jnp.asarray(normal(0, 2, rows, 3, 1))
    result = by_bands(lambda first: 2 * jax.lax.dynamic_slice_in_dim(image, first, band, axis=1), rows, band)
    np.testing.assert_array_equal(result, 2 * image)


@given(rows=st.integers(1, 500), row_bytes=st.integers(1, 1 << 22), limit=st.integers(1, 1 << 22))
def test_bands_fill_the_rows_and_keep_to_the_limit(rows, row_bytes, limit):
    band = rows_per_band(rows, row_bytes, limit)
    assert 1 <= band <= rows
    assert band == 1 or band * row_bytes <= limit


def test_blocks_by_bands_are_those_of_the_whole_image(monkeypatch):
    def block(inputs: int, outputs: int, size: int = 1, padding: Padding = "same", **more) -> ConvBlock:
        return ConvBlock(inputs, outputs, size, padding=padding, norm="bias", activation="relu6", **more)

    def middle(size: int, **more) -> ConvBlock:
        return block(4, 4, size, depthwise=True, **more)

    chains = [
        [block(4, 4), middle(5, dilation=2), block(4, 3)],
        [block(4, 4), middle(5, stride=2, padding="torch")],
        [block(4, 4, 3, stride=2), middle(3), block(4, 4), middle(3, stride=2), block(4, 3)],
    ]
    for number, chain in enumerate(chains):
        for place, one in enumerate(chain):
            one.kernel[...] = normal(10 * number + place, *one.kernel.shape)
            assert one.bias is not None
            one.bias[...] = 1 + normal(10 * number + place, *one.bias.shape)
    monkeypatch.setattr(layers, "rows_per_band", lambda rows, row_bytes: min(rows, 3))

    @jax.jit
    def results(images):
        whole = []
        for chain in chains:
            whole.append(images)
            for one in chain:
                whole[-1] = one(whole[-1])
        return whole, [apply_by_bands(chain, images) for chain in chains]

    for expected, found in zip(*results(normal(0, 2, 11, 8, 4)), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.slow
def test_the_gradient_of_blocks_by_bands_is_that_of_the_whole_image(monkeypatch):
    monkeypatch.setattr(layers, "rows_per_band", lambda rows, row_bytes: 3)
    blocks = nnx.List([ConvBlock(2, 3, norm="bias"), ConvBlock(3, 3, 3, depthwise=True, norm="bias")])
    for number, block in enumerate(blocks):
        block.kernel[...] = normal(number, *block.kernel.shape)
    graph, state = nnx.split(blocks)

    def whole(blocks, images):
        for block in blocks:
            images = block(images)
        return images

    def loss(state, images, apply):
        return jnp.sin(apply(nnx.merge(graph, state), images)).sum()

    both = [jax.jit(jax.grad(partial(loss, apply=apply), argnums=(0, 1))) for apply in (whole, apply_by_bands)]
    expected, found = (jax.tree.leaves(gradient(state, normal(5, 1, 7, 6, 2))) for gradient in both)
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_allclose(other, one, atol=1e-5)


def test_large_hidden_images_are_made_by_bands_where_norms_are_folded(monkeypatch):
    record, calls = folded(torch_architecture("efficientnet_lite0", ["sand", "rock"])), []

    def counted(blocks, images):
        calls.append(len(blocks))
        for block in blocks:
            images = block(images)
        return images

    monkeypatch.setattr(backbones, "apply_by_bands", counted)
    monkeypatch.setenv("JAXMAP_NATIVE", "0")

    images = jax.ShapeDtypeStruct((1, 384, 512, 3), jnp.float32)
    nnx.eval_shape(lambda images: InvertedResidualNet(record)(images), images)
    assert calls == [6]
    unit = InvertedResidual(24, 24, 6, 1, 1, record)
    assert unit.is_large((1, 192, 256, 24)) and not unit.is_large((1, 96, 128, 24))
    assert not InvertedResidual(24, 24, 6, 1, 1, replace(record, backbone_norm=True)).is_large((1, 192, 256, 24))
