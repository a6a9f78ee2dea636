"""The settings of a mapping run; the options of each part stand beside its code."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Literal

from jaxmap.datasets.options import ReadOptions
from jaxmap.ensemble.options import EnsembleOptions
from jaxmap.fusion.options import FusionOptions
from jaxmap.geometry.options import DepthOptions, GridOptions
from jaxmap.host.settings import Seed, Settings, options
from jaxmap.labellers.options import DeeplabOptions, PlaneOptions, ReliefOptions
from jaxmap.stereo.match import StereoOptions

LabellerName = Literal["plane", "relief", "deeplab", "files", "none"]


@options("")
class MapConfig(ReadOptions):
    """Everything that decides what a map comes out as."""

    labeller: LabellerName = "deeplab"
    """What labels the points: a network (with relief beside it), relief above the local ground alone, the MLESAC plane,
    files, or nothing."""
    model: Path | None = None
    """Model file of the network, with the deeplab labeller (train and weights import write them); by default the
    bundled one, for rovers on sand."""
    model_sha256: str | None = None
    """SHA-256 that the model file must have; the config.yaml of a run records it."""
    labels: Path | None = None
    """Folder of labels, with the files labeller: NAME.png class indices or NAME.npy probabilities."""
    labels_are: Literal["auto", "raw", "rectified"] = "auto"
    """On which pixels those labels lie; it must be said where the images are raw and jaxmap rectifies them."""
    classes: tuple[str, ...] | None = None
    """The classes of the map, in the order of the label indices: by default background sand rock; with deeplab
    the names that deeplab.class_map gives or, without any, all classes of the network. Points of its other
    classes are mapped without a class. Each class takes as much memory as the occupancy."""
    strict: bool = False
    """Stop at the first unusable frame instead of going on without it."""
    seed: Annotated[int, Seed] = 0
    """Seed of all randomness."""
    grid: GridOptions = field(default_factory=GridOptions)
    depth: DepthOptions = field(default_factory=DepthOptions)
    stereo: StereoOptions = field(default_factory=StereoOptions)
    fusion: FusionOptions = field(default_factory=FusionOptions)
    plane: PlaneOptions = field(default_factory=PlaneOptions)
    relief: ReliefOptions = field(default_factory=ReliefOptions)
    deeplab: DeeplabOptions = field(default_factory=DeeplabOptions)
    ensemble: EnsembleOptions = field(default_factory=EnsembleOptions)


_SETTINGS = Settings(MapConfig, "map", given=("sequence",))


def load_config(name_or_path: str) -> MapConfig:
    """Reads a configuration: a YAML file, or the name of one that comes with jaxmap.

    Raises:
        UsageError: no such file, not YAML, an unknown key, or a value out of range.
    """
    return _SETTINGS.load(name_or_path)


def check_config(tree: dict[str, Any], where: object = "the command line") -> MapConfig:
    """Builds a configuration from plain values, strictly.

    Raises:
        UsageError: names every unknown key and every value out of range.
    """
    return _SETTINGS.check(tree, where)


def config_tree(config: MapConfig) -> dict[str, Any]:
    """A configuration as plain values, for YAML and JSON."""
    return _SETTINGS.tree(config)
