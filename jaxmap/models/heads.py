"""What turns features into logits: atrous spatial pyramid pooling and the decoder (Chen et al. 2018)."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, PRNGKeyArray

from jaxmap.models.architecture import Architecture
from jaxmap.models.convolutions import resize_bilinear
from jaxmap.models.layers import ConvBlock, SeparableBlock
from jaxmap.models.upsampled import separable_on_upsampled

PRODUCTS = 9
"""Coarse products that `separable_on_upsampled` makes with a 3x3 kernel, in the place of a fine one."""


def _separable(inputs: int, record: Architecture, dilation: int = 1) -> SeparableBlock:
    return SeparableBlock(
        inputs,
        record.head_channels,
        dilation=dilation,
        norm="batch" if record.head_norm else "bias",
        norm_inside=record.norm_inside,
        eps=record.head_eps,
    )


def _plain(inputs: int, outputs: int, record: Architecture, size: int = 1, dilation: int = 1) -> ConvBlock:
    norm = "batch" if record.head_norm else "bias"
    return ConvBlock(inputs, outputs, size, dilation=dilation, norm=norm, eps=record.head_eps)


def _three_by_three(inputs: int, record: Architecture, dilation: int = 1) -> SeparableBlock | ConvBlock:
    if record.separable_aspp:
        return _separable(inputs, record, dilation)
    return _plain(inputs, record.head_channels, record, 3, dilation)


class Aspp(nnx.Module):
    """Branches that see the features at several scales, side by side, reduced to one depth."""

    def __init__(self, inputs: int, record: Architecture) -> None:
        channels = record.head_channels
        self.pool = _plain(inputs, channels, record)
        self.point = _plain(inputs, channels, record)
        self.atrous = nnx.List(_three_by_three(inputs, record, rate) for rate in record.atrous_rates)
        self.project = _plain((2 + len(record.atrous_rates)) * channels, channels, record)
        self.refine = _three_by_three(channels, record) if record.aspp_conv else None
        self.pool_first, self.dropout = record.pool_first, record.dropout

    def __call__(
        self, features: Float[Array, "B H W I"], dropout_key: PRNGKeyArray | None = None
    ) -> Float[Array, "B H W C"]:
        """Applies the pyramid; features are dropped only where a key is given."""
        pooled = self.pool(features.mean(axis=(1, 2), keepdims=True))
        pooled = jnp.broadcast_to(pooled, (*features.shape[:3], pooled.shape[3]))
        branches = [self.point(features), *(branch(features) for branch in self.atrous)]
        branches = [pooled, *branches] if self.pool_first else [*branches, pooled]
        result = self.project(jnp.concatenate(branches, axis=-1))
        if dropout_key is not None and self.dropout > 0:
            kept = jax.random.bernoulli(dropout_key, 1 - self.dropout, result.shape)
            result = jnp.where(kept, result / (1 - self.dropout), 0)
        return result if self.refine is None else self.refine(result)


class Decoder(nnx.Module):
    """Joins the upsampled features with the low-level ones, at stride 4."""

    def __init__(self, low_level_channels: int, record: Architecture) -> None:
        self.reduce = _plain(low_level_channels, record.low_level_channels, record)
        inputs = record.head_channels + record.low_level_channels
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
    ) -> Float[Array, "B H W K"]:
        """Applies the decoder, then the classifier, pixel by pixel; the result has the size of `low_level`."""
        low_level = self.reduce(low_level)
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
        features = resize_bilinear(features, *low_level.shape[1:3], align_corners=self.align_corners)
        features = jnp.concatenate([features, low_level], axis=-1)
        for block in self.refine:
            features = block(features)
        return classifier(features)
