"""The first separable convolution of the decoder, without upsampling the features it reads.

Upsampling is linear and treats channels alike, so it may come after the pointwise product instead of before:
each of the nine elements of the depthwise kernel makes its own product of the coarse features, and the products
are resized, shifted by that element, and summed. At four times the size, nine coarse products are about half
of the sums of one fine one, and no tensor of all channels at the fine size is ever made.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmap.models.convolutions import PRECISION, depthwise_convolve, resize_taps

BAND_BYTES = 1 << 20
"""What a band of rows may hold, so that it stays in the processor's cache."""


class _ShiftedTaps(NamedTuple):
    """For each kernel element along an axis (first index) and target pixel: two source pixels and their weights."""

    low: np.ndarray
    high: np.ndarray
    low_weight: np.ndarray
    high_weight: np.ndarray

    def rows(self, first: Int[Array, ""], count: int) -> list[Array]:
        """The same for `count` target pixels from `first` on."""
        return [jax.lax.dynamic_slice_in_dim(jnp.asarray(taps), first, count, axis=1) for taps in self]


@cache
def _shifted_taps(source: int, target: int, size: int, align_corners: bool) -> _ShiftedTaps:
    """Taps of resizing, then shifting by each element of a kernel of `size`, zeros beyond the image."""
    low, high, share = resize_taps(source, target, align_corners)
    moved = np.arange(target) + np.arange(size)[:, None] - size // 2
    inside = ((moved >= 0) & (moved < target)).astype(np.float32)
    moved = moved.clip(0, target - 1)
    return _ShiftedTaps(low[moved], high[moved], (1 - share[moved]) * inside, share[moved] * inside)


def _resized(images: Array, taps: list[Array], axis: int) -> Array:
    """Images resized along an axis by the taps of one kernel element."""
    low, high, low_weight, high_weight = taps
    shape = [-1 if place == axis else 1 for place in range(4)]
    before = jnp.take(images, low, axis=axis, mode="clip") * low_weight.reshape(shape)
    return before + jnp.take(images, high, axis=axis, mode="clip") * high_weight.reshape(shape)


def separable_on_upsampled(
    coarse: Float[Array, "B h w C"],
    fine: Float[Array, "B H W L"],
    depthwise: Float[Array, "K K 1 I"],
    pointwise: Float[Array, "I O"],
    finish: Callable[[Float[Array, "B b W O"]], Float[Array, "B b W F"]],
    *,
    align_corners: bool,
) -> Float[Array, "B H W F"]:
    """Separable convolution (I = C + L) of the upsampled coarse features joined with the fine ones.

    Args:
        coarse: features upsampled bilinearly to the size of the fine ones.
        fine: features that follow them in the order of channels.
        depthwise: kernel of odd size; zeros stand beyond the image.
        pointwise: kernel of the 1x1 convolution that follows.
        finish: what is done pixel by pixel with the result, in bands of rows.
        align_corners: see `resize_bilinear`.
    """
    channels, outputs, size = coarse.shape[3], pointwise.shape[1], depthwise.shape[0]
    height, width = fine.shape[1:3]
    # One product for all nine, of columns by row, column and output.
    kernels = jnp.moveaxis(depthwise[:, :, 0, :channels, None] * pointwise[:channels], 2, 0)
    products = jnp.tensordot(coarse, kernels, 1, precision=PRECISION)
    horizontal = _shifted_taps(coarse.shape[2], width, size, align_corners)
    wide = [
        sum(_resized(products[:, :, :, row, column], [tap[column] for tap in horizontal], 2) for column in range(size))
        for row in range(size)
    ]
    wide = jax.lax.optimization_barrier(wide)
    fine = depthwise_convolve(fine, depthwise[..., channels:])
    vertical = _shifted_taps(coarse.shape[1], height, size, align_corners)
    band = height
    if jax.default_backend() == "cpu":
        band = rows_per_band(height, 4 * coarse.shape[0] * width * outputs)

    def rows(first: Int[Array, ""]) -> Array:
        window = jax.lax.dynamic_slice_in_dim(fine, first, band, axis=1)
        taps = vertical.rows(first, band)
        tall = sum(_resized(wide[row], [tap[row] for tap in taps], 1) for row in range(size))
        return finish(tall + jnp.dot(window, pointwise[channels:], precision=PRECISION))

    return by_bands(rows, height, band)


def rows_per_band(rows: int, row_bytes: int, limit: int = BAND_BYTES) -> int:
    """Rows of equal bands of at most `limit` bytes; at least one."""
    bands = -(-rows // max(limit // row_bytes, 1))
    return -(-rows // bands)


def by_bands(
    function: Callable[[Int[Array, ""]], Float[Array, "B h W C"]], rows: int, band: int
) -> Float[Array, "B H W C"]:
    """The `rows` rows of an image, of which `function` gives `band` from a first one on.

    Where bands do not fill the rows, the last one begins earlier and writes some rows again.
    """
    shape = jax.eval_shape(function, jax.ShapeDtypeStruct((), jnp.int32))

    def put(index: Array, result: Array) -> Array:
        first = jnp.minimum(index * band, rows - band)
        return jax.lax.dynamic_update_slice_in_dim(result, function(first), first, axis=1)

    empty = jnp.zeros((shape.shape[0], rows, *shape.shape[2:]), shape.dtype)
    return jax.lax.fori_loop(0, -(-rows // band), put, empty)
