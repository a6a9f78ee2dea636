"""A mapping run, planned in full before the first frame: sequence, range, bounds, labeller and step."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from jaxmap.datasets import StereoSequence
from jaxmap.datasets.base import OnFrame
from jaxmap.ensemble.draws import draw_ensemble
from jaxmap.errors import UsageError
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import fusion_attribute, make_fusion_params
from jaxmap.geometry.bounds import check_memory, grid_around_views, map_bytes, site_lattice, usable_depth, view_boxes
from jaxmap.geometry.grid import window_shape
from jaxmap.geometry.options import GridOptions, Triple
from jaxmap.mapping.observations import Observations
from jaxmap.mapping.regions import frames_of_tiles, region_shape
from jaxmap.mapping.sequence import PreparedFrame, frame_form, observed_frames, prepare_frames
from jaxmap.mapping.step import Mapper, MapperParams, make_mapper
from jaxmap.mapping.tiles import block_shape, channels_of, whole_tiles
from jaxmap.planning.ground import cell_size, fine_enough
from jaxmap.planning.options import ROVER_SETTINGS, RoverOptions
from jaxmap.runs.config import MapConfig, PerceiveConfig
from jaxmap.runs.labelling import Notify, as_usage_error
from jaxmap.runs.perceiving import Keeper, make_keeper
from jaxmap.runs.perception import Perception, plan_perception, saw_relief
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.jax_matcher import JaxMatcher
from jaxmap.types import MAX_TENSOR_ELEMENTS, Frame, GridSpec, StereoCamera, make_grid

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
    block: tuple[int, int, int] | None,
    held: str,
) -> str:
    """One line on what is mapped, and the memory it takes: a map in tiles, that of the block that is `held`."""
    taken = f"{map_bytes(grid if block is None else replace(grid, shape=block), class_count, members) / 2**20:.0f} MiB"
    if block is not None:
        taken = f"in tiles on disk, {' x '.join(map(str, block))} voxels {held}, {taken}"
    size = " x ".join(f"{edge:g}" for edge in np.asarray(grid.voxel_size_m, np.float64).round(6))
    return (
        f"depth {depth_range_m[0]:g} to {depth_range_m[1]:g} m; grid {' x '.join(map(str, grid.shape))} voxels of "
        f"{size} m, {1 + class_count} channels{f' and {members} members of 2' if members else ''}: "
        f"{taken}"
    )


class Sharing(NamedTuple):
    """How a map is shared out: how many workers there are, and the memory that a region may take on each."""

    workers: int
    memory_gib: float


@dataclass(frozen=True, kw_only=True)
class Plan(Perception):
    """A run, decided in full before the first frame is fused.

    Attributes:
        keeper: keeps what is perceived on the way, where that was asked for.
        pose_errors: of the members of an ensemble, for each frame.
        rover: whose hazards are layers of the map.
        block_shape: of a map that is larger than the memory it may take, or shared out: voxels along each axis of the
            part that is in memory.
    """

    grid: GridSpec
    depth_range_m: tuple[float, float]
    rule: FusionRule
    params: MapperParams
    fusion: dict[str, Any]
    mapper: Mapper
    key: PRNGKeyArray
    keeper: Keeper | None = None
    pose_errors: Float[np.ndarray, "N M 6"] | None = None
    block_shape: tuple[int, int, int] | None = None
    rover: RoverOptions = field(default_factory=RoverOptions)

    @property
    def members(self) -> int:
        """How many members the ensemble has."""
        return 0 if self.pose_errors is None else self.pose_errors.shape[1]

    @property
    def frame_form(self) -> Frame:
        """The form of the frames that the step takes."""
        kept = self.observations or self.keeper
        shape = () if kept is None else kept.attributes.kept_shape
        matched = self.mapper.design.match is None
        return frame_form(self.front_end.camera, self.labeller, self.members, shape, matched=matched)

    def prepare(self, indices: Sequence[int] | None = None, keep_in: Path | None = None) -> Iterator[PreparedFrame]:
        """Frames, made ready ahead of their use.

        Args:
            indices: which; by default all.
            keep_in: the observations to be written on the way, with a keeper.
        """
        indices = range(len(self.sequence.frames)) if indices is None else indices
        if self.observations is not None:
            more: Any = {"left_image": self.left_image, "pose_errors": self.pose_errors}
            return observed_frames(self.observations, indices=indices, **more)
        if self.keeper is not None and keep_in is not None:
            return self.keeper.frames(keep_in, indices, self.pose_errors)
        return prepare_frames(
            self.sequence,
            self.front_end,
            self.label_folder,
            needs=self.labeller.needs,
            matched=self.mapper.design.match is None,
            pose_errors=self.pose_errors,
            indices=indices,
        )

    def settings(self, config: PerceiveConfig) -> dict[str, Any]:
        """The settings as plain values, with the sequence and what was left to the data resolved."""
        return super().settings(config) | ({} if self.keeper is None else {"keep_observations": True})

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
    keep: bool = False,
    images: bool = False,
    match_in_step: bool = False,
    in_tiles: bool = False,
    shared: Sharing | tuple[int, int, int] | None = None,
) -> Plan:
    """Opens the sequence or its observations, and decides range, bounds, labeller and step.

    Args:
        source: the folder of one sequence or of observations, or `sample:NAME`.
        config: the settings.
        notify: takes lines for the user.
        on_frame: is told of the progress of odometry, where it gives the poses.
        keep: keep what is perceived, as observations.
        images: of observations, too, let the labeller see the images (`plan_perception`).
        match_in_step: the step itself matches, where the settings name a matcher in JAX and nothing else wants the
            disparity of every frame: it is neither kept nor compared with a truth. Otherwise frames are matched
            ahead, by the same function, compiled apart.
        in_tiles: a map that takes more memory than it may is kept in tiles, not refused.
        shared: fuse regions of the map apart, one at a time on each worker; or the shape of a region.

    Raises:
        JaxmapError: the data or the settings do not serve.
    """
    seen = plan_perception(source, config, notify, on_frame, images=images)
    keeper = None
    if keep:
        keeper = make_keeper(seen, config, config.fusion.disparity_sigma_px)
        seen = replace(seen, labeller=keeper.labeller)
    elif seen.observations is not None:
        _note_other_noise(seen.observations, config, notify)
    sequence, front_end, labeller, camera = seen.sequence, seen.front_end, seen.labeller, seen.front_end.camera
    depth_range_m = _depth_range(config, camera)
    with as_usage_error():
        grid = choose_grid(config.grid, sequence, front_end, depth_range_m[1])
        rule = config.fusion.rule(labeller.classes)
        fusion_params = make_fusion_params(labeller.classes, config.fusion)
        members = _members(config, rule, labeller.classes)
    # The members of an ensemble stand elsewhere.
    T_known = None if members else sequence.T_world_camera @ front_end.T_raw_rectified
    window = window_shape(grid, camera, depth_range_m[1], T_known)
    channels = channels_of(len(labeller.classes), surface=rule.surface)
    if shared is not None:
        grid, block = _in_regions(grid, camera, channels, depth_range_m[1], T_known, shared)
    else:
        in_blocks = channels if in_tiles and not members else None
        limit_gib = config.grid.max_memory_gib
        grid, block = _fit_memory(grid, window, len(labeller.classes), members, limit_gib, in_blocks)
    held = "fused at a time" if shared else "around the rover in memory"
    notify(describe_grid(grid, depth_range_m, len(labeller.classes), members, block, held))
    match = _matcher_of_step(seen) if match_in_step and keeper is None else None
    key = jax.random.key(config.seed)
    ensemble, pose_errors = None, None
    if members:
        timestamps_s = np.array([frame.timestamp_s for frame in sequence.frames], np.float64)
        ensemble, pose_errors = draw_ensemble(key, fusion_params, timestamps_s, config.ensemble)

    return Plan(
        **{one.name: getattr(seen, one.name) for one in fields(seen)},
        keeper=keeper,
        grid=grid,
        depth_range_m=depth_range_m,
        rule=rule,
        params=MapperParams(camera, fusion_params, labeller.params, ensemble, match and match.params),
        fusion=fusion_attribute(config.fusion, rule) | ({"ensemble": asdict(config.ensemble)} if members else {}),
        mapper=make_mapper(
            camera,
            grid if block is None else replace(grid, shape=block),
            labeller,
            rule,
            depth_range_m,
            members=members,
            match=match and match.design,
            T_world_camera=T_known,
        ),
        key=key,
        pose_errors=pose_errors,
        block_shape=block,
        rover=_rover_of(config.rover, grid, notify),
    )


def _matcher_of_step(seen: Perception) -> JaxMatcher | None:
    """The matcher, where the step itself can match: nothing else wants the disparity of every frame."""
    wanted = seen.observations is not None or seen.sequence.true_disparity is not None
    return seen.front_end.matcher if isinstance(seen.front_end.matcher, JaxMatcher) and not wanted else None


def _fit_memory(
    grid: GridSpec,
    window: tuple[int, int, int],
    class_count: int,
    members: int,
    limit_gib: float,
    channels: float | None,
) -> tuple[GridSpec, tuple[int, int, int] | None]:
    """The grid and, where it is kept in tiles, voxels along each axis of the block that is in memory.

    That has so many `channels`; where they are None it may not be in tiles.

    Raises:
        JaxmapError: it takes more memory than it may, or would even in tiles.
    """
    limit_bytes = min(limit_gib * 2**30, 4 * MAX_TENSOR_ELEMENTS)
    if channels is not None and map_bytes(grid, class_count) > limit_bytes:
        block = block_shape(whole_tiles(grid), window, channels, limit_bytes)
        if block is not None:
            return whole_tiles(grid), block
    check_memory(grid, class_count, limit_gib, members)
    return grid, None


def _in_regions(
    grid: GridSpec,
    camera: StereoCamera,
    channels: float,
    max_depth_m: float,
    T_known: Float[np.ndarray, "N 4 4"] | None,
    shared: Sharing | tuple[int, int, int],
) -> tuple[GridSpec, tuple[int, int, int]]:
    """The grid in whole tiles, and voxels along each axis of the regions that workers fuse.

    Raises:
        UsageError: there is an ensemble, or not even the smallest region fits.
    """
    if T_known is None:
        raise UsageError("an ensemble is fused in one piece", where="ensemble.members", fix="leave the workers out")
    grid = whole_tiles(grid)
    if not isinstance(shared, Sharing):
        return grid, shared
    touching = frames_of_tiles(grid, view_boxes(grid, camera, T_known, max_depth_m))
    window, limit_bytes = window_shape(grid, camera, max_depth_m, T_known), shared.memory_gib * 2**30
    shape = region_shape(grid, window, channels, limit_bytes, touching, shared.workers)
    if shape is None:
        raise UsageError(
            f"what one frame sees takes more than the {shared.memory_gib:.3g} GiB that each worker may",
            where="grid.max_memory_gib",
            fix="take fewer workers, larger voxels (--grid.voxel-size-m), or raise --grid.max-memory-gib",
        )
    return grid, shape


def _rover_of(name_or_path: str, grid: GridSpec, notify: Notify) -> RoverOptions:
    """The rover whose hazards are measured; says where columns are too large for that.

    Raises:
        UsageError: there is no such file, or it says something else.
    """
    rover, cell_m = ROVER_SETTINGS.load(name_or_path), max(cell_size(grid))
    if not fine_enough(grid, rover):
        notify(
            f"note: columns of {cell_m:g} m show no hazards of a rover of radius {rover.radius_m:g} m: none are kept"
        )
    return rover


def _note_other_noise(observations: Observations, config: MapConfig, notify: Notify) -> None:
    """Says where the network was shown relief under another noise of the disparity than the map's."""
    then_px, now_px = observations.attributes.disparity_sigma_px, config.fusion.disparity_sigma_px
    if config.labeller == "deeplab" and saw_relief(observations.attributes) and then_px != now_px:
        notify(f"note: the network saw relief under fusion.disparity_sigma_px {then_px:g}, and is not asked again")


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
