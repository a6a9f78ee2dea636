"""Networks without their classifiers, as feature extractors.

MobileNetV2, EfficientNet-Lite0, ResNet-18, 50 and 101, Xception-65, VGG-16.

Each gives the last features at every stride, down to the output stride (`Pyramid`). For SegNet, strides are replaced by
max pooling of 2 x 2 pixels; the weights are the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from flax import nnx
from jaxtyping import Array, Float

from jaxmap.models.architecture import Architecture
from jaxmap.models.convolutions import max_pool
from jaxmap.models.fused import apply_fused
from jaxmap.models.layers import ConvBlock, SeparableBlock, apply_by_bands
from jaxmap.models.unpooling import Places, pool_with_places
from jaxmap.native.build import has_kernel


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

VGG_STAGES = ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
"""Channels and convolutions of each stage (Simonyan and Zisserman 2015, table 1, D)."""


class Pyramid(NamedTuple):
    """What a backbone makes of images.

    Attributes:
        levels: the last features at each stride, from `Architecture.finest_stride` to the output stride.
        places: what each max pooling kept, in order; none where strides halve the images.
    """

    levels: tuple[Float[Array, "B h w F"], ...]
    places: tuple[Places, ...]


class _Halving:
    """Follows the features of one pass, whichever way a backbone halves them."""

    def __init__(self, record: Architecture) -> None:
        self.pools, self.finest = record.pools, record.finest_stride
        self.stride, self.levels, self.places = 1, [], []

    def before(self, images: Array) -> None:
        """What is about to be halved."""
        if self.stride >= self.finest:
            self.levels.append(images)

    def after(self, images: Array) -> Array:
        """What a halving layer made; without a stride, it is pooled here."""
        self.stride *= 2
        if self.pools:
            images, places = pool_with_places(images)
            self.places.append(places)
        return images

    def ending(self, images: Array) -> Pyramid:
        """All levels, with the features at the output stride."""
        return Pyramid((*self.levels, images), tuple(self.places))


def _step(record: Architecture) -> int:
    """The stride of a layer that halves its input."""
    return 1 if record.pools else 2


def _from_finest(channels: list[int], record: Architecture) -> tuple[int, ...]:
    """The channels of the levels, of those at stride 2, 4 and so on."""
    return tuple(channels[record.finest_stride.bit_length() - 2 :])


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
        return apply_fused(self, images)

    def plain(self, images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
        """The same without the compiled kernel."""
        if self.is_large(images.shape):
            result = apply_by_bands(self.blocks, images)
        else:
            result = images
            for block in self.blocks:
                result = block.plain(result)
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
        common, self.record = _conventions(record), record
        self.stem = ConvBlock(3, 32, 3, stride=_step(record), activation="relu6", **common)
        designs = [
            (stage, stage.stride if unit == 0 else 1)
            for stage in INVERTED_RESIDUAL_STAGES[record.backbone]
            for unit in range(stage.units)
        ]
        placed = dilations([stride for _, stride in designs], 2, record)
        units, inputs, levels, pooled = [], 32, [], [32]
        for (stage, _), (stride, dilation) in zip(designs, placed, strict=True):
            step = stride
            if stride == 2:
                levels.append(inputs)
                pooled.append(stage.channels)
                step = _step(record)
            units.append(InvertedResidual(inputs, stage.channels, stage.expansion, step, dilation, record, stage.size))
            inputs = stage.channels
        self.units, self.halving = nnx.List(units), tuple(stride == 2 for stride, _ in placed)
        self.top = ConvBlock(inputs, TOP_CHANNELS, activation="relu6", **common) if record.top_conv else None
        self.channels = _from_finest([*levels, TOP_CHANNELS if record.top_conv else inputs], record)
        self.pooled = tuple(pooled)

    def __call__(self, images: Float[Array, "B H W 3"]) -> Pyramid:
        """The features at every stride."""
        first, second = self.units[0], self.units[1]
        done, follow = 0, _Halving(self.record)
        size = [self.stem.axis(length).outputs for length in images.shape[1:3]]
        large = second.is_large((images.shape[0], *size, 0)) and not has_kernel()
        if follow.finest > 2 and not follow.pools and large:
            images = apply_by_bands([self.stem, *first.blocks, *second.blocks], images)
            done, follow.stride = 2, 4
        else:
            images = follow.after(self.stem(images))
        for unit, halves in list(zip(self.units, self.halving, strict=True))[done:]:
            if halves:
                follow.before(images)
            images = unit(images)
            if halves:
                images = follow.after(images)
        return follow.ending(images if self.top is None else self.top(images))


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
        self.record = record
        self.stem = ConvBlock(3, RESNET_WIDTHS[0], 7, stride=_step(record), **_conventions(record))
        bottleneck = record.backbone != "resnet18"
        counts = RESNET_UNITS[record.backbone]
        strides = [2 if unit == 0 and stage > 0 else 1 for stage, count in enumerate(counts) for unit in range(count)]
        placed = iter(dilations(strides, 4, record))
        stages, inputs, halving = [], RESNET_WIDTHS[0], []
        levels, pooled = [inputs], [inputs, inputs]
        for width, count in zip(RESNET_WIDTHS, counts, strict=True):
            steps = [next(placed) for _ in range(count)]
            outputs = width * BOTTLENECK_GROWTH if bottleneck else width
            halving.append(steps[0][0] == 2)
            if halving[-1]:
                levels.append(inputs)
                pooled.append(outputs)
            units = []
            for stride, dilation in steps:
                # The second convolution of a basic unit comes after the stride.
                both, step = (dilation, steps[-1][1]), _step(record) if stride == 2 else 1
                units.append(ResidualUnit(inputs, width, step, both, record, bottleneck=bottleneck))
                inputs = outputs
            stages.append(nnx.List(units))
        self.stages, self.halving = nnx.List(stages), tuple(halving)
        self.channels, self.pooled = _from_finest([*levels, inputs], record), tuple(pooled)

    def __call__(self, images: Float[Array, "B H W 3"]) -> Pyramid:
        """The features at every stride."""
        follow = _Halving(self.record)
        images = follow.after(self.stem(images))
        follow.before(images)
        images = follow.after(images if follow.pools else max_pool(images, padding=self.record.padding))
        for stage, halves in zip(self.stages, self.halving, strict=True):
            if halves:
                follow.before(images)
            for index, unit in enumerate(stage):
                images = unit(images)
                if halves and index == 0:
                    images = follow.after(images)
        return follow.ending(images)


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
        common, self.record = _conventions(record), record
        self.stem = nnx.List([ConvBlock(3, 32, 3, stride=_step(record), **common), ConvBlock(32, 64, 3, **common)])
        designs = [
            *((depths, 2, "conv") for depths in XCEPTION_ENTRY),
            *((depths, 1, "sum") for depths in XCEPTION_MIDDLE),
            (XCEPTION_EXIT[0], 2, "conv"),
            (XCEPTION_EXIT[1], 1, "none"),
        ]
        placed = dilations([stride for _, stride, _ in designs], 2, record)
        units, inputs, levels, pooled = [], 64, [], [32]
        for (depths, _, shortcut), (stride, dilation) in zip(designs, placed, strict=True):
            step = stride
            if stride == 2:
                levels.append(depths[1])
                pooled.append(depths[-1])
                step = _step(record)
            units.append(XceptionUnit(inputs, depths, step, dilation, record, shortcut=shortcut))
            inputs = depths[-1]
        self.units, self.halving = nnx.List(units), tuple(stride == 2 for stride, _ in placed)
        self.channels, self.pooled = _from_finest([*levels, inputs], record), tuple(pooled)

    def __call__(self, images: Float[Array, "B H W 3"]) -> Pyramid:
        """The features at every stride: the last of one are what a strided unit's second convolution gives."""
        follow = _Halving(self.record)
        images = self.stem[1](follow.after(self.stem[0](images)))
        for unit, halves in zip(self.units, self.halving, strict=True):
            images, inner = unit(images)
            if halves:
                follow.before(inner)
                images = follow.after(images)
        return follow.ending(images)


class Vgg16(nnx.Module):
    """The convolutions of VGG-16 (Simonyan and Zisserman 2015) with batch norm, as in the papers on SegNet and FCN.

    Each stage ends in max pooling of 2 x 2 pixels; where the output stride forbids it, later stages are dilated.
    """

    def __init__(self, record: Architecture) -> None:
        common, self.record = _conventions(record), record
        stages, halving, inputs, stride, rate = [], [], 3, 1, 1
        for channels, count in VGG_STAGES:
            stages.append(
                nnx.List(
                    ConvBlock(channels if index else inputs, channels, 3, dilation=rate, **common)
                    for index in range(count)
                )
            )
            halving.append(2 * stride <= record.output_stride)
            stride, rate, inputs = (2 * stride, rate, channels) if halving[-1] else (stride, 2 * rate, channels)
        self.stages, self.halving = nnx.List(stages), tuple(halving)
        self.pooled = tuple(channels for (channels, _), halves in zip(VGG_STAGES, halving, strict=True) if halves)
        # What is first pooled has stride 1.
        self.channels = _from_finest([*self.pooled[1:], inputs], record)

    def __call__(self, images: Float[Array, "B H W 3"]) -> Pyramid:
        """The features at every stride."""
        follow = _Halving(self.record)
        for stage, halves in zip(self.stages, self.halving, strict=True):
            for block in stage:
                images = block(images)
            if halves:
                follow.before(images)
                images = follow.after(images if follow.pools else max_pool(images, size=2))
        return follow.ending(images)


BUILDERS: dict[str, Callable[[Architecture], InvertedResidualNet | ResNet | Xception65 | Vgg16]] = {
    **dict.fromkeys(INVERTED_RESIDUAL_STAGES, InvertedResidualNet),
    **dict.fromkeys(RESNET_UNITS, ResNet),
    "xception65": Xception65,
    "vgg16": Vgg16,
}
"""What builds each backbone. It has `channels`, of its levels, and `pooled`, those of each max pooling."""
