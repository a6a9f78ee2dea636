"""What labels the points of a map: the network, the files or the rule that the settings name."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jaxmap.checks.samples import spread_indices
from jaxmap.datasets import StereoSequence
from jaxmap.datasets.label_files import LabelFolder, open_label_folder
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.host.files import bundled
from jaxmap.labellers.base import Labeller, make_no_labeller
from jaxmap.labellers.deeplab import make_deeplab_labeller, make_logits_labeller
from jaxmap.labellers.files import make_files_labeller
from jaxmap.labellers.plane import make_plane_labeller
from jaxmap.labellers.relief import combine_with_relief, make_relief_labeller
from jaxmap.labels import ROVER_CLASSES
from jaxmap.models.architecture import Architecture
from jaxmap.models.checkpoint import SavedModel, load_network
from jaxmap.models.tensor_files import shortened
from jaxmap.runs.config import PerceiveConfig
from jaxmap.stereo.rectify import StereoRig
from jaxmap.types import StereoCamera

Notify = Callable[[str], None]

LABELS_LOOKED_AT = 8
"""Frames whose labels are looked at before the first is mapped."""

BUNDLED_WIDTH_PX = 512
"""Width that the bundled network runs at: at twice that it takes four times as long for a hundredth of IoU."""


@dataclass(frozen=True)
class ModelFile:
    """The file of the network that labels, and the SHA-256 of its content."""

    path: Path
    sha256: str


def choose_label_folder(config: PerceiveConfig, sequence: StereoSequence) -> LabelFolder | None:
    """The folder of labels that the settings name, where labels come from files.

    Raises:
        JaxmapError: it cannot be read.
        UsageError: it is missing, or means nothing to the labeller.
    """
    if config.labeller != "files":
        if config.labels is not None:
            raise UsageError(
                f"--labels is given, but the labeller is {config.labeller}", fix="add --labeller files, or leave it out"
            )
        return None
    if config.labels is None:
        raise UsageError("the files labeller needs a folder of labels", fix="give --labels DIR")
    labels_are = config.labels_are
    if labels_are == "auto":
        if isinstance(sequence.camera, StereoRig) or sequence.rectify_labels is not None:
            raise UsageError(
                "the images are raw, and labels may lie on raw or on rectified pixels",
                fix="say which: --labels-are raw (your network saw the camera's images) or rectified",
            )
        labels_are = "rectified"
    folder = open_label_folder(config.labels, len(config.classes or ROVER_CLASSES), labels_are, sequence.frames[0].name)
    return replace(folder, rectify=sequence.rectify_labels)


def warn_of_masks(folder: LabelFolder, sequence: StereoSequence, notify: Notify) -> None:
    """Tells where the labels of frames spread over a sequence look like black and white masks."""
    names = [sequence.frames[index].name for index in spread_indices(len(sequence.frames), LABELS_LOOKED_AT)]
    if folder.looks_binary(names):
        notify(
            f"note: the labels of {len(names)} frames are 0 and 255 alone, and 255 is no label: where they are black "
            "and white masks, write the indices of --classes in their place"
        )


def choose_model(config: PerceiveConfig) -> tuple[ModelFile | None, SavedModel | None]:
    """The network that labels, where the labeller is one.

    Raises:
        JaxmapError: the file cannot be read, or holds no whole network.
        UsageError: it is not the one that the settings name.
    """
    if config.labeller != "deeplab":
        if config.model is not None:
            raise UsageError(
                f"--model is given, but the labeller is {config.labeller}",
                fix="take --labeller deeplab, or leave it out",
            )
        return None, None
    path = config.model or bundled("rover.safetensors")
    saved = load_network(path)
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    if config.model_sha256 is not None and config.model_sha256.lower() != sha256:
        raise UsageError(
            f"the model's SHA-256 does not start with {config.model_sha256[:16]}",
            where=path,
            fix="give the model of that run, or leave out model_sha256",
        )
    return ModelFile(path, sha256), saved


def describe_network(model: ModelFile, network: Architecture, classes: Sequence[str]) -> str:
    """One line on the network and its classes."""
    count = len(network.classes)
    return (
        f"labels by {model.path.name} ({network.name} on {network.backbone}, {count} classes), "
        f"mapped as {shortened(classes)}; the settings classes and deeplab.class_map choose"
    )


def choose_labeller(
    config: PerceiveConfig, soft: bool | None, network: SavedModel | Architecture | None, camera: StereoCamera
) -> Labeller:
    """What labels the points.

    Args:
        config: the settings.
        soft: of the files labeller: whether the files hold probabilities.
        network: of the deeplab labeller; its architecture alone where it has run before.
        camera: whose images it labels.

    Raises:
        JaxmapError: classes or numbers that do not serve.
    """
    classes = config.classes
    if classes is not None and len(set(classes)) < len(classes):
        raise UsageError(f"a class is named twice: {' '.join(classes)}", fix="give each class once")
    if config.relief.combine and config.labeller not in ("deeplab", "files"):
        raise UsageError(
            f"--relief is given, but the labeller is {config.labeller}",
            fix="take --labeller deeplab or files, or leave --relief out",
        )
    if network is not None:
        deeplab = replace(config.deeplab, size_px=network_size_px(config, camera))
        make: Any = make_deeplab_labeller if isinstance(network, SavedModel) else make_logits_labeller
        labeller = make(network, classes, deeplab)
        known = {config.relief.ground, config.relief.rock} <= set(labeller.classes)
        return _with_relief(labeller, config, by_default=known)
    classes = ROVER_CLASSES if classes is None else classes
    if soft is not None:
        return _with_relief(make_files_labeller(classes, soft=soft), config, by_default=False)
    if config.labeller == "relief":
        return make_relief_labeller(classes, config.relief)
    if config.labeller == "plane":
        return make_plane_labeller(classes, config.plane)
    return make_no_labeller()


def network_size_px(config: PerceiveConfig, camera: StereoCamera) -> tuple[int, int] | None:
    """Height and width that the network runs at; None for those of the images."""
    shrink = BUNDLED_WIDTH_PX / camera.width_px
    if config.model is None and config.deeplab.size_px is None and shrink < 1:
        return round(shrink * camera.height_px), BUNDLED_WIDTH_PX
    return config.deeplab.size_px


def _with_relief(labeller: Labeller, config: PerceiveConfig, *, by_default: bool) -> Labeller:
    combine = by_default if config.relief.combine is None else config.relief.combine
    return combine_with_relief(labeller, config.relief) if combine else labeller


@contextmanager
def as_usage_error() -> Iterator[None]:
    """What is refused while settings are taken up is the fault of the settings."""
    try:
        yield
    except UsageError:
        raise
    except JaxmapError as error:
        raise UsageError(error.what, where=error.where, fix=error.fix or "see jaxmap map --help") from error
