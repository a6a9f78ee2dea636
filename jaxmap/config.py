"""The settings of a mapping run: frozen dataclasses, read strictly from YAML and the command line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Interval, Lt
from pydantic import ConfigDict, TypeAdapter, ValidationError

from jaxmap.errors import UsageError
from jaxmap.files import config_folder
from jaxmap.stereo.options import StereoOptions

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)

Triple = tuple[float, float, float]
Probability = Annotated[float, Interval(gt=0, lt=1)]
Positive = Annotated[float, Gt(0)]


@dataclass(frozen=True)
class GridConfig:
    """Bounds and resolution of the map."""

    __pydantic_config__ = _STRICT

    voxel_size_m: Positive | tuple[Positive, Positive, Positive] = 0.1
    """Edge of a voxel, or three edges (x, y, z)."""
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


@dataclass(frozen=True)
class MapConfig:
    """Everything that decides what a map comes out as."""

    __pydantic_config__ = _STRICT

    dataset: str = "auto"
    """The reader: auto, kitti, euroc, folder or katwijk."""
    labeller: Literal["plane", "files", "none"] = "plane"
    """What labels the points: the MLESAC plane, files of labels, or nothing."""
    labels: Path | None = None
    """Folder of labels, with the files labeller: NAME.png class indices or NAME.npy probabilities."""
    labels_are: Literal["auto", "raw", "rectified"] = "auto"
    """On which pixels those labels lie; it must be said where the images are raw and jaxmap rectifies them."""
    classes: tuple[str, ...] = ("background", "sand", "rock")
    """The classes, in the order of the label indices."""
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


_ADAPTER = TypeAdapter(MapConfig)


def load_config(name_or_path: str) -> MapConfig:
    """Reads a configuration: a YAML file, or the name of one that comes with jaxmap.

    Raises:
        UsageError: no such file, not YAML, an unknown key, or a value out of range.
    """
    import yaml

    path = Path(name_or_path)
    if not path.exists():
        path = config_folder() / (name_or_path if name_or_path.endswith(".yaml") else f"{name_or_path}.yaml")
    if not path.is_file():
        known = ", ".join(sorted(file.stem for file in config_folder().glob("*.yaml")))
        raise UsageError(f"no config {name_or_path!r}", fix=f"give a YAML file or one of: {known}")
    try:
        tree = yaml.safe_load(path.read_text(encoding="utf8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UsageError(f"not YAML: {error}", where=path, fix="correct the file") from error
    except OSError as error:
        raise UsageError(f"cannot be read: {error.strerror}", where=path) from error
    if not isinstance(tree or {}, dict):
        raise UsageError(f"holds a {type(tree).__name__}, not keys and values", where=path, fix="write key: value")
    # The resolved configuration of a run names its sequence; the command line does so here.
    return check_config({key: value for key, value in (tree or {}).items() if key != "sequence"}, where=path)


def check_config(tree: dict[str, Any], where: object = "the command line") -> MapConfig:
    """Builds a configuration from plain values, strictly.

    Raises:
        UsageError: names every unknown key and every value out of range.
    """
    try:
        config = _ADAPTER.validate_python(tree)
    except ValidationError as error:
        raise UsageError("; ".join(_complaints(error)), where=where, fix="see jaxmap map --help") from error
    return config


def config_tree(config: MapConfig) -> dict[str, Any]:
    """A configuration as plain values, for YAML and JSON."""
    return _ADAPTER.dump_python(config, mode="json")


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


def _complaints(error: ValidationError) -> list[str]:
    """One clause for each fault, by its dotted key."""
    clauses: dict[str, str] = {}
    for fault in error.errors():
        # Branches of a union appear in the location; they are not part of the key.
        key = ".".join(str(part) for part in fault["loc"] if isinstance(part, int) or part.isidentifier())
        if fault["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
            clauses[key] = f"unknown key {key}"
        else:
            value = repr(fault["input"])
            clauses.setdefault(key, f"{key} is {value[:60]}: {fault['msg'][0].lower()}{fault['msg'][1:]}")
    return list(clauses.values())
