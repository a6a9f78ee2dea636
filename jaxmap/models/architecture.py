"""The record that says everything about a network but its weights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

from jaxmap.errors import JaxmapError

Backbone = Literal["mobilenet_v2", "resnet18", "resnet50", "resnet101", "xception65"]
Padding = Literal["torch", "same"]
Norm = Literal["batch", "bias", "none"]
Activation = Literal["relu", "relu6", "none"]

BACKBONES: tuple[str, ...] = get_args(Backbone)

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
MAX_CLASSES = 255
"""Label images are 8-bit and keep 255 for "no class"."""


@dataclass(frozen=True)
class Architecture:
    """A DeepLab network, apart from its weights; stored in every model file.

    Families of detail exist. The fields' defaults are those of segmentation_models_pytorch 0.6.0
    (`DeepLabV3Plus`); `tf_architecture` gives those of the original TensorFlow networks (Chen et al.
    2018, "Encoder-Decoder with Atrous Separable Convolution"), `torchvision_architecture` those of
    torchvision's DeepLabv3 (Chen et al. 2017, "Rethinking Atrous Convolution").

    Attributes:
        backbone: what computes the features.
        classes: names of the classes, in the order of the logits.
        output_stride: input pixels for each feature of the ASPP, 16 or 8.
        decoder: whether a low-level feature joins before the logits (DeepLabv3+) or not (DeepLabv3).
        padding: zero padding of strided convolutions: `torch` pads both sides alike; `same` is
            TensorFlow's, which pads (0, 1) for a stride of 2 on even sizes.
        size_remainder: images are padded to a multiple of the output stride plus this. With `same`
            padding and aligned corners, 1 makes the features fall on every stride-th pixel.
        dilate_first: whether the unit whose stride is taken away is dilated too (torch), or only
            the units after it (TensorFlow).
        backbone_norm: whether batch norm follows the backbone's convolutions; a bias where not.
        head_norm: the same of ASPP and decoder.
        backbone_eps: epsilon of the backbone's batch norm.
        head_eps: epsilon of the head's.
        top_conv: whether MobileNetV2 keeps its last 1x1 convolution (to 1280 channels).
        head_channels: channels of ASPP and decoder.
        atrous_rates: dilations of the ASPP branches beside the 1x1 one; none at all is allowed.
        separable_aspp: whether those branches, and the convolution after the ASPP, are depthwise separable.
        pool_first: whether the pooled branch is concatenated first (TensorFlow) or last.
        norm_inside: whether batch norm and ReLU stand between depthwise and pointwise convolutions.
        aspp_conv: whether a 3x3 convolution follows the ASPP.
        low_level_channels: channels the low-level feature is reduced to.
        decoder_convs: separable convolutions of the decoder.
        align_corners: whether bilinear resizing maps corner pixels onto corner pixels.
        dropout: share of ASPP features dropped while training.
        mean: input mean of R, G, B, on a scale of 0 to 1.
        std: input standard deviation, same scale.
    """

    backbone: Backbone
    classes: tuple[str, ...]
    output_stride: int = 16
    decoder: bool = True
    padding: Padding = "torch"
    size_remainder: int = 0
    dilate_first: bool = True
    backbone_norm: bool = True
    head_norm: bool = True
    backbone_eps: float = 1e-5
    head_eps: float = 1e-5
    top_conv: bool = True
    head_channels: int = 256
    atrous_rates: tuple[int, ...] = (12, 24, 36)
    separable_aspp: bool = True
    pool_first: bool = False
    norm_inside: bool = False
    aspp_conv: bool = True
    low_level_channels: int = 48
    decoder_convs: int = 1
    align_corners: bool = True
    dropout: float = 0.5
    mean: tuple[float, ...] = IMAGENET_MEAN
    std: tuple[float, ...] = IMAGENET_STD


def torch_architecture(
    backbone: str, classes: Sequence[str], *, output_stride: int = 16, where: object = "architecture"
) -> Architecture:
    """DeepLabv3+ with the details of segmentation_models_pytorch.

    Raises:
        JaxmapError: an unknown backbone or stride, or faulty classes.
    """
    return check_architecture(Architecture(backbone, tuple(classes), output_stride), where)  # type: ignore[arg-type]


def tf_architecture(
    backbone: str,
    classes: Sequence[str],
    *,
    output_stride: int = 16,
    decoder: bool = True,
    where: object = "architecture",
) -> Architecture:
    """DeepLabv3 or v3+ with the details of the original TensorFlow networks.

    On MobileNetV2 the original goes without atrous branches and without the last convolution.
    Only MobileNetV2 pads as TensorFlow does by itself; Xception and ResNet pad both sides alike.
    Backbones keep the layout of the weights that can be had for them: ResNet is torchvision's (stride in
    a stage's first unit), and MobileNetV2's low-level feature is a unit's output (24 channels).

    Raises:
        JaxmapError: an unknown backbone or stride, or faulty classes.
    """
    mobile = backbone == "mobilenet_v2"
    rates = () if mobile else (6, 12, 18) if output_stride == 16 else (12, 24, 36)
    return check_architecture(
        Architecture(
            backbone,  # type: ignore[arg-type]
            tuple(classes),
            output_stride,
            decoder,
            padding="same" if mobile else "torch",
            size_remainder=1,
            dilate_first=False,
            backbone_eps=1e-5 if backbone.startswith("resnet") else 1e-3,
            top_conv=False,
            atrous_rates=rates,
            pool_first=True,
            norm_inside=True,
            aspp_conv=False,
            decoder_convs=2,
            dropout=0.1,
            mean=(0.5, 0.5, 0.5),
            std=(0.5, 0.5, 0.5),
        ),
        where,
    )


def torchvision_architecture(
    backbone: str, classes: Sequence[str], *, output_stride: int = 8, where: object = "architecture"
) -> Architecture:
    """DeepLabv3 with the details of torchvision's `deeplabv3_resnet50` and `deeplabv3_resnet101`.

    Published weights are for output stride 8. At 16 the rates are halved, so that the branches see as
    far as before.

    Raises:
        JaxmapError: an unknown backbone or stride, or faulty classes.
    """
    return check_architecture(
        Architecture(
            backbone,  # type: ignore[arg-type]
            tuple(classes),
            output_stride,
            decoder=False,
            dilate_first=False,
            atrous_rates=(12, 24, 36) if output_stride == 8 else (6, 12, 18),
            separable_aspp=False,
            align_corners=False,
        ),
        where,
    )


def check_architecture(architecture: Architecture, where: object = "architecture") -> Architecture:
    """Returns the record where it describes a network that can be built.

    Raises:
        JaxmapError: it does not; all faults are told together.
    """
    record, faults = architecture, []
    if record.backbone not in BACKBONES:
        faults.append(f"backbone {record.backbone!r} is none of {', '.join(BACKBONES)}")
    if record.output_stride not in (8, 16):
        faults.append(f"output_stride {record.output_stride} is neither 8 nor 16")
    if record.padding not in get_args(Padding):
        faults.append(f"padding {record.padding!r} is neither torch nor same")
    if record.size_remainder not in (0, 1):
        faults.append(f"size_remainder {record.size_remainder} is neither 0 nor 1")
    names = record.classes
    told = [name if len(name) <= 40 else f"{name[:40]}..." for name in names[:6]]
    readable = all(name.strip() and name.isprintable() for name in names)
    if not 1 <= len(names) <= MAX_CLASSES or len(set(names)) != len(names) or not readable:
        faults.append(f"classes must be 1 to {MAX_CLASSES} different printable names, not {told}")
    for name, most in (("head_channels", 4096), ("low_level_channels", 4096), ("decoder_convs", 16)):
        if not 1 <= getattr(record, name) <= most:
            faults.append(f"{name} {getattr(record, name)} is not between 1 and {most}")
    if any(not 1 <= rate <= 1024 for rate in record.atrous_rates) or len(record.atrous_rates) > 16:
        faults.append(f"atrous_rates {list(record.atrous_rates)} are not up to 16 numbers from 1 to 1024")
    if not (0 < record.backbone_eps < 1 and 0 < record.head_eps < 1):
        faults.append("the epsilons of batch norm must be between 0 and 1")
    if not 0 <= record.dropout < 1:
        faults.append(f"dropout {record.dropout} is not in [0, 1)")
    finite = all(math.isfinite(value) for value in (*record.mean, *record.std))
    if len(record.mean) != 3 or len(record.std) != 3 or not finite or min(record.std) <= 0:
        faults.append("mean and std must be three finite numbers each, std above 0")
    if faults:
        raise JaxmapError("; ".join(faults), where=where, fix="correct the architecture")
    return record


def folded(architecture: Architecture) -> Architecture:
    """The same network after its batch norms have been folded into the convolutions."""
    return replace(architecture, backbone_norm=False, head_norm=False)
