"""The plan of a training run: configuration, data, network and compiled step, decided before the first step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxmap.errors import UsageError
from jaxmap.geometry.options import GridOptions
from jaxmap.host.files import real_path
from jaxmap.host.settings import CellSize, NotNegative, Positive, Settings, options
from jaxmap.models.architecture import Architecture
from jaxmap.models.checkpoint import load_model
from jaxmap.models.network import Weights
from jaxmap.runs.config import LabellerName, MapConfig
from jaxmap.training.batches import ExampleOrder, ExampleReader, batches_from
from jaxmap.training.data import TrainingSet, check_training_set, digest, open_training_set, with_stereo
from jaxmap.training.initial_network import InitialNetwork, make_initial_network
from jaxmap.training.losses import class_weights
from jaxmap.training.options import DataOptions, NetworkOptions, TrainingOptions
from jaxmap.training.step import Batch, Trainer, make_trainer
from jaxmap.training.validation import ImageValidator, Validation
from jaxmap.tuning.map_step import MapTrainer


@options("map_truth")
class MapTruthOptions:
    """How maps are compared with the ground truth, with map supervision."""

    cell_size_m: Annotated[float, CellSize] = 0.2
    """Edge of the cells that map and ground truth are compared in."""
    remap: tuple[str, ...] | None = None
    """What the values of the orthomosaic mean, as in evaluate: such as 0=unlabelled 1=sand 2=rock."""
    crs: str | None = None
    """Coordinate reference system of the orthomosaic, in place of its own."""
    anchor: Annotated[float, NotNegative] = 1.0
    """Weight of the loss that holds the network to its initial labels of classes that no orthomosaic shows, such as
    the background."""
    temperature: Annotated[float, Positive] = 3.0
    """Divides the logits before they are fused in training: above 1, confident wrong pixels keep a gradient."""


@options("mapping")
class SupervisedMapConfig(MapConfig):
    """How a sequence is mapped by the network in training."""

    labeller: LabellerName = "deeplab"
    """Must be deeplab: the network in training labels."""
    grid: GridOptions = field(default_factory=lambda: GridOptions(voxel_size_m=(0.1, 0.1, 0.2)))


@options()
class TrainConfig(TrainingOptions):
    """Everything that determines the result of a training run."""

    supervision: Literal["pixels", "map"] = "pixels"
    """Masks of images, or an orthomosaic that the map of a sequence is compared with."""
    ground_truth: Path | None = None
    """The labelled orthomosaic, with map supervision."""
    classes: tuple[str, ...] = ("background", "sand", "rock")
    """The classes, in the order of the labels."""
    data: DataOptions = field(default_factory=DataOptions)
    network: NetworkOptions = field(default_factory=NetworkOptions)
    map_truth: MapTruthOptions = field(default_factory=MapTruthOptions)
    mapping: SupervisedMapConfig = field(default_factory=SupervisedMapConfig)
    """How the sequence is read and mapped, with map supervision: the settings of jaxmap map."""


TRAIN_SETTINGS = Settings(TrainConfig, "train", folder="train", given=("training_data", "init"))
"""Reads and writes a `TrainConfig`; a run's config.yaml names data and initial model as well."""


class Validator(Protocol):
    """Scores weights on validation data."""

    def score(self, weights: Weights) -> Validation:
        """Scores weights, running statistics included."""
        ...


class TrainingData(Protocol):
    """Training and validation data: images with masks, or the frames of a map."""

    @property
    def source(self) -> str:
        """The folder or sequence, for config.yaml."""
        ...

    @property
    def title(self) -> str:
        """A heading for the page."""
        ...

    @property
    def names(self) -> Sequence[str]:
        """Names of the training images."""
        ...

    def batches(self, order: ExampleOrder, first_step: int) -> Iterator[Any]:
        """The batches of a run from `first_step` on."""
        ...

    def validator(self, architecture: Architecture) -> Validator | None:
        """The validator; None without validation data."""
        ...

    def digest(self) -> str:
        """A fingerprint of what a resumed run must share beside its settings."""
        ...

    def counts(self) -> dict[str, Any]:
        """Images and pixels, for metrics.json."""
        ...

    def facts(self) -> dict[str, str]:
        """Facts on the data, for the page."""
        ...


class TrainingPlan(NamedTuple):
    """All that a training run needs.

    Attributes:
        config: its settings.
        data: training and validation data.
        network: the network and its initial weights.
        init: the model file of those, or None.
        order: of the examples.
        trainer: the compiled step.
    """

    config: TrainConfig
    data: TrainingData
    network: InitialNetwork
    init: Path | None
    order: ExampleOrder
    trainer: Trainer | MapTrainer


@dataclass(frozen=True)
class ImageTrainingData:
    """Images with masks, as `TrainingData`.

    Attributes:
        training_set: the images.
        class_pixels: pixels of each class, in training (row 0) and validation (row 1).
        reader: of the training images.
    """

    training_set: TrainingSet
    class_pixels: np.ndarray
    reader: ExampleReader

    @property
    def source(self) -> str:
        """The folder."""
        return str(real_path(self.training_set.folder))

    @property
    def title(self) -> str:
        """The folder's name."""
        return real_path(self.training_set.folder).name

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the training images."""
        return tuple(example.name for example in self.training_set.train)

    def batches(self, order: ExampleOrder, first_step: int) -> Iterator[Batch]:
        """The batches of a run from `first_step` on."""
        return batches_from(self.reader, order, first_step)

    def validator(self, architecture: Architecture) -> ImageValidator | None:
        """Scores the pixels of the validation images; None without any."""
        validation = self.training_set.validation
        return ImageValidator(architecture, validation, self.training_set.lookup) if validation else None

    def digest(self) -> str:
        """A fingerprint of images, masks and split."""
        return digest(self.training_set)

    def counts(self) -> dict[str, Any]:
        """Images, and pixels of each class."""
        data = self.training_set
        return {
            "images": {"train": len(data.train), "validation": len(data.validation)},
            "class_pixels": {
                name: {"train": int(train), "validation": int(validation)}
                for name, train, validation in zip(data.classes, *self.class_pixels, strict=True)
            },
        }

    def facts(self) -> dict[str, str]:
        """Numbers of images, and of those with relief."""
        parts = {"Training images": self.training_set.train, "Validation images": self.training_set.validation}
        return {
            name: f"{len(part)}, {found} with relief"
            if (found := sum(example.stereo is not None for example in part))
            else str(len(part))
            for name, part in parts.items()
        }


def plan_image_training(
    folder: Path, config: TrainConfig, init: Path | None, *, notify: Callable[[str], None]
) -> TrainingPlan:
    """Reads all images and masks once, and builds network and step.

    Args:
        folder: of images and masks.
        config: the settings.
        init: a model file to start from.
        notify: takes lines for the user.

    Raises:
        JaxmapError: data, settings or model file are unusable.
    """
    devices = jax.local_device_count()
    if config.batch_size % devices:
        what = f"batch_size {config.batch_size} cannot be shared by {devices} devices"
        raise UsageError(what, fix=f"take a multiple of {devices}")
    training_set = open_training_set(folder, config.classes, config.data, seed=config.seed)
    for note in training_set.notes:
        notify(f"note: {note}")
    saved, where = (None, "network") if init is None else (load_model(init), init)
    network = make_initial_network(config.network, config.norm, config.classes, saved, seed=config.seed, where=where)
    relief = network.architecture.relief_channels > 0
    if relief:
        training_set = with_stereo(training_set)
        if not any(example.stereo for example in training_set.train):
            _say_without_relief(config, folder, notify)
    counts = check_training_set(training_set)
    shares = zip(config.classes, counts[0] / counts[0].sum(), strict=True)
    notify(
        f"{len(training_set.train)} images to train on, {len(training_set.validation)} to validate; training pixels: "
        + ", ".join(f"{name} {share:.1%}" for name, share in shares)
    )
    notify(describe_network(network))
    order = ExampleOrder.of(len(training_set.train), config)
    trainer = make_trainer(
        network.architecture,
        config,
        steps=order.steps,
        class_weights=jnp.asarray(class_weights(config.loss, counts[0])),
        batch_norms=network.batch_norms,
        negated=training_set.lookup.negated,
    )
    data = ImageTrainingData(
        training_set, counts, ExampleReader(training_set.train, training_set.lookup, relief=relief)
    )
    return TrainingPlan(config, data, network, init, order, trainer)


def _say_without_relief(config: TrainConfig, folder: Path, notify: Callable[[str], None]) -> None:
    """A network that sees relief may be trained on images alone, unless relief was asked for.

    Raises:
        UsageError: it was.
    """
    if config.network.relief:
        raise UsageError(
            "no training image has a disparity, and network.relief is given",
            where=folder,
            fix="put disparity/NAME.png and cameras/NAME.json beside images and masks, or leave out --network.relief",
        )
    notify("note: no training image has a disparity: the network, which also sees relief, learns from images alone")


def describe_network(network: InitialNetwork) -> str:
    """One line on the network and its initial weights."""
    record, parameters = network.architecture, sum(jnp.size(weight) for weight in network.weights.values())
    return (
        f"{record.name} on {record.backbone}{' and relief' * bool(record.relief_channels)}, "
        f"{parameters / 1e6:.1f} million parameters, "
        f"output stride {record.output_stride}; fresh: {', '.join(network.fresh) or 'nothing'}; "
        f"batch norm learns in: {', '.join(network.batch_norms) or 'nothing'}"
    )
