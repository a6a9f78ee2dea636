"""What training starts from: a network decided by settings and file, with kept and fresh weights."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax

from jaxmap.errors import UsageError
from jaxmap.models.architecture import Architecture, tf_architecture, torch_architecture
from jaxmap.models.checkpoint import SavedModel
from jaxmap.models.deeplab import Weights, initial_weights
from jaxmap.models.tensor_files import shortened
from jaxmap.training.options import NetworkOptions, NormOptions

_BACKBONE_FIELDS = (
    *("backbone", "padding", "size_remainder", "dilate_first", "backbone_norm", "backbone_eps", "top_conv"),
    *("mean", "std"),
)
"""What the weights of a backbone were trained with, and cannot do without."""

_CHOICES = (
    *("output_stride", "head_channels", "atrous_rates", "decoder", "decoder_convs", "low_level_channels"),
    *("top_conv", "dropout"),
)
"""Fields that `NetworkOptions` may set."""


class Start(NamedTuple):
    """A network ready to be trained.

    Attributes:
        architecture: what it is.
        weights: its arrays by dotted path.
        fresh: blocks of weights that are random.
        batch_norms: prefixes of the blocks whose batch norms learn from the batch.
    """

    architecture: Architecture
    weights: Weights
    fresh: tuple[str, ...]
    batch_norms: tuple[str, ...]


def make_start(
    options: NetworkOptions,
    norm: NormOptions,
    classes: Sequence[str],
    init: SavedModel | None,
    *,
    seed: int,
    where: Path | str = "--init",
) -> Start:
    """Decides the network and its first weights.

    Weights of `init` are kept where the network has the same array; the classifier only where the classes
    are the same too.

    Args:
        options: the network asked for.
        norm: which batch norms learn.
        classes: of the training data.
        init: what to start from, or None to start from random weights.
        seed: of the random weights.
        where: the file of `init`, for errors.

    Raises:
        UsageError: another backbone is asked for than the file has, or nothing of the file can be kept.
        JaxmapError: no such network can be built.
    """
    architecture = _architecture(options, tuple(classes), init, where)
    weights = initial_weights(architecture, jax.random.key(seed))
    kept: set[str] = set()
    if init is not None:
        same_classes = init.holds == "network" and init.architecture.classes == architecture.classes
        kept = {
            name
            for name, value in init.weights.items()
            if name in weights
            and weights[name].shape == value.shape
            and (same_classes or not name.startswith("classifier."))
        }
        lost = sorted({_block(name) for name in init.weights if name.startswith("backbone.") and name not in kept})
        if lost and not all(block == "backbone.top" for block in lost):
            raise UsageError(
                f"the network has no place for {shortened(lost)}", where=where, fix="leave the backbone as it is"
            )
        weights.update({name: init.weights[name] for name in kept})
    fresh = tuple(sorted({name.split(".")[0] for name in weights if name not in kept}))
    return Start(architecture, weights, fresh, _batch_norms(norm, fresh))


def _architecture(
    options: NetworkOptions, classes: tuple[str, ...], init: SavedModel | None, where: Path | str
) -> Architecture:
    chosen = {name: value for name in _CHOICES if (value := getattr(options, name)) is not None}
    if init is None:
        return dataclasses.replace(_of_family(options, classes), **chosen)
    trained = init.architecture
    if options.backbone not in (None, trained.backbone):
        raise UsageError(
            f"the file holds {trained.backbone}, not {options.backbone}", where=where, fix="leave out network.backbone"
        )
    if init.holds == "network" and options.family is None:
        return dataclasses.replace(trained, classes=classes, **chosen)
    family = options.family or ("tf" if trained.padding == "same" else "torch")
    stride = options.output_stride or trained.output_stride
    asked = dataclasses.replace(options, backbone=trained.backbone, family=family, output_stride=stride)
    kept = {name: getattr(trained, name) for name in _BACKBONE_FIELDS}
    return dataclasses.replace(_of_family(asked, classes), **{**kept, **chosen})


def _of_family(options: NetworkOptions, classes: tuple[str, ...]) -> Architecture:
    stride = options.output_stride or 16
    make = tf_architecture if options.family == "tf" else torch_architecture
    record = make(options.backbone or "mobilenet_v2", classes, output_stride=stride)
    if record.atrous_rates:
        return record
    # The original leaves its small network without them, for speed on telephones.
    return dataclasses.replace(record, atrous_rates=(6, 12, 18) if stride == 16 else (12, 24, 36))


def _batch_norms(norm: NormOptions, fresh: tuple[str, ...]) -> tuple[str, ...]:
    """Batch norms that were trained before keep their statistics: few images would spoil them."""

    def learns(choice: str, parts: tuple[str, ...]) -> bool:
        return choice == "batch" or (choice == "auto" and any(part in fresh for part in parts))

    backbone = ("backbone",) if learns(norm.backbone, ("backbone",)) else ()
    head = ("aspp", "decoder")
    return backbone + (head if learns(norm.head, head) else ())


def _block(name: str) -> str:
    return ".".join(name.split(".")[:2])
