"""ResNet-18, 50 and 101 as feature extractors (He et al. 2015), the stride in the 3x3 convolution."""

from __future__ import annotations

from flax import nnx
from jaxtyping import Array, Float

from jaxmap.models.architecture import Activation, Architecture, Padding
from jaxmap.models.convolutions import max_pool
from jaxmap.models.layers import ConvBlock, dilations

UNITS = {"resnet18": (2, 2, 2, 2), "resnet50": (3, 4, 6, 3), "resnet101": (3, 4, 23, 3)}
"""Units of each stage."""

WIDTHS = (64, 128, 256, 512)
BOTTLENECK_GROWTH = 4


class ResidualUnit(nnx.Module):
    """Convolutions added to the input, then ReLU: two 3x3, or 1x1, 3x3, 1x1 where `bottleneck`."""

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
        def block(before: int, after: int, size: int, stride: int, dilation: int, activation: Activation) -> ConvBlock:
            return ConvBlock(
                before,
                after,
                size,
                stride=stride,
                dilation=dilation,
                padding=record.padding,
                norm="batch" if record.backbone_norm else "bias",
                eps=record.backbone_eps,
                activation=activation,
            )

        outputs = width * BOTTLENECK_GROWTH if bottleneck else width
        first, second = dilation
        self.convs = nnx.List(
            [
                block(inputs, width, 1, 1, 1, "relu"),
                block(width, width, 3, stride, first, "relu"),
                block(width, outputs, 1, 1, 1, "none"),
            ]
            if bottleneck
            else [block(inputs, width, 3, stride, first, "relu"), block(width, outputs, 3, 1, second, "none")]
        )
        fits = stride == 1 and inputs == outputs
        self.shortcut = None if fits else block(inputs, outputs, 1, stride, 1, "none")

    def __call__(self, images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
        """Applies the unit."""
        result = images
        for block in self.convs:
            result = block(result)
        return nnx.relu(result + (images if self.shortcut is None else self.shortcut(images)))


class ResNet(nnx.Module):
    """The convolutional part of a ResNet."""

    def __init__(self, record: Architecture) -> None:
        self.stem = ConvBlock(
            3,
            WIDTHS[0],
            7,
            stride=2,
            padding=record.padding,
            norm="batch" if record.backbone_norm else "bias",
            eps=record.backbone_eps,
        )
        bottleneck = record.backbone != "resnet18"
        counts = UNITS[record.backbone]
        strides = [2 if unit == 0 and stage > 0 else 1 for stage, count in enumerate(counts) for unit in range(count)]
        placed = iter(dilations(strides, 4, record.output_stride, record.dilate_first))
        stages, inputs, outputs = [], WIDTHS[0], []
        for width, count in zip(WIDTHS, counts, strict=True):
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

    def __call__(self, images: Float[Array, "B H W 3"]) -> tuple[Float[Array, "B h w F"], Float[Array, "B g v L"]]:
        """The features at the output stride, and the low-level feature at stride 4 (the first stage)."""
        images = max_pool(self.stem(images), padding=self.padding)
        low_level = images
        for index, stage in enumerate(self.stages):
            for unit in stage:
                images = unit(images)
            if index == 0:
                low_level = images
        return images, low_level
