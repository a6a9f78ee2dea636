"""Upsampling after the products of a separable convolution is upsampling before them, and the decoder uses it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from golden.seeded_weights import seeded_weights
from jaxtyping import ArrayLike

from jaxmap.models import heads
from jaxmap.models.architecture import Architecture, torch_architecture
from jaxmap.models.heads import RELIEF_FEATURES, Decoder, separable_on_upsampled
from jaxmap.models.network import fold_batch_norm, weight_shapes


def normal(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def position(target: int, count: int, source: int, align_corners: bool) -> float:
    """Where a target pixel of `count` lies among those of `source`."""
    if align_corners:
        return target * (source - 1) / max(count - 1, 1)
    return min(max((target + 0.5) * source / count - 0.5, 0), source - 1)


def slowly(coarse, fine, depthwise, pointwise, align_corners):
    """The slow twin, pixel by pixel as the definition says: upsample, join, depthwise, pointwise."""
    size, (height, width) = depthwise.shape[0], fine.shape[1:3]
    joined = np.zeros((*fine.shape[:3], coarse.shape[3] + fine.shape[3]))
    for y, x in np.ndindex(height, width):
        v = position(y, height, coarse.shape[1], align_corners)
        u = position(x, width, coarse.shape[2], align_corners)
        for row, column in np.ndindex(*coarse.shape[1:3]):
            share = max(1 - abs(v - row), 0) * max(1 - abs(u - column), 0)
            joined[:, y, x, : coarse.shape[3]] += share * coarse[:, row, column]
        joined[:, y, x, coarse.shape[3] :] = fine[:, y, x]
    result = np.zeros((*fine.shape[:3], pointwise.shape[1]))
    for y, x, row, column in np.ndindex(height, width, size, size):
        source = y + row - size // 2, x + column - size // 2
        if 0 <= source[0] < height and 0 <= source[1] < width:
            result[:, y, x] += (joined[:, *source] * depthwise[row, column, 0]) @ pointwise
    return result


@pytest.mark.parametrize(
    ("coarse_size", "fine_size", "size", "batch", "align_corners"),
    [
        ((1, 1), (1, 1), 3, 1, True),
        ((2, 3), (9, 11), 3, 2, True),
        ((4, 2), (7, 5), 5, 1, False),
        ((3, 4), (2, 10), 1, 1, False),
        ((4, 1), (3, 8), 3, 1, False),
    ],
)
def test_upsampling_after_the_products_is_upsampling_before(coarse_size, fine_size, size, batch, align_corners):
    arrays = normal(0, batch, *coarse_size, 3), normal(1, batch, *fine_size, 2)
    kernels = normal(2, size, size, 1, 5), normal(3, 5, 4)
    compiled = jax.jit(lambda *given: separable_on_upsampled(*given, jnp.abs, align_corners=align_corners))
    result = compiled(*arrays, *kernels)
    np.testing.assert_allclose(result, np.abs(slowly(*arrays, *kernels, align_corners)), atol=1e-4)


RECORD = replace(torch_architecture("resnet18", ["sand", "rock"]), head_channels=8, low_level_channels=4)
SEEING = replace(RECORD, relief_channels=3)


def filled(record: Architecture, weights: Mapping[str, ArrayLike]) -> Decoder:
    """A decoder with its part of the weights of a network."""
    decoder = Decoder(64, record)
    for path, variable in nnx.to_flat_state(nnx.state(decoder)):
        variable.set_value(jnp.asarray(weights[".".join(map(str, ("decoder", *path)))]))
    return decoder


def test_the_decoder_uses_it_where_it_spares_products(monkeypatch):
    assert not Decoder(64, SEEING).mergeable, "batch norms that may learn need all pixels at once"
    weights, calls = seeded_weights(SEEING), []
    record, fewer = fold_batch_norm(SEEING, weights)
    fast, plain, unfolded = filled(record, fewer), filled(record, fewer), filled(SEEING, weights)
    plain.mergeable = False

    def counted(*arguments, **options):
        calls.append(True)
        return separable_on_upsampled(*arguments, **options)

    monkeypatch.setattr(heads, "separable_on_upsampled", counted)
    fine, relief = normal(8, 1, 8, 12, 64), jnp.asarray(normal(9, 1, 8, 12, 3))
    jax.eval_shape(lambda coarse, fine: fast(coarse, fine, jnp.tanh, relief), normal(7, 1, 4, 6, 8), fine)
    assert not calls

    @jax.jit
    def all_three(coarse, fine, relief):
        return [decoder(coarse, fine, jnp.tanh, relief) for decoder in (fast, plain, unfolded)]

    coarse = normal(7, 1, 2, 3, 8)
    result, expected, before = all_three(coarse, fine, relief)
    assert len(calls) == 1
    np.testing.assert_allclose(result, expected, atol=1e-4)
    np.testing.assert_allclose(before, expected, atol=1e-4)
    # What it sees matters, two pixels and their neighbours away, and no further.
    moved = np.abs(all_three(coarse, fine, relief + (np.arange(12) == 0)[:, None])[0] - result).max(axis=(0, 1, 3))
    assert (moved[:5] > 1e-5).all() and (moved[5:] < 1e-6).all()


def test_relief_adds_a_branch_and_widens_the_convolution_that_joins_it():
    without, seeing = weight_shapes(RECORD), weight_shapes(SEEING)
    assert set(seeing) - set(without) == {
        f"decoder.relief.convs.{index}.{leaf}"
        for index in (0, 1)
        for leaf in ("kernel", "norm.scale", "norm.bias", "norm.mean", "norm.var")
    }
    changed = {name for name in without if without[name] != seeing[name]}
    assert changed == {"decoder.refine.0.depthwise.kernel", "decoder.refine.0.pointwise.kernel"}
    assert seeing["decoder.refine.0.pointwise.kernel"][2] == 8 + 4 + RELIEF_FEATURES
