"""The settings of a mapping run; the options of each part stand beside its code."""

from __future__ import annotations

from dataclasses import field, fields
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
class PerceiveConfig(ReadOptions):
    """How the frames of a sequence are read, matched and labelled: all that does not concern the map."""

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
    """Stop where the quick check of the sequence finds something that makes the map wrong, and at the first unusable
    frame, instead of going on with a note."""
    stereo: StereoOptions = field(default_factory=StereoOptions)
    plane: PlaneOptions = field(default_factory=PlaneOptions)
    relief: ReliefOptions = field(default_factory=ReliefOptions)
    deeplab: DeeplabOptions = field(default_factory=DeeplabOptions)

    @classmethod
    def of(cls, config: PerceiveConfig) -> PerceiveConfig:
        """Those settings of a map."""
        return PerceiveConfig(**{one.name: getattr(config, one.name) for one in fields(PerceiveConfig)})


@options("")
class MapConfig(PerceiveConfig):
    """Everything that decides what a map comes out as."""

    seed: Annotated[int, Seed] = 0
    """Seed of all randomness."""
    rover: str = "katwijk"
    """YAML file of the rover whose hazards are layers of the map, or the name of one in configs/rovers (katwijk)."""
    grid: GridOptions = field(default_factory=GridOptions)
    depth: DepthOptions = field(default_factory=DepthOptions)
    fusion: FusionOptions = field(default_factory=FusionOptions)
    ensemble: EnsembleOptions = field(default_factory=EnsembleOptions)


@options("")
class CheckConfig(ReadOptions):
    """What decides how a sequence is read and matched."""

    stereo: StereoOptions = field(default_factory=StereoOptions)

    @classmethod
    def of(cls, config: MapConfig) -> CheckConfig:
        """Those settings of a map."""
        return cls(**{one.name: getattr(config, one.name) for one in fields(cls)})


_SETTINGS = Settings(MapConfig, "map", given=("sequence", "keep_observations"))
_PERCEPTION = Settings(PerceiveConfig, "perceive", given=("sequence",))


def load_config(name_or_path: str) -> MapConfig:
    """Reads a configuration: a YAML file, or the name of one that comes with jaxmap.

    Raises:
        UsageError: no such file, not YAML, an unknown key, or a value out of range.
    """
    return _SETTINGS.load(name_or_path)


def load_perception(name_or_path: str) -> PerceiveConfig:
    """Reads a configuration of perception, or of a map, of which the rest is left aside.

    Raises:
        UsageError: as `load_config`.
    """
    return PerceiveConfig.of(load_config(name_or_path))


OBSERVATIONS = "observations.zarr"
"""The folder of observations within that of a run of `jaxmap perceive`, or of `jaxmap map --keep-observations`."""

_OF_POSES = (
    *("poses", "poses_world", "poses_up", "pose_convention", "poses_are", "quaternion"),
    *("poses_time_unit", "poses_unit"),
)
CHOSEN_ANEW = (*_OF_POSES, "max_pose_gap_s", "start", "stop", "stride", "strict")
"""Settings that begin anew where observations are fused: their own poses, and all of their frames."""


def observations_in(source: str | Path) -> Path | None:
    """The observations that a folder is, or holds; None where it is something else."""
    path = Path(source)
    return next((one for one in (path, path / OBSERVATIONS) if one.name == OBSERVATIONS and one.is_dir()), None)


def config_of_observations(observations: Path, name_or_path: str | None) -> MapConfig:
    """The settings of a map of observations: those that perceived them, and over them those of a configuration.

    Args:
        observations: the group.
        name_or_path: as of `load_config`; None for the defaults.

    Raises:
        JaxmapError: the observations cannot be read.
        UsageError: as `load_config`.
    """
    from jaxmap.mapping.observations import read_attributes

    perceived = read_attributes(observations).settings
    given, where = ({}, observations) if name_or_path is None else _SETTINGS.read(name_or_path)
    known = {name: value for name, value in perceived.items() if name not in CHOSEN_ANEW}
    return _SETTINGS.check(_over(known, given), where)


def absolute_tree(config: PerceiveConfig) -> dict[str, Any]:
    """A configuration as plain values that mean the same in every folder: for workers."""
    tree = config_tree(config)
    for name in ("poses", "calibration", "model", "labels", "rover"):
        if tree.get(name) is not None and Path(tree[name]).exists():
            tree[name] = str(Path(tree[name]).absolute())
    network = tree["stereo"].get("cost_network")
    if network is not None and Path(network).exists():
        tree["stereo"] = tree["stereo"] | {"cost_network": str(Path(network).absolute())}
    return tree


def _over(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Two trees of settings as one."""
    merged = dict(below)
    for key, value in above.items():
        under = below.get(key)
        merged[key] = _over(under, value) if isinstance(under, dict) and isinstance(value, dict) else value
    return merged


def check_config(tree: dict[str, Any], where: object = "the command line") -> MapConfig:
    """Builds a configuration from plain values, strictly.

    Raises:
        UsageError: names every unknown key and every value out of range.
    """
    return _SETTINGS.check(tree, where)


def check_perception(tree: dict[str, Any], where: object) -> PerceiveConfig:
    """Builds a configuration of perception from plain values, strictly.

    Raises:
        UsageError: names every unknown key and every value out of range.
    """
    return _PERCEPTION.check(tree, where)


def config_tree(config: PerceiveConfig) -> dict[str, Any]:
    """A configuration as plain values, for YAML and JSON."""
    return _SETTINGS.tree(config) if isinstance(config, MapConfig) else _PERCEPTION.tree(config)
