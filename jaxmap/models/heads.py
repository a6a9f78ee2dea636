"""DeepLab's way from features to logits: atrous spatial pyramid pooling and the decoder (Chen et al. 2018)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxmap.models.architecture import Architecture
from jaxmap.models.bands import by_bands, rows_per_band
from jaxmap.models.convolutions import PRECISION, convolve
from jaxmap.models.layers import ConvBlock, SeparableBlock, dropped
from jaxmap.models.resizing import resize_bilinear, resize_taps

PRODUCTS = 9
"""Coarse products that `separable_on_upsampled` makes with a 3x3 kernel, in the place of a fine one."""

RELIEF_FEATURES = 32
"""Channels that the decoder makes of relief."""


def _plain(inputs: int, outputs: int, record: Architecture, size: int = 1, dilation: int = 1) -> ConvBlock:
    norm = "batch" if record.head_norm else "bias"
    return ConvBlock(inputs, outputs, size, dilation=dilation, norm=norm, eps=record.head_eps)


def _separable(inputs: int, record: Architecture, dilation: int = 1) -> SeparableBlock:
    return SeparableBlock(
        inputs,
        record.head_channels,
        dilation=dilation,
        norm="batch" if record.head_norm else "bias",
        norm_inside=record.norm_inside,
        eps=record.head_eps,
    )


class Aspp(nnx.Module):
    """Branches that see the features at several scales, side by side, reduced to one depth."""

    def __init__(self, inputs: int, record: Architecture) -> None:
        channels = record.head_channels

        def three_by_three(inputs: int, dilation: int = 1) -> SeparableBlock | ConvBlock:
            if record.separable_aspp:
                return _separable(inputs, record, dilation)
            return _plain(inputs, channels, record, 3, dilation)

        self.pool = _plain(inputs, channels, record)
        self.point = _plain(inputs, channels, record)
        self.atrous = nnx.List(three_by_three(inputs, rate) for rate in record.atrous_rates)
        self.project = _plain((2 + len(record.atrous_rates)) * channels, channels, record)
        self.refine = three_by_three(channels) if record.aspp_conv else None
        self.pool_first, self.dropout = record.pool_first, record.dropout

    def __call__(
        self, features: Float[Array, "B H W I"], dropout_key: PRNGKeyArray | None = None
    ) -> Float[Array, "B H W C"]:
        """Applies the pyramid; features are dropped only where a key is given."""
        pooled = self.pool(features.mean(axis=(1, 2), keepdims=True))
        pooled = jnp.broadcast_to(pooled, (*features.shape[:3], pooled.shape[3]))
        branches = [self.point(features), *(branch(features) for branch in self.atrous)]
        branches = [pooled, *branches] if self.pool_first else [*branches, pooled]
        result = dropped(self.project(jnp.concatenate(branches, axis=-1)), self.dropout, dropout_key)
        return result if self.refine is None else self.refine(result)


class ReliefBranch(nnx.Module):
    """What the decoder makes of relief: two 3x3 convolutions, the second dilated, that see 7x7 pixels."""

    def __init__(self, record: Architecture) -> None:
        self.convs = nnx.List(
            _plain(inputs, RELIEF_FEATURES, record, 3, dilation)
            for inputs, dilation in ((record.relief_channels, 1), (RELIEF_FEATURES, 2))
        )

    def __call__(self, relief: Float[Array, "B H W R"]) -> Float[Array, "B H W C"]:
        """Applies the branch."""
        for block in self.convs:
            relief = block(relief)
        return relief


class Decoder(nnx.Module):
    """Joins the upsampled features with the low-level ones, and with those of relief, at stride 4."""

    def __init__(self, low_level_channels: int, record: Architecture) -> None:
        self.reduce = _plain(low_level_channels, record.low_level_channels, record)
        inputs = record.head_channels + record.low_level_channels
        self.relief = ReliefBranch(record) if record.relief_channels else None
        if self.relief is not None:
            inputs += RELIEF_FEATURES
        self.refine = nnx.List(
            _separable(inputs if index == 0 else record.head_channels, record) for index in range(record.decoder_convs)
        )
        self.align_corners = record.align_corners
        # Batch norms that learn need all pixels at once.
        self.mergeable = not (record.head_norm or record.norm_inside) and record.decoder_convs == 1

    def __call__(
        self,
        features: Float[Array, "B h w C"],
        low_level: Float[Array, "B H W L"],
        classifier: Callable[[Float[Array, "B b W C"]], Float[Array, "B b W K"]],
        relief: Float[Array, "B H W R"] | None = None,
    ) -> Float[Array, "B H W K"]:
        """Applies the decoder, then the classifier, pixel by pixel; the result has the size of `low_level`."""
        low_level = self.reduce(low_level)
        if self.relief is not None:
            assert relief is not None
            low_level = jnp.concatenate([low_level, self.relief(relief)], axis=-1)
        coarse, fine = features.shape[1:3], low_level.shape[1:3]
        if self.mergeable and PRODUCTS * coarse[0] * coarse[1] <= fine[0] * fine[1]:
            block = self.refine[0]
            return separable_on_upsampled(
                features,
                low_level,
                block.depthwise.kernel[...],
                block.pointwise.kernel[0, 0],
                lambda band: classifier(block.pointwise.finish(band)),
                align_corners=self.align_corners,
            )
        features = resize_bilinear(features, *fine, align_corners=self.align_corners)
        features = jnp.concatenate([features, low_level], axis=-1)
        for block in self.refine:
            features = block(features)
        return classifier(features)


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


def _resized(images: Array, taps: Sequence[Array | np.ndarray], axis: int) -> Array:
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

    Upsampling is linear and treats channels alike, so it may follow the pointwise product instead of preceding it:
    each of the nine elements of the depthwise kernel makes its own product of the coarse features, and the products
    are resized, shifted by that element, and summed. At four times the size, nine coarse products are about half
    of the sums of one fine one, and no tensor of all channels at the fine size is ever made.

    Args:
        coarse: features upsampled bilinearly to the size of the fine ones.
        fine: features that follow them in the order of channels.
        depthwise: kernel of odd size; zeros stand beyond the image.
        pointwise: kernel of the 1x1 convolution that follows.
        finish: applied to bands of rows of the result; it must treat pixels alike.
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
    fine = convolve(fine, depthwise[..., channels:], depthwise=True)
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
