"""The network at the start of training: its architecture from options and file, its weights loaded or random."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax

from jaxmap.errors import UsageError
from jaxmap.geometry.relief import RELIEF_CHANNELS
from jaxmap.models.architecture import Architecture, tf_architecture, torch_architecture
from jaxmap.models.checkpoint import SavedModel
from jaxmap.models.network import Weights, initial_weights
from jaxmap.models.tensor_files import shortened
from jaxmap.training.options import BatchNormOptions, NetworkOptions

_BACKBONE_FIELDS = (
    *("backbone", "padding", "size_remainder", "dilate_first", "backbone_norm", "backbone_eps", "top_conv"),
    *("mean", "std"),
)
"""Fields that the weights of a backbone were trained with and depend on."""

_CHOICES = (
    *("output_stride", "head_channels", "atrous_rates", "decoder", "decoder_convs", "low_level_channels"),
    *("top_conv", "dropout"),
)
"""Fields that `NetworkOptions` may set."""

_OF_DEEPLAB = ("family", "atrous_rates", "decoder_convs", "low_level_channels", "relief")
_FOREIGN = {
    "fcn": _OF_DEEPLAB,
    "unet": (*_OF_DEEPLAB, "decoder", "dropout"),
    "segnet": (*_OF_DEEPLAB, "decoder", "dropout", "head_channels"),
}
"""Options that mean nothing to a kind of network."""


class InitialNetwork(NamedTuple):
    """A network ready to be trained.

    Attributes:
        architecture: of the network.
        weights: arrays by dotted path.
        fresh: parts whose weights are random.
        batch_norms: prefixes of the parts whose batch norms train.
    """

    architecture: Architecture
    weights: Weights
    fresh: tuple[str, ...]
    batch_norms: tuple[str, ...]


def make_initial_network(
    options: NetworkOptions,
    norm: BatchNormOptions,
    classes: Sequence[str],
    init: SavedModel | None,
    *,
    seed: int,
    where: Path | str = "--init",
) -> InitialNetwork:
    """Chooses the architecture and the initial weights.

    Weights of `init` are loaded where the network has an array of the same name and shape; those of the classifier
    only if the classes agree as well, and of another kind of network only those of the backbone.

    Args:
        options: of the network.
        norm: which batch norms train.
        classes: of the training data.
        init: the model to start from, or None for random weights.
        seed: of the random weights.
        where: the file of `init`, for errors.

    Raises:
        UsageError: the options ask for another backbone than the file has, or mean nothing to this kind of network.
        JaxmapError: no such network can be built.
    """
    architecture = _architecture(options, tuple(classes), init, where)
    weights = initial_weights(architecture, jax.random.key(seed))
    kept: set[str] = set()
    if init is not None:
        same_classes = init.holds == "network" and init.architecture.classes == architecture.classes
        same_kind = init.architecture.kind == architecture.kind
        kept = {
            name
            for name, value in init.weights.items()
            if name in weights
            and weights[name].shape == value.shape
            and (same_classes or not name.startswith("classifier."))
            and (same_kind or name.startswith("backbone."))
        }
        unused = [name for name in init.weights if name.startswith("backbone.") and name not in kept]
        lost = sorted({".".join(name.split(".")[:2]) for name in unused})
        if lost not in ([], ["backbone.top"]):
            what = f"the network has no place for {shortened(lost)}"
            raise UsageError(what, where=where, fix="leave the backbone as it is")
        weights.update({name: init.weights[name] for name in kept})
    fresh = tuple(sorted({name.split(".")[0] for name in weights if name not in kept}))
    # Batch norms that were trained before keep their statistics by default: few images would spoil them.
    with_norms = {name.split(".")[0] for name in weights if ".norm." in name}
    trained = [
        part
        for choice, parts in ((norm.backbone, ("backbone",)), (norm.head, tuple(sorted(with_norms - {"backbone"}))))
        for part in parts
        if choice == "batch" or (choice == "auto" and set(parts) & set(fresh))
    ]
    return InitialNetwork(architecture, weights, fresh, tuple(trained))


def _architecture(
    options: NetworkOptions, classes: tuple[str, ...], init: SavedModel | None, where: Path | str
) -> Architecture:
    chosen = {name: value for name in _CHOICES if (value := getattr(options, name)) is not None}
    if options.relief is not None:
        chosen["relief_channels"] = RELIEF_CHANNELS if options.relief else 0
    kind = options.kind or ("deeplab" if init is None else init.architecture.kind)
    if foreign := [name for name in _FOREIGN.get(kind, ()) if getattr(options, name) is not None]:
        name = foreign[0].replace("_", "-")
        raise UsageError(f"network.{name} is given, which means nothing to {kind}", where="network", fix="leave it out")
    if init is None:
        return replace(_of_family(options, classes), **chosen)
    trained = init.architecture
    if options.backbone not in (None, trained.backbone):
        raise UsageError(
            f"the file holds {trained.backbone}, not {options.backbone}", where=where, fix="leave out network.backbone"
        )
    if init.holds == "network" and options.family is None and kind == trained.kind:
        return replace(trained, classes=classes, **chosen)
    family = options.family or ("tf" if trained.size_remainder else "torch")
    stride = options.output_stride or (trained.output_stride if kind == trained.kind else None)
    asked = replace(options, kind=kind, backbone=trained.backbone, family=family, output_stride=stride)
    kept = {name: getattr(trained, name) for name in _BACKBONE_FIELDS if kind == "deeplab" or name != "size_remainder"}
    return replace(_of_family(asked, classes), **{**kept, **chosen})


def _of_family(options: NetworkOptions, classes: tuple[str, ...]) -> Architecture:
    if options.kind not in (None, "deeplab"):
        # Another stride may go only with another choice, of the decoder: both are set at once, by the caller.
        return torch_architecture(options.backbone or "mobilenet_v2", classes, kind=options.kind)
    stride = options.output_stride or 16
    make = tf_architecture if options.family == "tf" else torch_architecture
    record = make(options.backbone or "mobilenet_v2", classes, output_stride=stride)
    if record.atrous_rates:
        return record
    # The original MobileNetV2 has none, for speed on phones.
    return replace(record, atrous_rates=(6, 12, 18) if stride == 16 else (12, 24, 36))
