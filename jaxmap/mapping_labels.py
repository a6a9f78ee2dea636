"""What labels a run: the plane, a network, or files of labels."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from jaxmap.config import MapConfig
from jaxmap.datasets import StereoSequence
from jaxmap.datasets.label_files import LabelFolder, open_label_folder
from jaxmap.deeplab_labeller import make_deeplab_labeller
from jaxmap.errors import UsageError
from jaxmap.files import bundled
from jaxmap.labellers import Labeller, make_files_labeller, make_no_labeller, make_plane_labeller
from jaxmap.labels import ROVER_CLASSES
from jaxmap.models.checkpoint import SavedModel, load_network
from jaxmap.models.tensor_files import shortened
from jaxmap.stereo.rectify import StereoRig


@dataclass(frozen=True)
class ModelFile:
    """The file of the network that labels, and the SHA-256 of its content."""

    path: Path
    sha256: str


def choose_label_folder(config: MapConfig, sequence: StereoSequence) -> LabelFolder | None:
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
        if isinstance(sequence.camera, StereoRig):
            raise UsageError(
                "the images are raw, and labels may lie on raw or on rectified pixels",
                fix="say which: --labels-are raw (your network saw the camera's images) or rectified",
            )
        labels_are = "rectified"
    return open_label_folder(config.labels, len(config.classes or ROVER_CLASSES), labels_are, sequence.frames[0].name)


def choose_model(config: MapConfig) -> tuple[ModelFile | None, SavedModel | None]:
    """The network that labels, where the labeller is one.

    Raises:
        JaxmapError: the file cannot be read, or holds no whole network.
        UsageError: it is not the one that the settings tell.
    """
    if config.labeller != "deeplab":
        if config.model is not None:
            raise UsageError(
                f"--model is given, but the labeller is {config.labeller}",
                fix="add --labeller deeplab, or leave it out",
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


def told_network(model: ModelFile, network: SavedModel, classes: Sequence[str]) -> str:
    """One line on the network and its classes."""
    count = len(network.architecture.classes)
    return (
        f"labels by {model.path.name} ({network.architecture.backbone}, {count} classes), "
        f"mapped as {shortened(classes)}; the settings classes and deeplab.class_map choose"
    )


def choose_labeller(config: MapConfig, label_folder: LabelFolder | None, network: SavedModel | None) -> Labeller:
    """What labels the points.

    Args:
        config: the settings.
        label_folder: of the files labeller.
        network: of the deeplab labeller.

    Raises:
        JaxmapError: classes or numbers that do not serve.
    """
    classes = config.classes
    if classes is not None and len(set(classes)) < len(classes):
        raise UsageError(f"a class is named twice: {' '.join(classes)}", fix="give each class once")
    if network is not None:
        return make_deeplab_labeller(network, classes, **asdict(config.deeplab))
    classes = ROVER_CLASSES if classes is None else classes
    if label_folder is not None:
        return make_files_labeller(classes, soft=label_folder.soft)
    if config.labeller == "plane":
        return make_plane_labeller(classes, **asdict(config.plane))
    return make_no_labeller()
