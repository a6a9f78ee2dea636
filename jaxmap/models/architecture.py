"""Everything about a network but its weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal, get_args

from annotated_types import Interval, Len
from pydantic import AfterValidator, ConfigDict, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from jaxmap.errors import JaxmapError

Kind = Literal["deeplab", "fcn", "segnet", "unet"]
Backbone = Literal["mobilenet_v2", "efficientnet_lite0", "resnet18", "resnet50", "resnet101", "xception65", "vgg16"]
Padding = Literal["torch", "same"]
Norm = Literal["batch", "bias", "none"]
Activation = Literal["relu", "relu6", "none"]

BACKBONES: tuple[str, ...] = get_args(Backbone)

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
LITE_MEAN = (127 / 255,) * 3
LITE_STD = (128 / 255,) * 3
"""The weights of EfficientNet-Lite0 were trained on (x - 127) / 128."""
MAX_CLASSES = 255
"""Label images are 8-bit and keep 255 for "no class"."""


def _check_classes(names: tuple[str, ...]) -> tuple[str, ...]:
    readable = all(name.strip() and name.isprintable() for name in names)
    if not 1 <= len(names) <= MAX_CLASSES or len(set(names)) != len(names) or not readable:
        raise ValueError(f"must be 1 to {MAX_CLASSES} different printable names")
    return names


Epsilon = Annotated[float, Interval(gt=0, lt=1)]
Channels = Annotated[int, Interval(ge=1, le=4096)]
Rate = Annotated[int, Interval(ge=1, le=1024)]
Deviation = Annotated[float, Interval(gt=0)]


@dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class Architecture:
    """A segmentation network, apart from its weights; stored in every model file.

    Families of conventions exist. The fields' defaults are those of segmentation_models_pytorch 0.6.0
    (`DeepLabV3Plus`; `torch_architecture` gives its `Unet`, too); `tf_architecture` gives those of the original
    TensorFlow networks (Chen et al. 2018, "Encoder-Decoder with Atrous Separable Convolution"),
    `torchvision_architecture` those of torchvision's DeepLabv3 (Chen et al. 2017, "Rethinking Atrous Convolution")
    and FCN.

    Attributes:
        backbone: the network that computes the features.
        classes: names of the classes, in the order of the logits.
        kind: what makes logits of the features: `models/deeplab.py`, `fcn.py`, `segnet.py` or `unet.py`.
        output_stride: input pixels for each of the coarsest features: 16 or 8 of DeepLab, 32 of the others; an FCN
            without a decoder has any of these.
        decoder: whether finer features join before the logits (DeepLabv3+, FCN-8s) or not (DeepLabv3, torchvision's
            FCN); U-Net and SegNet always have one.
        padding: zero padding of strided convolutions: `torch` pads both sides alike; `same` is
            TensorFlow's, which pads (0, 1) for a stride of 2 on even sizes.
        size_remainder: images are padded to a multiple of the output stride plus this. With `same`
            padding and aligned corners, 1 makes the features fall on every stride-th pixel.
        dilate_first: whether the unit whose stride is taken away is dilated too (torch), or only
            the units after it (TensorFlow).
        backbone_norm: whether batch norm follows the backbone's convolutions; a bias where not.
        head_norm: the same of all other convolutions but the classifier.
        backbone_eps: epsilon of the backbone's batch norm.
        head_eps: epsilon of the head's.
        top_conv: whether MobileNetV2 or EfficientNet-Lite0 keeps its last 1x1 convolution (to 1280 channels).
        head_channels: channels of ASPP and decoder, or of FCN's convolution; those of U-Net's first step, which each
            further one halves. SegNet's follow from its backbone.
        atrous_rates: dilations of the ASPP branches beside the 1x1 one; none at all is allowed.
        separable_aspp: whether those branches, and the convolution after the ASPP, are depthwise separable.
        pool_first: whether the pooled branch is concatenated first (TensorFlow) or last.
        norm_inside: whether batch norm and ReLU stand between depthwise and pointwise convolutions.
        aspp_conv: whether a 3x3 convolution follows the ASPP.
        low_level_channels: channels the low-level feature is reduced to.
        decoder_convs: separable convolutions of the decoder.
        relief_channels: channels of relief that the decoder sees beside the low-level feature; 0 for images alone.
        align_corners: whether bilinear resizing maps corner pixels onto corner pixels.
        dropout: share of the features of the ASPP, or of FCN's convolution, dropped while training.
        mean: input mean of R, G, B, on a scale of 0 to 1.
        std: input standard deviation, same scale.

    Raises:
        JaxmapError: no such network can be built; all faults are reported together.
    """

    backbone: Backbone
    classes: Annotated[tuple[str, ...], AfterValidator(_check_classes)]
    output_stride: Literal[32, 16, 8] = 16
    decoder: bool = True
    padding: Padding = "torch"
    size_remainder: Literal[0, 1] = 0
    dilate_first: bool = True
    backbone_norm: bool = True
    head_norm: bool = True
    backbone_eps: Epsilon = 1e-5
    head_eps: Epsilon = 1e-5
    top_conv: bool = True
    head_channels: Channels = 256
    atrous_rates: Annotated[tuple[Rate, ...], Len(0, 16)] = (12, 24, 36)
    separable_aspp: bool = True
    pool_first: bool = False
    norm_inside: bool = False
    aspp_conv: bool = True
    low_level_channels: Channels = 48
    decoder_convs: Annotated[int, Interval(ge=1, le=16)] = 1
    relief_channels: Annotated[int, Interval(ge=0, le=64)] = 0
    align_corners: bool = True
    dropout: Annotated[float, Interval(ge=0, lt=1)] = 0.5
    mean: tuple[float, float, float] = IMAGENET_MEAN
    std: tuple[Deviation, Deviation, Deviation] = IMAGENET_STD
    kind: Kind = "deeplab"

    @model_validator(mode="wrap")
    @classmethod
    def _check(cls, values: Any, handler: Callable[[Any], Architecture]) -> Architecture:
        try:
            record = handler(values)
        except ValidationError as error:
            clauses: dict[object, str] = {}
            for fault in error.errors():
                field, value = ".".join(map(str, fault["loc"])), repr(fault["input"])
                reason = fault["msg"].removeprefix("Value error, ")
                clauses.setdefault(fault["loc"][0], f"{field} is {value[:60]}: {reason[0].lower()}{reason[1:]}")
            # A file may have any number of fields of any length.
            faults = "; ".join(clause[:180] for clause in list(clauses.values())[:6])
            raise JaxmapError(faults, where="architecture", fix="correct the architecture") from error
        where = "architecture"
        if record.relief_channels and record.name != "DeepLabv3+":
            fix = "set kind deeplab and decoder, or leave out the relief"
            raise JaxmapError("relief without a decoder of DeepLabv3+, which it joins", where=where, fix=fix)
        strides = (16, 8) if record.kind == "deeplab" else (32, 16, 8) if record.name == "FCN" else (32,)
        if record.output_stride not in strides:
            wanted = " or ".join(map(str, strides))
            raise JaxmapError(
                f"{record.name} at output stride {record.output_stride}", where=where, fix=f"take {wanted}"
            )
        if record.size_remainder and record.kind != "deeplab":
            raise JaxmapError(f"{record.name} on sizes with a remainder", where=where, fix="set size_remainder 0")
        return record

    @property
    def name(self) -> str:
        """What the network is called in the literature."""
        plain, decoding = {"deeplab": ("DeepLabv3", "DeepLabv3+"), "fcn": ("FCN", "FCN-8s")}.get(
            self.kind, ("U-Net" if self.kind == "unet" else "SegNet",) * 2
        )
        return decoding if self.decoder else plain

    @property
    def pools(self) -> bool:
        """Whether the backbone halves images by max pooling, whose places the decoder needs, not by strides."""
        return self.kind == "segnet"

    @property
    def finest_stride(self) -> int:
        """Input pixels for each of the finest features that the network looks at."""
        return 2 if self.kind == "unet" else 4


_LITE: dict[str, Any] = {
    "padding": "same",
    "dilate_first": False,
    "backbone_eps": 1e-3,
    "mean": LITE_MEAN,
    "std": LITE_STD,
}
"""What the weights of EfficientNet-Lite0 were trained with."""


_KINDS: dict[str, dict[str, Any]] = {
    "deeplab": {"output_stride": 16},
    "fcn": {"output_stride": 32, "dropout": 0.1},
    "segnet": {"output_stride": 32, "dropout": 0.0},
    "unet": {"output_stride": 32, "dropout": 0.0},
}


def torch_architecture(
    backbone: str, classes: Sequence[str], *, output_stride: int | None = None, kind: str = "deeplab"
) -> Architecture:
    """DeepLabv3+ or U-Net with the details of segmentation_models_pytorch; FCN-8s or SegNet with the same backbones.

    EfficientNet-Lite0 keeps the conventions of TensorFlow, where its published weights were trained.

    Raises:
        JaxmapError: an unknown kind or backbone, a stride that the kind has not, or invalid classes.
    """
    details = {**_KINDS.get(kind, {}), **(_LITE if backbone == "efficientnet_lite0" else {})}
    usual = details.pop("output_stride", 16)
    return _architecture(backbone, classes, output_stride or usual, kind=kind, **details)


def tf_architecture(
    backbone: str, classes: Sequence[str], *, output_stride: int = 16, decoder: bool = True
) -> Architecture:
    """DeepLabv3 or v3+ with the details of the original TensorFlow networks.

    On MobileNetV2 the original goes without atrous branches and without the last convolution; so does
    EfficientNet-Lite0 here. Only these two pad as TensorFlow does by itself; Xception and ResNet pad both sides alike.
    Backbones keep the layout of the weights that are published for them: ResNet is torchvision's (stride in
    a stage's first unit), and MobileNetV2's low-level feature is a unit's output (24 channels).

    Raises:
        JaxmapError: an unknown backbone or stride, or invalid classes.
    """
    mobile = backbone in ("mobilenet_v2", "efficientnet_lite0")
    details: dict[str, Any] = {
        "decoder": decoder,
        "padding": "same" if mobile else "torch",
        "size_remainder": 1,
        "dilate_first": False,
        "backbone_eps": 1e-5 if backbone.startswith("resnet") else 1e-3,
        "top_conv": False,
        "atrous_rates": () if mobile else (6, 12, 18) if output_stride == 16 else (12, 24, 36),
        "pool_first": True,
        "norm_inside": True,
        "aspp_conv": False,
        "decoder_convs": 2,
        "dropout": 0.1,
        "mean": (0.5, 0.5, 0.5),
        "std": (0.5, 0.5, 0.5),
    }
    if backbone == "efficientnet_lite0":
        details |= _LITE
    return _architecture(backbone, classes, output_stride, **details)


def torchvision_architecture(
    backbone: str, classes: Sequence[str], *, output_stride: int = 8, kind: Literal["deeplab", "fcn"] = "deeplab"
) -> Architecture:
    """DeepLabv3 or FCN with the details of torchvision's `deeplabv3_resnet50`, `fcn_resnet50` and so on.

    Published weights are for output stride 8. At 16 the rates of DeepLabv3 are halved, so that the branches see as
    far as before.

    Raises:
        JaxmapError: an unknown backbone or stride, or invalid classes.
    """
    details: dict[str, Any] = {"decoder": False, "dilate_first": False, "align_corners": False}
    if kind == "fcn":
        # A quarter of the features' channels.
        details |= {"kind": "fcn", "head_channels": 128 if backbone == "resnet18" else 512, "dropout": 0.1}
    else:
        details |= {"atrous_rates": (12, 24, 36) if output_stride == 8 else (6, 12, 18), "separable_aspp": False}
    return _architecture(backbone, classes, output_stride, **details)


def _architecture(backbone: str, classes: Sequence[str], output_stride: int, **details: Any) -> Architecture:
    # By name, as errors then name the fields.
    named: dict[str, Any] = {"backbone": backbone, "classes": tuple(classes), "output_stride": output_stride}
    return Architecture(**named, **details)


def folded(architecture: Architecture) -> Architecture:
    """The same network after its batch norms have been folded into the convolutions."""
    return replace(architecture, backbone_norm=False, head_norm=False)
