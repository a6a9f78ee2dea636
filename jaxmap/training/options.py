"""The options of training: what each stage reads, validated when it is made."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Literal

from annotated_types import Interval
from pydantic import BeforeValidator

from jaxmap.datasets.options import Bits
from jaxmap.errors import UsageError
from jaxmap.host.settings import NotNegative, Positive, Seed, count, options
from jaxmap.models.architecture import Backbone, Kind

Weight = Annotated[float, Positive]
WeightOrNone = Annotated[float, NotNegative]
Factor = Annotated[float, Interval(ge=1 / 64, le=64)]
Strength = Annotated[float, Interval(ge=0, le=255)]
Share = Annotated[float, Interval(ge=0, lt=1)]
Size = Annotated[int, Interval(ge=16, le=4096)]
MaskValue = Annotated[str, BeforeValidator(str)]
"""A value of a mask as text: YAML reads a number, JSON and the command line text."""


@options("data")
class DataOptions:
    """What the pixels of masks stand for, and which images validate."""

    remap: dict[MaskValue, str] | None = None
    """Class by value of the masks, such as 255 rock; "ignore" is no class, "not rock" any class but that one, and the
    value * every other."""
    palette: dict[str, str] | None = None
    """Colour of the masks by class, such as rock #ff0000; several of a class with blanks between."""
    image_bits: Bits | None = None
    """Bits that 16-bit images use: 8, 10, 12, 14 or 16; by default found in each image."""
    validation_share: Share = 0.2
    """Share of the images that validates where no val.txt or train.txt says."""


@options("augmentation")
class AugmentationOptions:
    """How training examples are made of images; photometric changes are off by default."""

    crop_px: tuple[Size, Size] = (384, 384)
    """Height and width of an example."""
    scale: tuple[Factor, Factor] = (0.75, 1.75)
    """Least and greatest factor that images are resized by."""
    class_share: Annotated[float, Interval(ge=0, le=1)] = 0.0
    """Share of the crops that are placed around a pixel of a class, each class of the image as often as the others."""
    mirror: bool = True
    """Mirror every second example."""
    copies: Annotated[int, count(10_000, least=0)] | None = None
    """Fixed examples made of each image, beside the image itself; by default every example is drawn anew."""
    brightness: Strength = 0.0
    """Brightness is multiplied by up to 1 + this, or divided by it."""
    contrast: Strength = 0.0
    """The same for the distance from the mean level."""
    saturation: Strength = 0.0
    """The same for the distance from grey."""
    gamma: Strength = 0.0
    """The same for the exponent of the tone curve."""
    hue_rad: Strength = 0.0
    """Greatest rotation of colours around the grey axis."""
    tint: Strength = 0.0
    """Each channel is multiplied by up to 1 + this, or divided by it."""
    grey: Annotated[float, Interval(ge=0, le=1)] = 0.0
    """Share of the examples that are turned to grey."""
    noise: Strength = 0.0
    """Standard deviation of added noise, on a scale of 0 to 255."""
    drop_relief: Annotated[float, Interval(ge=0, le=1)] = 0.0
    """Share of the examples whose relief is unknown everywhere, so that the image alone is learnt from, too."""
    drop_image: Annotated[float, Interval(ge=0, le=1)] = 0.0
    """Share of the examples with relief whose image is a flat colour, so that the relief alone is learnt from, too."""
    disturb_relief: Annotated[float, Interval(ge=0, le=1)] = 0.0
    """Greatest strength of offsets, tilts, noise and holes in the relief."""

    def __post_init__(self) -> None:
        low, high = self.scale
        if low > high:
            raise UsageError(f"augmentation.scale is {low} {high}", fix="give the least factor first")
        if self.drop_relief + self.drop_image > 1:
            raise UsageError(
                "drop_relief and drop_image are more than all examples", where="augmentation", fix="take smaller shares"
            )


@options("loss")
class PixelLossOptions:
    """Loss terms of labelled pixels and their weights."""

    cross_entropy: WeightOrNone = 1.0
    """Weight of the cross-entropy."""
    soft_iou: WeightOrNone = 0.0
    """Weight of one minus the soft intersection over union, mean over classes."""
    lovasz: WeightOrNone = 0.0
    """Weight of the Lovasz-Softmax loss."""
    class_weights: Literal["equal", "balanced"] | tuple[Weight, ...] = "equal"
    """Weight of each class in the cross-entropy; balanced: by one over the square root of its share of pixels."""
    label_smoothing: Share = 0.0
    """Share of each target distribution that is spread over all classes."""

    def __post_init__(self) -> None:
        if not (self.cross_entropy or self.soft_iou or self.lovasz):
            raise UsageError("every loss has a weight of 0", where="loss", fix="give one of them a weight")


@options("optimiser")
class OptimiserOptions:
    """The optimiser and its schedule."""

    kind: Literal["adamw", "sgd"] = "adamw"
    """AdamW, or stochastic gradient descent with momentum."""
    learning_rate: Weight = 1e-3
    """At the start of the poly schedule."""
    power: WeightOrNone = 0.9
    """Exponent of the poly schedule: rate * (1 - step / steps) ** power."""
    warmup_steps: Annotated[int, count(1_000_000, least=0)] = 50
    """Steps over which the rate rises from 0."""
    weight_decay: WeightOrNone = 1e-4
    """Of kernels; norms and biases are spared."""
    momentum: Share = 0.9
    """Of stochastic gradient descent."""
    clip_norm: Weight | None = 5.0
    """Gradients are clipped to this global norm."""
    backbone_rate: Annotated[float, Interval(ge=0, le=10)] = 1.0
    """Factor on the learning rate of the backbone; 0 freezes it."""
    frozen_units: Annotated[int, Interval(ge=0, le=1000)] = 0
    """First units of the backbone that are not trained, with its stem; the way back ends there, which saves time."""
    average: Share = 0.0
    """Decay of an exponential moving average of the weights, which is validated and saved in their place; 0: none."""


@options("norm")
class BatchNormOptions:
    """Which batch norms train; the frozen ones keep their statistics."""

    backbone: Literal["auto", "batch", "frozen"] = "auto"
    """Of the backbone; auto: frozen where it was trained before."""
    head: Literal["auto", "batch", "frozen"] = "auto"
    """Of all else (ASPP, decoder); auto: frozen where they were trained before."""


@options()
class TrainingOptions:
    """The training recipe: everything but data and network."""

    epochs: Annotated[int, count(1_000_000)] = 60
    """How often every example is seen."""
    batch_size: Annotated[int, count(4096)] = 8
    """Examples in a step."""
    validate_every: Annotated[int, count(1_000_000)] = 5
    """Epochs between two validations; the last epoch is always validated."""
    keep: Literal["best", "last"] = "best"
    """The weights written: those with the best mean IoU in validation, or the last ones."""
    seed: Annotated[int, Seed] = 0
    """Seed of all randomness."""
    augmentation: AugmentationOptions = field(default_factory=AugmentationOptions)
    loss: PixelLossOptions = field(default_factory=PixelLossOptions)
    optimiser: OptimiserOptions = field(default_factory=OptimiserOptions)
    norm: BatchNormOptions = field(default_factory=BatchNormOptions)


@options("network")
class NetworkOptions:
    """The network; what is not set is as in the file that training starts from, or the default of the family."""

    kind: Kind | None = None
    """What labels by the features: DeepLab, FCN, SegNet or U-Net; deeplab unless --init says otherwise."""
    backbone: Backbone | None = None
    """What computes the features; mobilenet_v2 unless --init says otherwise."""
    family: Literal["torch", "tf"] | None = None
    """Details of DeepLab's head: those of torch implementations, or of the original in TensorFlow."""
    output_stride: Literal[32, 16, 8] | None = None
    """Input pixels for each of the coarsest features: 16 or 8 of DeepLab, 32 of the others."""
    head_channels: Annotated[int, Interval(ge=1, le=4096)] | None = None
    """Channels of ASPP and decoder, or of FCN's convolution; those of U-Net's first step, halved at each
    further one."""
    atrous_rates: tuple[Annotated[int, Interval(ge=1, le=1024)], ...] | None = None
    """Dilations of the ASPP branches."""
    decoder: bool | None = None
    """Whether finer features join before the logits: DeepLabv3+ and FCN-8s, or DeepLabv3 and plain FCN."""
    decoder_convs: Annotated[int, Interval(ge=1, le=8)] | None = None
    """Separable convolutions of the decoder."""
    low_level_channels: Annotated[int, Interval(ge=1, le=4096)] | None = None
    """Channels the low-level feature is reduced to."""
    relief: bool | None = None
    """Whether the decoder also sees the relief of the ground, from disparity/NAME.png and cameras/NAME.json."""
    top_conv: bool | None = None
    """Whether MobileNetV2 or EfficientNet-Lite0 keeps its last convolution, to 1280 channels."""
    dropout: Share | None = None
    """Share of the features before the logits dropped while training."""
