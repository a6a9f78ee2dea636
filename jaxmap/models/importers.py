"""Converts published weights to our names and layouts, by the tables of `import_tables`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.labels import ROVER_CLASSES
from jaxmap.models import import_tables as tables
from jaxmap.models.architecture import (
    Architecture,
    tf_architecture,
    torch_architecture,
    torchvision_architecture,
)
from jaxmap.models.checkpoint import Holds, raise_mismatch
from jaxmap.models.deeplab import weight_shapes
from jaxmap.models.tensor_files import Tensors, as_float32, read_tensors, shortened

VOC_CLASSES: tuple[str, ...] = (
    *("background", "aeroplane", "bicycle", "bird", "boat", "bottle", "bus", "car", "cat", "chair", "cow"),
    *("diningtable", "dog", "horse", "motorbike", "person", "pottedplant", "sheep", "sofa", "train", "tvmonitor"),
)
"""Pascal VOC's classes in the order of its label images."""


class Imported(NamedTuple):
    """What an importer made.

    Attributes:
        source: what the file was recognised as.
        architecture: the network; for a backbone alone, a network that it fits.
        weights: float32 arrays by our dotted paths.
        holds: whether it is a whole network or a backbone.
    """

    source: str
    architecture: Architecture
    weights: dict[str, np.ndarray]
    holds: Holds


class _Source(NamedTuple):
    """A kind of weight file: what it is called, how to tell it, and how to convert it."""

    name: str
    recognise: Callable[[Tensors], bool]
    convert: Callable[[Tensors, Sequence[str] | None, int | None, Path], Imported]


DEFAULT_STRIDE = 16


def import_weights(
    path: str | PathLike[str], *, classes: Sequence[str] | None = None, output_stride: int | None = None
) -> Imported:
    """Reads a public checkpoint and converts it.

    Args:
        path: `.safetensors`, or a PyTorch zip.
        classes: names of its classes in order; Pascal VOC's where there are 21, else `class_0` and on.
        output_stride: the stride to run the network at, which weights do not tell; without it 8 for
            torchvision's DeepLabv3, as it was trained, and 16 for all others.

    Raises:
        JaxmapError: the file cannot be read, is of no known kind, or its tensors are not those of
            the network it looks like (everything missing, left over or misshapen in one error).
    """
    path = Path(path)
    tensors = _without_prefix(read_tensors(path))
    if "backbone.stem.kernel" in tensors or "backbone.stem.0.kernel" in tensors:
        raise JaxmapError("already a model file of jaxmap's", where=path, fix="use it as it is")
    for source in SOURCES:
        if source.recognise(tensors):
            return source.convert(tensors, classes, output_stride, path)
    raise JaxmapError(
        f"weights of no known kind (there is {shortened(list(tensors), 2) or 'nothing'})",
        where=path,
        fix=f"known are {', '.join(source.name for source in SOURCES)}",
    )


def _without_prefix(tensors: Tensors) -> Tensors:
    """Without the `module.` or `model.` that wrappers put before every name."""
    for prefix in ("module.", "model."):
        if tensors and all(name.startswith(prefix) for name in tensors):
            tensors = {name.removeprefix(prefix): value for name, value in tensors.items()}
    return tensors


def _resnet_of(tensors: Tensors, prefix: str, where: Path) -> str:
    units = tuple(
        sum(f"{prefix}layer{stage}.{unit}.conv1.weight" in tensors for unit in range(64)) for stage in (1, 2, 3, 4)
    )
    bottleneck = f"{prefix}layer1.0.conv3.weight" in tensors
    for name, expected in tables.RESNET_UNITS.items():
        if units == expected and bottleneck == (name != "resnet18"):
            return name
    kind = "bottleneck" if bottleneck else "basic"
    raise JaxmapError(
        f"a ResNet of {'+'.join(map(str, units))} {kind} units",
        where=where,
        fix=f"known are {', '.join(tables.RESNET_UNITS)}",
    )


def _class_names(count: int, given: Sequence[str] | None, where: Path) -> tuple[str, ...]:
    if given is not None:
        if len(given) != count:
            raise JaxmapError(
                f"{len(given)} classes are named, the network has {count}", where=where, fix="name all in order"
            )
        return tuple(given)
    return VOC_CLASSES if count == len(VOC_CLASSES) else tuple(f"class_{index}" for index in range(count))


def convert(
    tensors: Tensors,
    rows: Sequence[tables.Row],
    naming: tables.Naming,
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
        ignored: starts of names in the source that are left out knowingly (an ImageNet classifier).

    Raises:
        JaxmapError: names are missing or left over, or shapes are wrong; all in one error.
    """
    by_block = {row.block: row for row in rows}
    missing, misshapen, used, result = [], [], set(), {}
    for name, shape in weight_shapes(architecture).items():
        if holds == "backbone" and not name.startswith("backbone."):
            continue
        source = _source_name(name, by_block, naming)
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


def _source_name(name: str, by_block: dict[str, tables.Row], naming: tables.Naming) -> str | None:
    block, _, leaf = name.rpartition(".")
    if block.endswith(".norm"):
        row = by_block.get(block.removesuffix(".norm"))
        return None if row is None or row.norm is None else row.norm + naming.norm[leaf]
    row = by_block.get(block)
    return None if row is None else row.convolution + (naming.kernel if leaf == "kernel" else naming.bias)


def _from_smp(tensors: Tensors, classes: Sequence[str] | None, stride: int | None, path: Path) -> Imported:
    mobile = "encoder.features.0.0.weight" in tensors
    backbone = "mobilenet_v2" if mobile else _resnet_of(tensors, "encoder.", path)
    head = tensors.get("segmentation_head.0.weight")
    names = _class_names(len(head) if head is not None and head.ndim else 1, classes, path)
    architecture = torch_architecture(backbone, names, output_stride=stride or DEFAULT_STRIDE, where=path)
    rows = [*tables.torchvision_backbone(backbone, "encoder."), *tables.smp_head(architecture)]
    weights = convert(
        tensors,
        rows,
        tables.TORCH,
        architecture,
        holds="network",
        where=path,
        ignored=("encoder.fc.", "encoder.classifier."),
    )
    return Imported(f"segmentation_models_pytorch DeepLabV3Plus, {backbone}", architecture, weights, "network")


def _from_torchvision_deeplab(
    tensors: Tensors, classes: Sequence[str] | None, stride: int | None, path: Path
) -> Imported:
    backbone = _resnet_of(tensors, "backbone.", path)
    head = tensors.get("classifier.4.bias")
    names = _class_names(1 if head is None else head.size, classes, path)
    architecture = torchvision_architecture(backbone, names, output_stride=stride or 8, where=path)
    rows = [*tables.torchvision_resnet(backbone, "backbone."), *tables.torchvision_head(architecture)]
    weights = convert(
        tensors, rows, tables.TORCH, architecture, holds="network", where=path, ignored=("aux_classifier.",)
    )
    return Imported(f"torchvision DeepLabv3, {backbone}", architecture, weights, "network")


def _from_torchvision(tensors: Tensors, classes: Sequence[str] | None, stride: int | None, path: Path) -> Imported:
    mobile = "features.0.0.weight" in tensors
    backbone = "mobilenet_v2" if mobile else _resnet_of(tensors, "", path)
    return _torch_backbone(
        "torchvision", backbone, list(tables.torchvision_backbone(backbone)), tensors, classes, stride, path
    )


def _from_timm(tensors: Tensors, classes: Sequence[str] | None, stride: int | None, path: Path) -> Imported:
    return _torch_backbone("timm", "mobilenet_v2", list(tables.timm_mobilenet_v2()), tensors, classes, stride, path)


def _torch_backbone(
    family: str,
    backbone: str,
    rows: list[tables.Row],
    tensors: Tensors,
    classes: Sequence[str] | None,
    stride: int | None,
    path: Path,
) -> Imported:
    architecture = torch_architecture(
        backbone, classes or ROVER_CLASSES, output_stride=stride or DEFAULT_STRIDE, where=path
    )
    weights = convert(
        tensors, rows, tables.TORCH, architecture, holds="backbone", where=path, ignored=("classifier.", "fc.")
    )
    return Imported(f"{family} {backbone} backbone", architecture, weights, "backbone")


def _from_tf_folded(tensors: Tensors, classes: Sequence[str] | None, stride: int | None, path: Path) -> Imported:
    if "logits_semantic/bias" in tensors:
        names = _class_names(tensors["logits_semantic/bias"].size, classes, path)
        plain = tf_architecture(
            "mobilenet_v2", names, output_stride=stride or DEFAULT_STRIDE, decoder=False, where=path
        )
        architecture = replace(plain, backbone_norm=False, head_norm=False)
        rows = [*tables.tf_folded_mobilenet_v2(top=False), *tables.tf_folded_head()]
        weights = convert(tensors, rows, tables.TENSORFLOW, architecture, holds="network", where=path)
        return Imported("TensorFlow DeepLabv3, mobilenet_v2, folded", architecture, weights, "network")
    plain = tf_architecture(
        "mobilenet_v2", classes or ROVER_CLASSES, output_stride=stride or DEFAULT_STRIDE, where=path
    )
    architecture = replace(plain, top_conv=True, backbone_norm=False)
    rows = list(tables.tf_folded_mobilenet_v2(top=True))
    weights = convert(tensors, rows, tables.TENSORFLOW, architecture, holds="backbone", where=path)
    return Imported("TensorFlow mobilenet_v2 backbone, folded", architecture, weights, "backbone")


SOURCES = (
    _Source(
        "segmentation_models_pytorch DeepLabV3Plus",
        lambda tensors: any(name.startswith("decoder.aspp.") for name in tensors),
        _from_smp,
    ),
    _Source(
        "torchvision deeplabv3_resnet50 and deeplabv3_resnet101",
        lambda tensors: "classifier.0.convs.0.0.weight" in tensors and "backbone.conv1.weight" in tensors,
        _from_torchvision_deeplab,
    ),
    _Source("timm mobilenetv2_100", lambda tensors: "conv_stem.weight" in tensors, _from_timm),
    _Source(
        "torchvision (or timm) resnet18, resnet50, resnet101, mobilenet_v2",
        lambda tensors: "features.0.0.weight" in tensors or "layer1.0.conv1.weight" in tensors,
        _from_torchvision,
    ),
    _Source("TensorFlow folded mobilenet_v2 and DeepLabv3", lambda tensors: "Conv/kernel" in tensors, _from_tf_folded),
)
"""Every kind that is recognised, the most particular first."""
