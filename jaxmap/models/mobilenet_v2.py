"""MobileNetV2 as a feature extractor (Sandler et al. 2018)."""

from __future__ import annotations

from flax import nnx
from jaxtyping import Array, Float

from jaxmap.models.architecture import Architecture
from jaxmap.models.layers import ConvBlock, dilations

STAGES = ((1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1), (6, 160, 3, 2), (6, 320, 1, 1))
"""Expansion, channels, units and first stride of each stage (the paper's table 2)."""

LOW_LEVEL_UNIT = 2
"""The unit whose output is the low-level feature: the last at stride 4, 24 channels."""

TOP_CHANNELS = 1280


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

    def __call__(self, images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
        """Applies the unit."""
        hidden = images if self.expand is None else self.expand(images)
        result = self.project(self.depthwise(hidden))
        return images + result if self.shortcut else result


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
