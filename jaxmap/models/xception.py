"""Aligned Xception-65 as a feature extractor (Chollet 2017, modified as in Chen et al. 2018).

Max pooling is replaced by strided separable convolutions, and batch norm follows every depthwise one.
Strided convolutions pad both sides alike, as the original does by hand.
"""

from __future__ import annotations

from flax import nnx
from jaxtyping import Array, Float

from jaxmap.models.architecture import Architecture
from jaxmap.models.layers import ConvBlock, SeparableBlock, dilations

ENTRY = ((128, 128, 128), (256, 256, 256), (728, 728, 728))
MIDDLE = ((728, 728, 728),) * 16
EXIT = ((728, 1024, 1024), (1536, 1536, 2048))
LOW_LEVEL_UNIT = 1
"""The unit that holds the low-level feature: what its second separable convolution gives, at stride 4."""


class XceptionUnit(nnx.Module):
    """Three separable convolutions beside a shortcut: a strided 1x1 convolution, the input itself, or none.

    ReLU comes before each convolution, except in the last unit, which has it inside, after each norm.
    """

    def __init__(
        self,
        inputs: int,
        depths: tuple[int, ...],
        stride: int,
        dilation: int,
        record: Architecture,
        *,
        shortcut: str,
    ) -> None:
        norm, eps = ("batch" if record.backbone_norm else "bias"), record.backbone_eps
        self.relu_before = shortcut != "none"
        activation = "none" if self.relu_before else "relu"
        blocks, before = [], inputs
        for index, depth in enumerate(depths):
            blocks.append(
                SeparableBlock(
                    before,
                    depth,
                    stride=stride if index == len(depths) - 1 else 1,
                    dilation=dilation,
                    padding=record.padding,
                    norm=norm,
                    norm_inside=True,
                    eps=eps,
                    activation=activation,
                    inner_activation=activation,
                )
            )
            before = depth
        self.convs = nnx.List(blocks)
        self.shortcut = (
            ConvBlock(inputs, depths[-1], stride=stride, norm=norm, eps=eps, activation="none")
            if shortcut == "conv"
            else None
        )
        self.add_input = shortcut == "sum"

    def __call__(self, images: Float[Array, "B H W I"]) -> tuple[Float[Array, "B h w O"], Float[Array, "B H W M"]]:
        """The unit's output, and what its second separable convolution gives."""
        result = inner = images
        for index, block in enumerate(self.convs):
            result = block(nnx.relu(result) if self.relu_before else result)
            if index == 1:
                inner = result
        if self.shortcut is not None:
            result = result + self.shortcut(images)
        return (result + images if self.add_input else result), inner


class Xception65(nnx.Module):
    """The convolutional part of aligned Xception-65."""

    def __init__(self, record: Architecture) -> None:
        norm, eps = ("batch" if record.backbone_norm else "bias"), record.backbone_eps
        self.stem = nnx.List(
            [
                ConvBlock(3, 32, 3, stride=2, padding=record.padding, norm=norm, eps=eps),
                ConvBlock(32, 64, 3, padding=record.padding, norm=norm, eps=eps),
            ]
        )
        designs = [
            *((depths, 2, "conv") for depths in ENTRY),
            *((depths, 1, "sum") for depths in MIDDLE),
            (EXIT[0], 2, "conv"),
            (EXIT[1], 1, "none"),
        ]
        placed = dilations([stride for _, stride, _ in designs], 2, record.output_stride, record.dilate_first)
        units, inputs = [], 64
        for (depths, _, shortcut), (stride, dilation) in zip(designs, placed, strict=True):
            units.append(XceptionUnit(inputs, depths, stride, dilation, record, shortcut=shortcut))
            inputs = depths[-1]
        self.units = nnx.List(units)
        self.channels, self.low_level_channels = inputs, ENTRY[LOW_LEVEL_UNIT][1]

    def __call__(self, images: Float[Array, "B H W 3"]) -> tuple[Float[Array, "B h w F"], Float[Array, "B g v L"]]:
        """The features at the output stride, and the low-level feature at stride 4."""
        for block in self.stem:
            images = block(images)
        low_level = images
        for index, unit in enumerate(self.units):
            images, inner = unit(images)
            if index == LOW_LEVEL_UNIT:
                low_level = inner
        return images, low_level
