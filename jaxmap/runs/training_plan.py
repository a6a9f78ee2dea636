"""A training run, decided in full before the first step: data, network, order, recipe."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import Ge, Gt, Interval
from pydantic import BeforeValidator

from jaxmap.errors import UsageError
from jaxmap.geometry.options import GridOptions
from jaxmap.host.settings import Settings
from jaxmap.models.architecture import Architecture
from jaxmap.models.checkpoint import load_model
from jaxmap.models.deeplab import Weights
from jaxmap.runs.config import LabellerName, MapConfig
from jaxmap.training.batches import Order, Pixels, batches_from
from jaxmap.training.data import TrainingSet, check_training_set, digest, open_training_set
from jaxmap.training.losses import class_weights
from jaxmap.training.options import NetworkOptions, TrainingOptions
from jaxmap.training.starts import Start, make_start
from jaxmap.training.step import Batch, Trainer, make_trainer
from jaxmap.training.validation import Validation, Validator
from jaxmap.tuning.map_step import MapTrainer

_STRICT: dict[str, object] = {"extra": "forbid", "allow_inf_nan": False}

Value = Annotated[str, BeforeValidator(str)]
"""A value of the masks as text: YAML reads a number, JSON and the command line text."""


@dataclass(frozen=True)
class DataConfig:
    """What the masks mean, and which images validate."""

    __pydantic_config__: ClassVar[dict[str, object]] = _STRICT

    remap: dict[Value, str] | None = None
    """Class by value of the masks, such as 255 rock; "ignore" is no class, and the value * every other."""
    palette: dict[str, str] | None = None
    """Colour of the masks by class, such as rock #ff0000; several of a class with blanks between."""
    validation_share: Annotated[float, Interval(ge=0, lt=1)] = 0.2
    """Share of the images that validates where no val.txt or train.txt says."""


@dataclass(frozen=True)
class MapTruthConfig:
    """How maps are compared with the ground truth, with map supervision."""

    __pydantic_config__: ClassVar[dict[str, object]] = _STRICT

    cell_size_m: Annotated[float, Gt(0)] = 0.2
    """Edge of the cells that map and ground truth are compared in."""
    remap: tuple[str, ...] | None = None
    """What the values of the orthomosaic mean, as in evaluate: such as 0=unlabelled 1=sand 2=rock."""
    crs: str | None = None
    """Coordinate reference system of the orthomosaic, in place of its own."""
    anchor: Annotated[float, Ge(0)] = 1.0
    """How firmly the network is held to what it said at first of the classes that no orthomosaic shows, such as the
    background."""
    temperature: Annotated[float, Gt(0)] = 3.0
    """Divides the logits before they are fused, while training: above 1, pixels that are surely wrong can learn."""


@dataclass(frozen=True)
class TaughtMapping(MapConfig):
    """How a sequence is mapped by the network that is trained."""

    labeller: LabellerName = "deeplab"
    """Only deeplab means something here."""
    grid: GridOptions = field(default_factory=lambda: GridOptions(voxel_size_m=(0.1, 0.1, 0.2)))


@dataclass(frozen=True)
class TrainConfig(TrainingOptions):
    """Everything that decides what a training run comes out as."""

    supervision: Literal["pixels", "map"] = "pixels"
    """What teaches: masks of images, or an orthomosaic that the map of a sequence is compared with."""
    ground_truth: Path | None = None
    """The labelled orthomosaic, with map supervision."""
    classes: tuple[str, ...] = ("background", "sand", "rock")
    """The classes, in the order of the labels."""
    data: DataConfig = field(default_factory=DataConfig)
    network: NetworkOptions = field(default_factory=NetworkOptions)
    map_truth: MapTruthConfig = field(default_factory=MapTruthConfig)
    mapping: TaughtMapping = field(default_factory=TaughtMapping)
    """How the sequence is read and mapped, with map supervision: as the settings of jaxmap map."""


_OTHERWISE = {"--remap": "--map-truth.remap", "--truth-crs": "--map-truth.crs", "--classes": "--classes"}


def option_here(option: str) -> str:
    """What `jaxmap train` calls an option of `jaxmap map` or `jaxmap evaluate`; others as they are."""
    name = option.removeprefix("--").partition(".")[0].replace("-", "_")
    own = f"--mapping.{option.removeprefix('--')}" if name in MapConfig.__dataclass_fields__ else option
    return _OTHERWISE.get(option, own)


_SETTINGS = Settings(TrainConfig, "train", folder="train", given=("training_data", "init"))


def load_train_config(name_or_path: str) -> TrainConfig:
    """Reads a configuration: a YAML file, or the name of one in `configs/train`.

    Raises:
        UsageError: no such file, not YAML, an unknown key, or a value out of range.
    """
    return _SETTINGS.load(name_or_path)


def check_train_config(tree: dict[str, Any], where: object = "the command line") -> TrainConfig:
    """Builds a configuration from plain values, strictly.

    Raises:
        UsageError: names every unknown key and every value out of range.
    """
    return _SETTINGS.check(tree, where)


def train_config_tree(config: TrainConfig) -> dict[str, Any]:
    """A configuration as plain values, for YAML and JSON."""
    return _SETTINGS.tree(config)


class Validates(Protocol):
    """Says how good weights are."""

    def score(self, weights: Weights) -> Validation:
        """Scores weights, running statistics included."""
        ...


class TrainingData(Protocol):
    """What a run learns from and is validated on: images with masks, or the frames of a map."""

    @property
    def source(self) -> str:
        """The folder or sequence, for config.yaml."""
        ...

    @property
    def title(self) -> str:
        """A heading."""
        ...

    @property
    def names(self) -> Sequence[str]:
        """Of the examples that are learnt from."""
        ...

    def batches(self, order: Order, first_step: int) -> Iterator[Any]:
        """The batches of a run from a step on."""
        ...

    def validator(self, architecture: Architecture) -> Validates | None:
        """What validates; None where nothing does."""
        ...

    def digest(self) -> str:
        """A fingerprint of what a resumed run must share beside its settings."""
        ...

    def counts(self) -> dict[str, Any]:
        """What metrics.json tells of the data."""
        ...

    def facts(self) -> dict[str, str]:
        """What the page tells of the data."""
        ...


class TrainingPlan(NamedTuple):
    """A run, decided in full.

    Attributes:
        config: its settings.
        data: what it learns from.
        start: the network and its first weights.
        init: the file that training starts from, or None.
        order: which example is seen when.
        trainer: the compiled step.
    """

    config: TrainConfig
    data: TrainingData
    start: Start
    init: Path | None
    order: Order
    trainer: Trainer | MapTrainer


@dataclass(frozen=True)
class ImageData:
    """Images with masks, as `TrainingData`.

    Attributes:
        training_set: the images.
        class_pixels: pixels of each class, in training (row 0) and validation (row 1).
        pixels: reads them.
    """

    training_set: TrainingSet
    class_pixels: np.ndarray
    pixels: Pixels

    @property
    def source(self) -> str:
        """The folder."""
        return str(self.training_set.folder.resolve())

    @property
    def title(self) -> str:
        """The folder's name."""
        return self.training_set.folder.resolve().name

    @property
    def names(self) -> tuple[str, ...]:
        """Of the training images."""
        return tuple(example.name for example in self.training_set.train)

    def batches(self, order: Order, first_step: int) -> Iterator[Batch]:
        """The batches of a run from a step on."""
        return batches_from(self.pixels, order, first_step)

    def validator(self, architecture: Architecture) -> Validator | None:
        """Scores the pixels of the validation images; None where there are none."""
        validation = self.training_set.validation
        return Validator(architecture, validation, self.training_set.lookup) if validation else None

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
        """Numbers of images."""
        return {
            "Training images": str(len(self.training_set.train)),
            "Validation images": str(len(self.training_set.validation)),
        }


def plan_training(
    folder: Path,
    config: TrainConfig,
    init: Path | None,
    *,
    notify: Callable[[str], None],
    advance: Callable[[int], None] = lambda done: None,
) -> TrainingPlan:
    """Reads all the data once, and builds network and step.

    Args:
        folder: of the training data.
        config: the settings.
        init: a model file to start from.
        notify: takes lines for the user.
        advance: is called with the number of images read so far.

    Raises:
        JaxmapError: data, settings and file do not serve.
    """
    check_scale(config)
    losses = config.loss
    if not (losses.cross_entropy or losses.soft_iou or losses.lovasz):
        raise UsageError("every loss has a weight of 0", where="loss", fix="give one of them a weight")
    devices = jax.local_device_count()
    if config.batch_size % devices:
        raise UsageError(
            f"batch_size {config.batch_size} cannot be shared by {devices} devices",
            fix=f"take a multiple of {devices}",
        )
    training_set = open_training_set(
        folder,
        config.classes,
        remap=config.data.remap,  # type: ignore[arg-type]
        palette=config.data.palette,  # type: ignore[arg-type]
        validation_share=config.data.validation_share,
        seed=config.seed,
    )
    for note in training_set.notes:
        notify(f"note: {note}")
    counts = check_training_set(training_set, advance)
    notify(
        f"{len(training_set.train)} images to train on, {len(training_set.validation)} to validate; training pixels: "
        + ", ".join(
            f"{name} {share:.1%}" for name, share in zip(config.classes, counts[0] / counts[0].sum(), strict=True)
        )
    )
    saved = None if init is None else load_model(init)
    start = make_start(config.network, config.norm, config.classes, saved, seed=config.seed, where=init or "network")
    order = Order.of(len(training_set.train), config)
    notify(describe_start(start))
    trainer = make_trainer(
        start.architecture,
        config,
        steps=order.steps,
        class_weights=jnp.asarray(class_weights(config.loss, counts[0])),
        batch_norms=start.batch_norms,
    )
    data = ImageData(training_set, counts, Pixels(training_set.train, training_set.lookup))
    return TrainingPlan(config, data, start, init, order, trainer)


def check_scale(config: TrainConfig) -> None:
    """Refuses crops of no scale.

    Raises:
        UsageError: the least factor is above the greatest.
    """
    low, high = config.augmentation.scale
    if low > high:
        raise UsageError(f"augmentation.scale is {low} {high}", fix="give the least factor first")


def describe_start(start: Start) -> str:
    """One line on the network and its first weights."""
    record, numbers = start.architecture, sum(jnp.size(weight) for weight in start.weights.values())
    return (
        f"DeepLabv3{'+' * record.decoder} on {record.backbone}, {numbers / 1e6:.1f} million numbers, "
        f"output stride {record.output_stride}; fresh: {', '.join(start.fresh) or 'nothing'}; "
        f"batch norm learns in: {', '.join(start.batch_norms) or 'nothing'}"
    )
