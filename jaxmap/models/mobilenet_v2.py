"""MobileNetV2 as a feature extractor (Sandler et al. 2018)."""

from __future__ import annotations

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jaxmap.models.architecture import Architecture, Padding
from jaxmap.models.bands import rows_per_band
from jaxmap.models.convolutions import pad_amounts
from jaxmap.models.layers import ConvBlock, dilations

STAGES = ((1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1), (6, 160, 3, 2), (6, 320, 1, 1))
"""Expansion, channels, units and first stride of each stage (the paper's table 2)."""

LOW_LEVEL_UNIT = 2
"""The unit whose output is the low-level feature: the last at stride 4, 24 channels."""

TOP_CHANNELS = 1280

HIDDEN_BYTES = 4 << 20
"""What a unit may hold at once of its widest tensor."""


class InvertedResidual(nnx.Module):
    """1x1 expansion, 3x3 depthwise, 1x1 projection without activation, added to the input where both fit."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        expansion: int,
        stride: int,
        dilation: int,
        record: Architecture,
    ) -> None:
        hidden = inputs * expansion
        norm = "batch" if record.backbone_norm else "bias"
        eps = record.backbone_eps
        self.expand = ConvBlock(inputs, hidden, norm=norm, eps=eps, activation="relu6") if expansion > 1 else None
        self.depthwise = ConvBlock(
            hidden,
            hidden,
            3,
            stride=stride,
            dilation=dilation,
            padding=record.padding,
            depthwise=True,
            norm=norm,
            eps=eps,
            activation="relu6",
        )
        self.project = ConvBlock(hidden, outputs, norm=norm, eps=eps, activation="none")
        self.shortcut = stride == 1 and inputs == outputs
        self.hidden, self.stride, self.dilation = hidden, stride, dilation
        self.padding: Padding = record.padding
        # Norms of batches need all pixels at once.
        self.in_bands = not record.backbone_norm

    def __call__(self, images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
        """Applies the unit."""
        batch, height, width, _ = images.shape
        before, after = pad_amounts(height, 3, self.stride, self.dilation, self.padding)
        rows = (height + before + after - 2 * self.dilation - 1) // self.stride + 1
        band = rows
        if self.in_bands:
            band = rows_per_band(rows, 4 * batch * self.stride * width * self.hidden, HIDDEN_BYTES)
        result = jnp.concatenate(
            [self._rows(images, first, min(first + band, rows), before) for first in range(0, rows, band)], axis=1
        )
        return images + result if self.shortcut else result

    def _rows(self, images: Array, first: int, last: int, before: int) -> Array:
        """Rows `first` to before `last` of what is added to the input, from the rows of it that they need."""
        top, bottom = first * self.stride - before, (last - 1) * self.stride - before + 2 * self.dilation + 1
        padding = (max(-top, 0), max(bottom - images.shape[1], 0))
        images = images[:, max(top, 0) : bottom]
        hidden = images if self.expand is None else self.expand(images)
        return self.project(self.depthwise(hidden, padding))


class MobileNetV2(nnx.Module):
    """The convolutional part of MobileNetV2 at width 1."""

    def __init__(self, record: Architecture) -> None:
        norm = "batch" if record.backbone_norm else "bias"
        self.stem = ConvBlock(
            3,
            32,
            3,
            stride=2,
            padding=record.padding,
            norm=norm,
            eps=record.backbone_eps,
            activation="relu6",
        )
        designs = [
            (expansion, channels, stride if unit == 0 else 1)
            for expansion, channels, count, stride in STAGES
            for unit in range(count)
        ]
        placed = dilations([stride for _, _, stride in designs], 2, record.output_stride, record.dilate_first)
        units, inputs = [], 32
        for (expansion, channels, _), (stride, dilation) in zip(designs, placed, strict=True):
            units.append(InvertedResidual(inputs, channels, expansion, stride, dilation, record))
            inputs = channels
        self.units = nnx.List(units)
        self.top = (
            ConvBlock(inputs, TOP_CHANNELS, norm=norm, eps=record.backbone_eps, activation="relu6")
            if record.top_conv
            else None
        )
        self.channels = TOP_CHANNELS if record.top_conv else inputs
        self.low_level_channels = designs[LOW_LEVEL_UNIT][1]

    def __call__(self, images: Float[Array, "B H W 3"]) -> tuple[Float[Array, "B h w F"], Float[Array, "B g v L"]]:
        """The features at the output stride, and the low-level feature at stride 4."""
        images = self.stem(images)
        low_level = images
        for index, unit in enumerate(self.units):
            images = unit(images)
            if index == LOW_LEVEL_UNIT:
                low_level = images
        return images if self.top is None else self.top(images), low_level
