"""Images made a few rows at a time are those made at once."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.models import backbones
from jaxmap.models.architecture import folded, torch_architecture
from jaxmap.models.backbones import InvertedResidual
from jaxmap.models.bands import by_bands, rows_per_band


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


# Outputs, stride, dilation, and size of the kernel; the first has a shortcut.
BANDED = [(4, 1, 1, 3), (6, 2, 1, 3), (6, 2, 1, 5), (6, 1, 2, 5)]


@pytest.mark.parametrize("padding", ["same", "torch"])
def test_an_inverted_residual_by_bands_is_that_of_the_whole_image(padding, monkeypatch):
    record = replace(folded(torch_architecture("mobilenet_v2", ["sand", "rock"])), padding=padding)
    units = [
        InvertedResidual(4, outputs, 2, stride, dilation, record, size) for outputs, stride, dilation, size in BANDED
    ]
    for number, unit in enumerate(units):
        _, state = nnx.split(unit)
        for index, (_, variable) in enumerate(nnx.to_flat_state(state)):
            variable.set_value(jnp.asarray(normal(10 * number + index, *variable.get_value().shape)))
        nnx.update(unit, state)

    def results(images):
        return [unit(images) for unit in units]

    images = jnp.asarray(normal(0, 2, 11, 8, 4))
    whole = jax.jit(lambda images: results(images))(images)
    monkeypatch.setattr(backbones, "HIDDEN_BYTES", 0)
    monkeypatch.setattr(backbones, "rows_per_band", lambda rows, row_bytes: 4)
    for ours, theirs in zip(jax.jit(results)(images), whole, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)
