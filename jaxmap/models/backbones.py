"""Networks without their classifiers, as feature extractors.

MobileNetV2, EfficientNet-Lite0, ResNet-18, 50 and 101, Xception-65.

Each gives its features at the output stride and, for the decoder, a low-level feature at stride 4.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
from flax import nnx
from jaxtyping import Array, Float

from jaxmap.models.architecture import Architecture, Padding
from jaxmap.models.convolutions import max_pool
from jaxmap.models.layers import ConvBlock, SeparableBlock, apply_by_bands


class Stage(NamedTuple):
    """Inverted residuals in a row: expansion, channels, units, stride of the first, size of the depthwise kernel."""

    expansion: int
    channels: int
    units: int
    stride: int
    size: int = 3


INVERTED_RESIDUAL_STAGES = {
    # Sandler et al. 2018, table 2.
    "mobilenet_v2": (
        Stage(1, 16, 1, 1),
        Stage(6, 24, 2, 2),
        Stage(6, 32, 3, 2),
        Stage(6, 64, 4, 2),
        Stage(6, 96, 3, 1),
        Stage(6, 160, 3, 2),
        Stage(6, 320, 1, 1),
    ),
    # EfficientNet-B0 (Tan & Le 2019, table 1).
    "efficientnet_lite0": (
        Stage(1, 16, 1, 1),
        Stage(6, 24, 2, 2),
        Stage(6, 40, 2, 2, 5),
        Stage(6, 80, 3, 2),
        Stage(6, 112, 3, 1, 5),
        Stage(6, 192, 4, 2, 5),
        Stage(6, 320, 1, 1),
    ),
}

LOW_LEVEL_UNIT = 2
"""The inverted residual whose output is the low-level feature: the last at stride 4, 24 channels."""

TOP_CHANNELS = 1280

HIDDEN_BYTES = 1 << 23
"""Expanded images larger than this are made a few rows at a time: fresh memory costs more than rows made twice."""

RESNET_UNITS = {"resnet18": (2, 2, 2, 2), "resnet50": (3, 4, 6, 3), "resnet101": (3, 4, 23, 3)}
"""Units of each stage (He et al. 2015, table 1)."""

RESNET_WIDTHS = (64, 128, 256, 512)
BOTTLENECK_GROWTH = 4

XCEPTION_ENTRY = ((128, 128, 128), (256, 256, 256), (728, 728, 728))
XCEPTION_MIDDLE = ((728, 728, 728),) * 16
XCEPTION_EXIT = ((728, 1024, 1024), (1536, 1536, 2048))
XCEPTION_LOW_LEVEL_UNIT = 1
"""The unit that holds the low-level feature: what its second separable convolution gives, at stride 4."""

Features = tuple[Float[Array, "B h w F"], Float[Array, "B g v L"]]


def _conventions(record: Architecture) -> dict[str, Any]:
    """What all convolutions of a backbone have in common."""
    return {
        "padding": record.padding,
        "norm": "batch" if record.backbone_norm else "bias",
        "eps": record.backbone_eps,
    }


def dilations(strides: list[int], start: int, record: Architecture) -> list[tuple[int, int]]:
    """Stride and dilation of units in a row, such that the features end at the output stride.

    Strides beyond it become dilation: of that unit already where `dilate_first`, else from the next
    one on (which leaves the field of view of the unit itself as it was trained).

    Args:
        strides: of the units, as designed.
        start: input pixels for each pixel that enters the first unit.
        record: gives `output_stride` and `dilate_first`.
    """
    result, reached, rate = [], start, 1
    for stride in strides:
        if reached * stride <= record.output_stride:
            reached *= stride
            result.append((stride, rate))
        else:
            result.append((1, rate * stride if record.dilate_first else rate))
            rate *= stride
    return result


class InvertedResidual(nnx.Module):
    """1x1 expansion, depthwise, 1x1 projection without activation, added to the input where both fit."""

    def __init__(
        self, inputs: int, outputs: int, expansion: int, stride: int, dilation: int, record: Architecture, size: int = 3
    ) -> None:
        hidden, common = inputs * expansion, _conventions(record)
        self.expand = ConvBlock(inputs, hidden, activation="relu6", **common) if expansion > 1 else None
        self.depthwise = ConvBlock(
            hidden, hidden, size, stride=stride, dilation=dilation, depthwise=True, activation="relu6", **common
        )
        self.project = ConvBlock(hidden, outputs, activation="none", **common)
        self.shortcut = stride == 1 and inputs == outputs
        self.folded = not record.backbone_norm

    def __call__(self, images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
        """Applies the unit."""
        if self.is_large(images.shape):
            result = apply_by_bands(self.blocks, images)
        else:
            result = images
            for block in self.blocks:
                result = block(result)
        return images + result if self.shortcut else result

    @property
    def blocks(self) -> list[ConvBlock]:
        """Its convolutions in their order."""
        return [block for block in (self.expand, self.depthwise, self.project) if block is not None]

    def is_large(self, shape: tuple[int, ...]) -> bool:
        """Whether its hidden image is too large for the cache, and rows of it may be made at a time.

        Batch norms that learn need all pixels at once.
        """
        batch, height, width, _ = shape
        hidden_bytes = batch * height * width * self.depthwise.kernel.shape[3] * 4
        return self.folded and hidden_bytes > HIDDEN_BYTES and jax.default_backend() == "cpu"


class InvertedResidualNet(nnx.Module):
    """A chain of inverted residuals.

    MobileNetV2 at width 1 (Sandler et al. 2018, "Inverted Residuals and Linear Bottlenecks"), or EfficientNet-Lite0:
    EfficientNet-B0 (Tan & Le 2019) without squeeze-and-excitation, and with ReLU6 in the place of swish.
    """

    def __init__(self, record: Architecture) -> None:
        common = _conventions(record)
        self.stem = ConvBlock(3, 32, 3, stride=2, activation="relu6", **common)
        designs = [
            (stage, stage.stride if unit == 0 else 1)
            for stage in INVERTED_RESIDUAL_STAGES[record.backbone]
            for unit in range(stage.units)
        ]
        placed = dilations([stride for _, stride in designs], 2, record)
        units, inputs = [], 32
        for (stage, _), (stride, dilation) in zip(designs, placed, strict=True):
            units.append(
                InvertedResidual(inputs, stage.channels, stage.expansion, stride, dilation, record, stage.size)
            )
            inputs = stage.channels
        self.units = nnx.List(units)
        self.top = ConvBlock(inputs, TOP_CHANNELS, activation="relu6", **common) if record.top_conv else None
        self.channels = TOP_CHANNELS if record.top_conv else inputs
        self.low_level_channels = designs[LOW_LEVEL_UNIT][0].channels

    def __call__(self, images: Float[Array, "B H W 3"]) -> Features:
        """The features, and the low-level feature."""
        first, second, *others = self.units
        size = [self.stem.axis(length).outputs for length in images.shape[1:3]]
        if second.is_large((images.shape[0], *size, 0)):
            images = apply_by_bands([self.stem, *first.blocks, *second.blocks], images)
        else:
            images = second(first(self.stem(images)))
        low_level = images
        for index, unit in enumerate(others, start=2):
            images = unit(images)
            if index == LOW_LEVEL_UNIT:
                low_level = images
        return images if self.top is None else self.top(images), low_level


class ResidualUnit(nnx.Module):
    """Convolutions added to the input, then ReLU: two 3x3, or 1x1, 3x3, 1x1 where `bottleneck`.

    The stride is in the (first) 3x3 convolution; `dilation` is that of the 3x3 convolutions in their order.
    """

    def __init__(
        self,
        inputs: int,
        width: int,
        stride: int,
        dilation: tuple[int, int],
        record: Architecture,
        *,
        bottleneck: bool,
    ) -> None:
        outputs, common = width * BOTTLENECK_GROWTH if bottleneck else width, _conventions(record)
        first, second = dilation
        self.convs = nnx.List(
            [
                ConvBlock(inputs, width, **common),
                ConvBlock(width, width, 3, stride=stride, dilation=first, **common),
                ConvBlock(width, outputs, activation="none", **common),
            ]
            if bottleneck
            else [
                ConvBlock(inputs, width, 3, stride=stride, dilation=first, **common),
                ConvBlock(width, outputs, 3, dilation=second, activation="none", **common),
            ]
        )
        fits = stride == 1 and inputs == outputs
        self.shortcut = None if fits else ConvBlock(inputs, outputs, stride=stride, activation="none", **common)

    def __call__(self, images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
        """Applies the unit."""
        result = images
        for block in self.convs:
            result = block(result)
        return nnx.relu(result + (images if self.shortcut is None else self.shortcut(images)))


class ResNet(nnx.Module):
    """ResNet-18, 50 or 101 (He et al. 2015, "Deep Residual Learning for Image Recognition")."""

    def __init__(self, record: Architecture) -> None:
        self.stem = ConvBlock(3, RESNET_WIDTHS[0], 7, stride=2, **_conventions(record))
        bottleneck = record.backbone != "resnet18"
        counts = RESNET_UNITS[record.backbone]
        strides = [2 if unit == 0 and stage > 0 else 1 for stage, count in enumerate(counts) for unit in range(count)]
        placed = iter(dilations(strides, 4, record))
        stages, inputs, outputs = [], RESNET_WIDTHS[0], []
        for width, count in zip(RESNET_WIDTHS, counts, strict=True):
            steps = [next(placed) for _ in range(count)]
            units = []
            for stride, dilation in steps:
                # The second convolution of a basic unit comes after the stride.
                both = (dilation, steps[-1][1])
                units.append(ResidualUnit(inputs, width, stride, both, record, bottleneck=bottleneck))
                inputs = width * BOTTLENECK_GROWTH if bottleneck else width
            stages.append(nnx.List(units))
            outputs.append(inputs)
        self.stages = nnx.List(stages)
        self.padding: Padding = record.padding
        self.channels, self.low_level_channels = outputs[-1], outputs[0]

    def __call__(self, images: Float[Array, "B H W 3"]) -> Features:
        """The features, and the low-level feature (of the first stage)."""
        images = max_pool(self.stem(images), padding=self.padding)
        low_level = images
        for index, stage in enumerate(self.stages):
            for unit in stage:
                images = unit(images)
            if index == 0:
                low_level = images
        return images, low_level


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
        common = _conventions(record)
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
                    norm_inside=True,
                    activation=activation,
                    inner_activation=activation,
                    **common,
                )
            )
            before = depth
        self.convs = nnx.List(blocks)
        strided = shortcut == "conv"
        self.shortcut = ConvBlock(inputs, depths[-1], stride=stride, activation="none", **common) if strided else None
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
    """Aligned Xception-65 (Chollet 2017, modified as in Chen et al. 2018).

    Max pooling is replaced by strided separable convolutions, and batch norm follows every depthwise one.
    Strided convolutions pad both sides alike, as the original does by hand.
    """

    def __init__(self, record: Architecture) -> None:
        common = _conventions(record)
        self.stem = nnx.List([ConvBlock(3, 32, 3, stride=2, **common), ConvBlock(32, 64, 3, **common)])
        designs = [
            *((depths, 2, "conv") for depths in XCEPTION_ENTRY),
            *((depths, 1, "sum") for depths in XCEPTION_MIDDLE),
            (XCEPTION_EXIT[0], 2, "conv"),
            (XCEPTION_EXIT[1], 1, "none"),
        ]
        placed = dilations([stride for _, stride, _ in designs], 2, record)
        units, inputs = [], 64
        for (depths, _, shortcut), (stride, dilation) in zip(designs, placed, strict=True):
            units.append(XceptionUnit(inputs, depths, stride, dilation, record, shortcut=shortcut))
            inputs = depths[-1]
        self.units = nnx.List(units)
        self.channels, self.low_level_channels = inputs, XCEPTION_ENTRY[XCEPTION_LOW_LEVEL_UNIT][1]

    def __call__(self, images: Float[Array, "B H W 3"]) -> Features:
        """The features, and the low-level feature."""
        for block in self.stem:
            images = block(images)
        low_level = images
        for index, unit in enumerate(self.units):
            images, inner = unit(images)
            if index == XCEPTION_LOW_LEVEL_UNIT:
                low_level = inner
        return images, low_level
