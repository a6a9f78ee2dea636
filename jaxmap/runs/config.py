"""The settings of a mapping run: frozen dataclasses, read strictly from YAML and the command line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from annotated_types import Ge, Gt, Interval, Lt
from pydantic import ConfigDict

from jaxmap.ensemble.options import EnsembleOptions
from jaxmap.errors import UsageError
from jaxmap.host.settings import Settings
from jaxmap.stereo.match import StereoOptions

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)

Triple = tuple[float, float, float]
Probability = Annotated[float, Interval(gt=0, lt=1)]
Positive = Annotated[float, Gt(0)]
LabellerName = Literal["plane", "deeplab", "files", "none"]


@dataclass(frozen=True)
class GridConfig:
    """Bounds and resolution of the map."""

    __pydantic_config__ = _STRICT

    voxel_size_m: Positive | tuple[Positive, Positive, Positive] | None = None
    """Edge of a voxel, or three edges (x, y, z). By default 0.05 0.05 0.2: columns finer than the cells that maps are
    scored in, so that rocks are measured by area; or the next of 0.1 0.1 0.2 and 0.2 whose map fits the memory."""
    lower_m: Triple | None = None
    """Lower corner of the map, relative to the site origin; by default the poses and the range decide."""
    upper_m: Triple | None = None
    """Upper corner, with the lower one."""
    below_camera_m: Positive = 3.0
    """How far automatic bounds reach below the lowest camera."""
    above_camera_m: Positive = 2.0
    """How far automatic bounds reach above the highest camera."""
    max_memory_gib: Positive = 2.0
    """Larger maps are refused."""


@dataclass(frozen=True)
class DepthConfig:
    """Which depths are mapped."""

    __pydantic_config__ = _STRICT

    min_m: Annotated[float, Ge(0)] = 0.3
    """Nearer points are left out."""
    max_m: Positive | None = None
    """Farther points are left out; by default where depth noise reaches max_sigma_m."""
    max_sigma_m: Positive = 0.5
    """Depth noise that sets the automatic range."""


@dataclass(frozen=True)
class FusionConfig:
    """The sensor model, the filter and the decision."""

    __pydantic_config__ = _STRICT

    per_frame: Literal["sum", "once", "mean"] = "mean"
    """How the points of a frame in a voxel count: all, each label once, or by their mean."""
    carve: bool = True
    """Mark voxels that were seen through as free."""
    range_weighting: bool = True
    """Let points count less as depth noise outgrows the voxel."""
    column: Literal["max", "sum"] = "sum"
    """Top-down map: the greatest evidence in a column, or the sum of it."""
    priority_classes: tuple[str, ...] | None = None
    """Classes that win a cell as soon as they pass class_threshold; by default rock, if it is a class."""
    occupancy_hit: Annotated[float, Ge(0)] = 0.85
    """Log-odds that a frame with points in a voxel adds to its occupancy."""
    occupancy_miss: Annotated[float, Interval(le=0)] = -0.4
    """Log-odds added to the occupancy of a voxel that was seen through."""
    occupancy_prior: Probability = 0.5
    """Probability that a voxel is occupied before anything was seen."""
    class_hit: float = 0.9
    """Log-odds that an observed label adds to its class."""
    class_miss: float = -0.9
    """Log-odds that an observed label adds to every other class."""
    class_increments: tuple[tuple[float, ...], ...] | None = None
    """The whole matrix, row: observed label, column: class; overrides class_hit and class_miss."""
    class_prior: Probability | tuple[Probability, ...] = 0.5
    """Probability of a class before anything was seen; one number, or one per class."""
    disparity_sigma_px: Positive = 0.5
    """Standard deviation of disparity."""
    full_evidence_points: Positive = 8.0
    """Points from which on a frame counts in full (per_frame mean)."""
    occupancy_threshold: Probability = 0.5
    """A voxel is occupied above this probability."""
    class_threshold: Probability = 0.5
    """A priority class wins above this probability."""
    class_kernel: tuple[tuple[tuple[float, ...], ...], ...] | None = None
    """One odd square a class: how much of the evidence of neighbouring columns counts when the map is read; tune
    --kernel learns it."""


DEFAULT_PRIORITY = ("rock",)
"""Classes that take a cell before others do, where nothing else is said."""

RULE_FIELDS = ("per_frame", "carve", "range_weighting", "column", "priority_classes")
"""The fields of `FusionConfig` that make a `FusionRule`; the others make `FusionParams`."""


@dataclass(frozen=True)
class PlaneConfig:
    """The MLESAC plane and the labels it gives."""

    __pydantic_config__ = _STRICT

    threshold_m: Positive = 0.1
    """Points farther from the plane are rock."""
    softness_m: Annotated[float, Ge(0)] = 0.0
    """Width of the passage from sand to rock around the threshold; at 0 it is sharp."""
    max_height_m: Positive = 2.0
    """Points farther still are left out."""
    on_plane: str = "sand"
    """Class of the points on the plane."""
    off_plane: str = "rock"
    """Class of the points off the plane."""
    sigma_m: Positive = 0.05
    """Standard deviation of points on the plane."""
    outlier_range_m: Positive = 4.0
    """Range over which points off the plane spread."""
    max_tilt_rad: Annotated[float, Interval(gt=0, le=1.5708)] = 0.6
    """Planes that lean further are walls."""
    hypotheses: Annotated[int, Gt(0)] = 256
    """Planes tried."""
    sample_points: Annotated[int, Ge(3)] = 8192
    """Points drawn to judge them."""
    em_rounds: Annotated[int, Gt(0)] = 3
    """Rounds of expectation maximisation."""
    cost: Literal["mlesac", "msac"] = "mlesac"
    """The score of a plane."""


def _renaming_from_words(words: list[str]) -> dict[str, str]:
    pairs = [word.partition("=") for word in words]
    if not all(name and equals and new_name for name, equals, new_name in pairs):
        raise ValueError("give pairs such as bus=car")
    return {name: new_name for name, _, new_name in pairs}


_RENAMING_OPTION = tyro.constructors.PrimitiveConstructorSpec(
    nargs="*",
    metavar="NETWORK=MAP",
    instance_from_str=_renaming_from_words,
    is_instance=lambda value: isinstance(value, dict),
    str_from_instance=lambda renaming: [f"{name}={new_name}" for name, new_name in renaming.items()],
)
"""A dict of names on the command line; by itself tyro would make an option of each key."""


@dataclass(frozen=True)
class DeeplabConfig:
    """The network as a labeller."""

    __pydantic_config__ = _STRICT

    class_map: Annotated[dict[str, str], _RENAMING_OPTION] = field(default_factory=dict)
    """Classes of the network under the names of the map's, where they differ; several may become one."""
    size_px: tuple[Annotated[int, Gt(0)], Annotated[int, Gt(0)]] | None = None
    """Height and width that the network runs at; those of the images without it."""
    soft: bool = True
    """Fuse the probabilities of all classes, not only the likeliest class."""
    temperature: Positive = 1.0
    """Divides the logits: above 1 the probabilities are softer."""


@dataclass(frozen=True)
class MapConfig:
    """Everything that decides what a map comes out as."""

    __pydantic_config__ = _STRICT

    dataset: str = "auto"
    """The reader: auto, kitti, euroc, folder or katwijk."""
    labeller: LabellerName = "plane"
    """What labels the points: the MLESAC plane, a network, files of labels, or nothing."""
    model: Path | None = None
    """Model file of the network, with the deeplab labeller (train and weights import write them); by default the
    bundled one, for rovers on sand."""
    model_sha256: str | None = None
    """SHA-256 that the model file must have; the config.yaml of a run tells it."""
    labels: Path | None = None
    """Folder of labels, with the files labeller: NAME.png class indices or NAME.npy probabilities."""
    labels_are: Literal["auto", "raw", "rectified"] = "auto"
    """On which pixels those labels lie; it must be said where the images are raw and jaxmap rectifies them."""
    classes: tuple[str, ...] | None = None
    """The classes of the map, in the order of the label indices: by default background sand rock; with deeplab
    the names that deeplab.class_map gives or, without any, all classes of the network. Points of its other
    classes are mapped without a class. Each class takes as much memory as the occupancy."""
    poses: Path | None = None
    """Pose file in place of the sequence's own: TUM, KITTI or EuRoC text."""
    poses_world: Literal["auto", "z_up", "camera"] = "auto"
    """World of the poses: z up, camera-like (y down), or find out."""
    calibration: Path | None = None
    """Camera file in place of the sequence's own."""
    camera: str | None = None
    """Which stereo camera, where there are several; Katwijk: loccam (the default) or pancam."""
    antenna_m: Triple | None = None
    """Katwijk: the GPS antenna in the IMU frame (x backward, y right, z up), by default 0.221 -0.052 1.5785."""
    crs: str | None = None
    """Coordinate reference system of the poses, such as EPSG:32631; it goes into the map and the GeoTIFF."""
    max_pose_gap_s: Positive = 1.0
    """Poses farther apart are not bridged."""
    start: int = 0
    """First frame."""
    stop: int | None = None
    """Frame to stop before, from the end if negative; by default the end."""
    stride: Annotated[int, Gt(0)] = 1
    """Take every so many frames."""
    strict: bool = False
    """Stop at the first unusable frame instead of going on without it."""
    seed: Annotated[int, Ge(0), Lt(2**31)] = 0
    """Seed of all randomness."""
    grid: GridConfig = field(default_factory=GridConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    stereo: StereoOptions = field(default_factory=StereoOptions)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    plane: PlaneConfig = field(default_factory=PlaneConfig)
    deeplab: DeeplabConfig = field(default_factory=DeeplabConfig)
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


def split_fusion(fusion: FusionConfig, classes: Sequence[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The keyword arguments of `make_fusion_params` and those of `FusionRule`, for a map of these classes.

    Raises:
        UsageError: a priority class is none of the classes.
    """
    tree = asdict(fusion)
    rule = {name: tree.pop(name) for name in RULE_FIELDS}
    if fusion.priority_classes is None or not classes:
        rule["priority_classes"] = tuple(name for name in DEFAULT_PRIORITY if name in classes)
    elif unknown := [name for name in fusion.priority_classes if name not in classes]:
        raise UsageError(
            f"{', '.join(unknown)} is not one of the classes {' '.join(classes)}",
            where="fusion.priority_classes",
            fix="name classes of the map, or none",
        )
    return tree, rule
