"""The settings of a training run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Gt, Interval
from pydantic import BeforeValidator

from jaxmap.config import GridConfig, LabellerName, MapConfig
from jaxmap.settings import Settings
from jaxmap.training.options import NetworkOptions, TrainingOptions

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
    grid: GridConfig = field(default_factory=lambda: GridConfig(voxel_size_m=(0.1, 0.1, 0.2)))


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
