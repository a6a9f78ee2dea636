"""A mapping run, planned in full before the first frame: sequence, range, bounds, labeller and step."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from jaxmap.checks.check import open_front_end
from jaxmap.checks.finding import Finding
from jaxmap.datasets import StereoSequence, open_sequence
from jaxmap.datasets.base import OnFrame
from jaxmap.datasets.label_files import LabelFolder, open_label_folder
from jaxmap.datasets.registry import SAMPLE_PREFIX
from jaxmap.ensemble.draws import draw_ensemble
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import fusion_attribute, make_fusion_params
from jaxmap.geometry.bounds import check_memory, grid_around_views, map_bytes, site_lattice, usable_depth
from jaxmap.geometry.grid import window_shape
from jaxmap.geometry.options import GridOptions, Triple
from jaxmap.host.files import bundled, real_path
from jaxmap.labellers.base import Labeller, make_no_labeller
from jaxmap.labellers.deeplab import make_deeplab_labeller
from jaxmap.labellers.files import make_files_labeller
from jaxmap.labellers.plane import make_plane_labeller
from jaxmap.labellers.relief import combine_with_relief, make_relief_labeller
from jaxmap.labels import ROVER_CLASSES
from jaxmap.mapping.sequence import frame_form
from jaxmap.mapping.step import Mapper, MapperParams, make_mapper
from jaxmap.mapping.tiles import block_shape, whole_tiles
from jaxmap.models.checkpoint import SavedModel, load_network
from jaxmap.models.tensor_files import shortened
from jaxmap.runs.checking import warn_of_faults
from jaxmap.runs.config import MapConfig, config_tree
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.rectify import StereoRig
from jaxmap.types import MAX_TENSOR_ELEMENTS, Frame, GridSpec, StereoCamera, make_grid

BUNDLED_WIDTH_PX = 512
"""Width that the bundled network runs at: at twice that it takes four times as long for a hundredth of IoU."""

DEFAULT_VOXEL_M: Triple = (0.05, 0.05, 0.2)
"""The voxels of a map whose settings name none."""


def choose_grid(
    settings: GridOptions, sequence: StereoSequence, front_end: StereoFrontEnd, max_depth_m: float
) -> GridSpec:
    """The grid that the settings ask for, on the lattice of the site.

    Args:
        settings: the bounds and the voxels.
        sequence: whose views it must hold.
        front_end: of the sequence.
        max_depth_m: how far its views reach.

    Raises:
        JaxmapError: the bounds do not make a box, or no camera sees it.
    """
    voxel_size_m = settings.voxel_size_m or DEFAULT_VOXEL_M
    lattice_m = site_lattice(sequence.site_origin, voxel_size_m)
    views = grid_around_views(
        front_end.camera,
        sequence.T_world_camera @ front_end.T_raw_rectified,
        max_depth_m,
        voxel_size_m,
        (settings.below_camera_m, settings.above_camera_m),
        lattice_m,
    )
    if (settings.lower_m is None) != (settings.upper_m is None):
        raise UsageError("one of grid.lower_m and grid.upper_m is missing", fix="give both, or neither")
    if settings.lower_m is None or settings.upper_m is None:
        return views
    grid = make_grid(settings.lower_m, settings.upper_m, voxel_size_m, lattice_m)
    lower, upper = _extent(views)
    if (np.array(settings.lower_m) >= upper).any() or (np.array(settings.upper_m) <= lower).any():
        raise UsageError(
            f"no camera sees the box from {list(settings.lower_m)} to {list(settings.upper_m)}: "
            f"the views reach from {lower.round(1).tolist()} to {upper.round(1).tolist()}",
            where="grid bounds",
            fix="give bounds relative to the site origin",
        )
    return grid


def _extent(grid: GridSpec) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of a grid, float64."""
    lower = np.asarray(grid.origin_m, np.float64)
    return lower, lower + np.asarray(grid.voxel_size_m, np.float64) * grid.shape


def describe_grid(
    grid: GridSpec,
    depth_range_m: tuple[float, float],
    class_count: int,
    members: int,
    block: tuple[int, int, int] | None = None,
) -> str:
    """One line on what is mapped, and the memory it takes."""
    taken = f"{map_bytes(grid if block is None else replace(grid, shape=block), class_count, members) / 2**20:.0f} MiB"
    if block is not None:
        taken = f"in tiles on disk, {' x '.join(map(str, block))} voxels around the rover in memory, {taken}"
    size = " x ".join(f"{edge:g}" for edge in np.asarray(grid.voxel_size_m, np.float64).round(6))
    return (
        f"depth {depth_range_m[0]:g} to {depth_range_m[1]:g} m; grid {' x '.join(map(str, grid.shape))} voxels of "
        f"{size} m, {1 + class_count} channels{f' and {members} members of 2' if members else ''}: "
        f"{taken}"
    )


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
        if isinstance(sequence.camera, StereoRig) or sequence.rectify_labels is not None:
            raise UsageError(
                "the images are raw, and labels may lie on raw or on rectified pixels",
                fix="say which: --labels-are raw (your network saw the camera's images) or rectified",
            )
        labels_are = "rectified"
    folder = open_label_folder(config.labels, len(config.classes or ROVER_CLASSES), labels_are, sequence.frames[0].name)
    return replace(folder, rectify=sequence.rectify_labels)


def choose_model(config: MapConfig) -> tuple[ModelFile | None, SavedModel | None]:
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


def describe_network(model: ModelFile, network: SavedModel, classes: Sequence[str]) -> str:
    """One line on the network and its classes."""
    count = len(network.architecture.classes)
    return (
        f"labels by {model.path.name} ({network.architecture.backbone}, {count} classes), "
        f"mapped as {shortened(classes)}; the settings classes and deeplab.class_map choose"
    )


def choose_labeller(
    config: MapConfig, label_folder: LabelFolder | None, network: SavedModel | None, camera: StereoCamera
) -> Labeller:
    """What labels the points.

    Args:
        config: the settings.
        label_folder: of the files labeller.
        network: of the deeplab labeller.
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
        deeplab, shrink = config.deeplab, BUNDLED_WIDTH_PX / camera.width_px
        if config.model is None and deeplab.size_px is None and shrink < 1:
            deeplab = replace(deeplab, size_px=(round(shrink * camera.height_px), BUNDLED_WIDTH_PX))
        labeller = make_deeplab_labeller(network, classes, deeplab)
        known = {config.relief.ground, config.relief.rock} <= set(labeller.classes)
        return _with_relief(labeller, config, by_default=known)
    classes = ROVER_CLASSES if classes is None else classes
    if label_folder is not None:
        return _with_relief(make_files_labeller(classes, soft=label_folder.soft), config, by_default=False)
    if config.labeller == "relief":
        return make_relief_labeller(classes, config.relief)
    if config.labeller == "plane":
        return make_plane_labeller(classes, config.plane)
    return make_no_labeller()


def _with_relief(labeller: Labeller, config: MapConfig, *, by_default: bool) -> Labeller:
    combine = by_default if config.relief.combine is None else config.relief.combine
    return combine_with_relief(labeller, config.relief) if combine else labeller


Notify = Callable[[str], None]

_KEY_FRAMES = 4


@dataclass(frozen=True)
class Plan:
    """A run, decided in full before the first frame is fused."""

    source: str
    sequence: StereoSequence
    front_end: StereoFrontEnd
    labeller: Labeller
    label_folder: LabelFolder | None
    model: ModelFile | None
    grid: GridSpec
    depth_range_m: tuple[float, float]
    rule: FusionRule
    params: MapperParams
    fusion: dict[str, Any]
    mapper: Mapper
    key: PRNGKeyArray
    pose_errors: Float[np.ndarray, "N M 6"] | None = None
    """Of the members of an ensemble, for each frame."""
    block_shape: tuple[int, int, int] | None = None
    """Of a map that is larger than the memory it may take: voxels along each axis of the part that is in memory."""
    findings: tuple[Finding, ...] = ()
    """What the quick check of the sequence has found."""

    @property
    def members(self) -> int:
        """How many members the ensemble has."""
        return 0 if self.pose_errors is None else self.pose_errors.shape[1]

    @property
    def frame_form(self) -> Frame:
        """The form of the frames that the step takes."""
        return frame_form(self.front_end.camera, self.labeller, self.members)

    @property
    def key_frames(self) -> set[int]:
        """Indices of the frames whose pictures are kept."""
        return {int(index) for index in np.linspace(0, len(self.sequence.frames) - 1, _KEY_FRAMES)}

    @property
    def images(self) -> Iterator[Path]:
        """The files of all images."""
        return (image for frame in self.sequence.frames for image in (frame.left, frame.right))

    def settings(self, config: MapConfig) -> dict[str, Any]:
        """The settings as plain values, with the sequence and what was left to the data resolved."""
        classes = {"classes": list(self.labeller.classes)} if self.labeller.classes else {}
        model = {"model_sha256": self.model.sha256} if self.model is not None else {}
        return {"sequence": self.source, **config_tree(config), **classes, **model}

    def digest(self, count: int) -> str:
        """A fingerprint of the first frames, their poses and the camera: what a resumed run must share."""
        frames = self.sequence.frames[:count]
        described = [(frame.name, frame.timestamp_s) for frame in frames]
        camera = [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(self.front_end.camera)]
        if (alignment_rad := self.front_end.alignment_rad) is not None:
            camera.append(alignment_rad.tolist())
        poses = np.ascontiguousarray(self.sequence.T_world_camera[:count])
        return hashlib.sha256(repr((described, camera)).encode() + poses.tobytes()).hexdigest()[:16]


def plan_run(
    source: str,
    config: MapConfig,
    notify: Notify,
    on_frame: OnFrame = lambda done, total: None,
    *,
    in_tiles: bool = False,
) -> Plan:
    """Opens the sequence and decides range, bounds, labeller and step.

    Args:
        source: the folder of one sequence, or `sample:NAME`.
        config: the settings.
        notify: takes lines for the user.
        on_frame: is told of the progress of odometry, where it gives the poses.
        in_tiles: a map that takes more memory than it may is kept in tiles, not refused.

    Raises:
        JaxmapError: the data or the settings do not serve.
    """
    sequence = open_sequence(source, config, on_frame)
    if config.strict and sequence.pose_faults:
        raise JaxmapError(sequence.pose_faults[0], fix="mend the poses, or map without --strict")
    front_end = open_front_end(sequence, config.stereo, notify)
    camera = front_end.camera
    _describe_sequence(sequence, camera, notify)
    findings: tuple[Finding, ...] = ()
    # The bundled samples are as they should be, unless other poses or another camera are put to them.
    if not source.startswith(SAMPLE_PREFIX) or config.poses or config.calibration:
        findings = warn_of_faults(sequence, front_end, strict=config.strict, notify=notify)
    depth_range_m = _depth_range(config, camera)
    label_folder = choose_label_folder(config, sequence)
    model, network = choose_model(config)
    with _as_usage_error():
        labeller = choose_labeller(config, label_folder, network, front_end.camera)
        if model is not None and network is not None:
            notify(describe_network(model, network, labeller.classes))
        grid = choose_grid(config.grid, sequence, front_end, depth_range_m[1])
        rule = config.fusion.rule(labeller.classes)
        fusion_params = make_fusion_params(labeller.classes, config.fusion)
        members = _members(config, rule, labeller.classes)
    # The members of an ensemble stand elsewhere.
    T_known = None if members else sequence.T_world_camera @ front_end.T_raw_rectified
    block = None
    limit_bytes = min(config.grid.max_memory_gib * 2**30, 4 * MAX_TENSOR_ELEMENTS)
    if in_tiles and not members and map_bytes(grid, len(labeller.classes)) > limit_bytes:
        shape = window_shape(grid, camera, depth_range_m[1], T_known)
        block = block_shape(whole_tiles(grid), shape, 1 + len(labeller.classes), limit_bytes)
    if block is None:
        check_memory(grid, len(labeller.classes), config.grid.max_memory_gib, members)
    else:
        grid = whole_tiles(grid)
    notify(describe_grid(grid, depth_range_m, len(labeller.classes), members, block))
    key = jax.random.key(config.seed)
    ensemble, pose_errors = None, None
    if members:
        timestamps_s = np.array([frame.timestamp_s for frame in sequence.frames], np.float64)
        ensemble, pose_errors = draw_ensemble(key, fusion_params, timestamps_s, config.ensemble)

    return Plan(
        source=source if source.startswith(SAMPLE_PREFIX) else str(real_path(source)),
        sequence=sequence,
        front_end=front_end,
        labeller=labeller,
        label_folder=label_folder,
        model=model,
        grid=grid,
        depth_range_m=depth_range_m,
        rule=rule,
        params=MapperParams(camera, fusion_params, labeller.params, ensemble),
        fusion=fusion_attribute(config.fusion, rule) | ({"ensemble": asdict(config.ensemble)} if members else {}),
        mapper=make_mapper(
            camera,
            grid if block is None else replace(grid, shape=block),
            labeller,
            rule,
            depth_range_m,
            members=members,
            T_world_camera=T_known,
        ),
        key=key,
        pose_errors=pose_errors,
        block_shape=block,
        findings=findings,
    )


def _describe_sequence(sequence: StereoSequence, camera: StereoCamera, notify: Notify) -> None:
    """What was opened, what its reader noted, and where its world begins."""
    notify(
        f"{sequence.name} ({sequence.dataset}): {len(sequence.frames)} frames "
        f"of {camera.width_px} x {camera.height_px} px, f {float(camera.fx_px):.2f} px, "
        f"baseline {float(camera.baseline_m):.5f} m"
    )
    for note in sequence.notes:
        notify(f"note: {note}")
    if sequence.site_origin.any():
        origin = " ".join(f"{number:.0f}" for number in sequence.site_origin)
        notify(f"site origin {origin} ({sequence.crs or 'no CRS given: --crs'}); bounds are relative to it")


def _depth_range(config: MapConfig, camera: StereoCamera) -> tuple[float, float]:
    """The depths that are mapped, in metres; without a greatest one, as far as the camera is good for.

    Raises:
        UsageError: there is nothing between them.
    """
    max_depth_m = config.depth.max_m or usable_depth(camera, config.depth.max_sigma_m, config.fusion.disparity_sigma_px)
    if not config.depth.min_m < max_depth_m:
        raise UsageError(
            f"depth.min_m {config.depth.min_m} is not below the greatest depth, {max_depth_m} m",
            fix="set --depth.max-m",
        )
    return config.depth.min_m, max_depth_m


def _members(config: MapConfig, rule: FusionRule, classes: Sequence[str]) -> int:
    """How many members the ensemble has.

    Raises:
        UsageError: the map has no class that it could be asked about.
    """
    members = config.ensemble.members
    if members and rule.target(classes) is None:
        known = f"its classes are {' '.join(classes)}" if classes else "it has no class at all"
        raise UsageError(
            f"an ensemble estimates where the map misses a priority class, and the map has none: {known}",
            where="ensemble.members",
            fix="name a class with --fusion.priority-classes, or leave the ensemble out",
        )
    return members


@contextmanager
def _as_usage_error() -> Iterator[None]:
    """What is refused while settings are taken up is the fault of the settings."""
    try:
        yield
    except UsageError:
        raise
    except JaxmapError as error:
        raise UsageError(error.what, where=error.where, fix=error.fix or "see jaxmap map --help") from error
