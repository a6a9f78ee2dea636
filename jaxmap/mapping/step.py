"""The compiled step: one stereo frame into the map, as one jitted function."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree, UInt8

from jaxmap.ensemble.draws import EnsembleParams
from jaxmap.ensemble.members import fuse_members
from jaxmap.errors import JaxmapError
from jaxmap.fusion.frame import Counted, Sighting
from jaxmap.fusion.kernel import add_sighting
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams
from jaxmap.geometry.cloud import project
from jaxmap.geometry.grid import view_window, window_shape
from jaxmap.labellers.base import NO_NUMBERS, Labeller, LabellerParams, fusible, harden, label_points
from jaxmap.labels import IGNORE
from jaxmap.matching.design import MatchDesign, MatchParams
from jaxmap.matching.match import match
from jaxmap.matching.rectify import RawPair, rectify_pair, rectifying_rotations
from jaxmap.types import Frame, GridSpec, PointLabels, StereoCamera, VoxelMap, make_voxel_map

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MapperParams:
    """All the numbers the step depends on; every leaf is differentiable.

    `labeller` are `Labeller.params`, `ensemble` the numbers of an ensemble's members, where the mapper has any; `match`
    those of stereo matching, where the step matches, and `raw` the calibration of the images, where it rectifies them.
    """

    camera: StereoCamera
    fusion: FusionParams
    labeller: LabellerParams = NO_NUMBERS
    ensemble: EnsembleParams | None = None
    match: MatchParams | None = None
    raw: RawPair | None = None


class StepReport(NamedTuple):
    """What one step did.

    `points_valid` have a disparity, `points_in_range` lie between the depths, `points_kept` were
    kept by the labeller; `voxels_hit` hold points, `voxels_freed` were seen through; `estimate` is
    the labeller's, of the whole frame (the `Plane` of the plane labeller). `labels` are those of the pixels, as
    `Mapper.label_image` gives them: zeros where `Frame.show` is false, None where it is None.
    """

    points_valid: Int[Array, ""]
    points_in_range: Int[Array, ""]
    points_kept: Int[Array, ""]
    voxels_hit: Int[Array, ""]
    voxels_freed: Int[Array, ""]
    estimate: PyTree
    labels: UInt8[Array, "H W"] | None = None


@dataclass(frozen=True, eq=False)
class StepDesign:
    """What is decided before the step is compiled; it equals itself alone, and so can be an argument of `jax.jit`.

    Attributes:
        labeller: gives each point its class.
        rule: the discrete choices of fusion.
        depth_range_m: points nearer or farther are left out.
        window_shape: voxels of a part of the grid that holds all that a frame can touch.
        members: of an ensemble that is fused beside the map.
        match: how the step matches the images of a frame; None where frames come with their disparity.
    """

    labeller: Labeller
    rule: FusionRule
    depth_range_m: tuple[float, float]
    window_shape: tuple[int, int, int]
    members: int = 0
    match: MatchDesign | None = None


def in_full_float32(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """The same with products of matrices in full float32: a GPU by itself rounds the factors to ten bits.

    Positions of many metres would be off by centimetres. A CPU computes them in full in any case.
    """

    @functools.wraps(function)
    def exact(*arguments: Arguments.args, **options: Arguments.kwargs) -> Result:
        with jax.default_matmul_precision(None if jax.default_backend() == "cpu" else "highest"):
            return function(*arguments, **options)

    return exact


class SeenFrame(NamedTuple):
    """What one frame shows, before it is added to a map: its labelled points, and the window of the map they lie in.

    `frame` is itself, matched; `shown` are its labels as an image, where it asks for them.
    """

    sighting: Sighting
    window: GridSpec
    frame: Frame
    estimate: PyTree
    shown: UInt8[Array, "H W"] | None


@in_full_float32
def fuse_frame(
    design: StepDesign, voxel_map: VoxelMap, frame: Frame, params: MapperParams, key: PRNGKeyArray
) -> tuple[VoxelMap, StepReport]:
    """The step itself: one frame into the map. `key` is the run's."""
    frame_key = jax.random.fold_in(key, voxel_map.frames_fused)
    rule, depth_range_m = design.rule, design.depth_range_m
    seen = see_frame(design, voxel_map.grid, frame, params, frame_key)
    fused, counted = add_sighting(voxel_map, seen.sighting, seen.window, params.fusion, rule, depth_range_m)
    if design.members:
        assert params.ensemble is not None
        camera, labels, shape = seen.sighting.camera, seen.sighting.labels, design.window_shape
        own = fuse_members(
            voxel_map, seen.frame, labels, camera, params.ensemble, frame_key, rule, depth_range_m, shape
        )
        fused = replace(fused, members=own)
    return fused, report_of(seen, counted)


@in_full_float32
def see_frame(
    design: StepDesign, grid: GridSpec, frame: Frame, params: MapperParams, frame_key: PRNGKeyArray
) -> SeenFrame:
    """What a frame shows of a grid: all of the step but the sum over voxels."""
    labeller, rule, depth_range_m = design.labeller, design.rule, design.depth_range_m
    frame, camera = matched(design.match, frame, params)
    pose, fusion = frame.T_world_camera, params.fusion

    cloud = project(camera, pose, frame.matched_px, depth_range_m, fusion.disparity_sigma_px, labeller.ground)
    labels, estimate = label_points(labeller, frame, cloud, params.labeller, frame_key)
    shown = None if frame.show is None else _shown(frame.show, labels, cloud.valid.shape)
    labels = fusible(labels, labeller.classes, rule)
    window = view_window(grid, camera, pose, depth_range_m[1], design.window_shape)
    sighting = Sighting(camera, pose, frame.matched_px, labels)
    return SeenFrame(sighting, window, frame, estimate, shown)


def report_of(seen: SeenFrame, counted: Counted) -> StepReport:
    """What the step says of a frame."""
    return StepReport(
        points_valid=counted.valid,
        points_in_range=counted.in_range,
        points_kept=counted.kept,
        voxels_hit=counted.hits,
        voxels_freed=counted.freed,
        estimate=seen.estimate,
        labels=seen.shown,
    )


def matched(design: MatchDesign | None, frame: Frame, params: MapperParams) -> tuple[Frame, StereoCamera]:
    """The frame as the rest of the step takes it, with its disparity, and the rectified camera that sees it.

    The disparity is the frame's own or, with a design, that of its images, which are rectified before where the
    params hold the calibration of a raw pair.
    """
    if design is None:
        return frame, params.camera
    frame, camera = rectified(design, frame, params)
    assert frame.image is not None and frame.right_image is not None and params.match is not None
    with jax.named_scope("match"):
        disparity_px = match(design, frame.image, frame.right_image, params.match)
    if frame.blind is not None:
        disparity_px = jnp.where(frame.blind, jnp.nan, disparity_px)
    return replace(frame, disparity_px=disparity_px), camera


def rectified(design: MatchDesign, frame: Frame, params: MapperParams) -> tuple[Frame, StereoCamera]:
    """The frame with rectified images, and the camera, whose baseline is that of the raw pair where there is one.

    The pose of a frame with raw images is that of the raw left camera.
    """
    raw, camera = params.raw, params.camera
    if raw is None:
        return frame, camera
    assert frame.image is not None and frame.right_image is not None
    with jax.named_scope("rectify"):
        pair = rectify_pair(raw, camera, frame.image, frame.right_image)
        # Gradients pass through fractions of grey levels alone.
        left, right = (
            image if design.soft else jnp.round(image).astype(jnp.uint8) for image in (pair.left, pair.right)
        )
        R_rectified_raw, _ = rectifying_rotations(raw)
        pose = frame.T_world_camera @ jaxlie.SE3.from_rotation(R_rectified_raw.inverse())
        blind = ~pair.left_seen if frame.blind is None else frame.blind | ~pair.left_seen
        baseline_m = jnp.linalg.norm(raw.T_right_left.translation())
    frame = replace(frame, T_world_camera=pose, image=left, right_image=right, blind=blind)
    return frame, replace(camera, baseline_m=baseline_m)


@in_full_float32
def perceive_frame(
    labeller: Labeller,
    camera: StereoCamera,
    frame: Frame,
    params: LabellerParams,
    disparity_sigma_px: Float[Array, ""] | float,
) -> Float[Array, "h w C"]:
    """What the network of a labeller makes of a frame within the step: its `perceive`, apart from the fusion."""
    assert labeller.perceive is not None
    depths_m = (0.0, float("inf"))
    pose = frame.T_world_camera
    cloud = project(camera, pose, frame.matched_px, depths_m, disparity_sigma_px, labeller.ground)
    return labeller.perceive(frame, cloud, params)


@in_full_float32
def label_image(
    design: StepDesign, frame: Frame, params: MapperParams, key: PRNGKeyArray, number: Int[Array, ""]
) -> UInt8[Array, "H W"]:
    """The labels that the step gives the pixels of the frame when `number` frames were fused before it."""
    frame_key = jax.random.fold_in(key, number)
    sigma_px, ground = params.fusion.disparity_sigma_px, design.labeller.ground
    frame, camera = matched(design.match, frame, params)
    cloud = project(camera, frame.T_world_camera, frame.matched_px, design.depth_range_m, sigma_px, ground)
    labels, _ = label_points(design.labeller, frame, cloud, params.labeller, frame_key)
    return _as_image(labels, cloud.valid.shape)


def _as_image(labels: PointLabels, image_px: tuple[int, ...]) -> UInt8[Array, "H W"]:
    """The labels of all points, `IGNORE` where none is kept."""
    labels = harden(labels)
    assert labels.labels is not None
    return jnp.where(labels.keep, labels.labels, IGNORE).astype(jnp.uint8).reshape(image_px)


def _shown(show: Bool[Array, ""], labels: PointLabels, image_px: tuple[int, ...]) -> UInt8[Array, "H W"]:
    """The labels as an image, for the price of an empty one where nobody asks."""
    # Class by class, as XLA has them before it stacks them: other frames then need no stack.
    soft = labels.probabilities
    shares = [] if soft is None else [soft[:, index] for index in range(soft.shape[1])]

    def image() -> UInt8[Array, "H W"]:
        stacked = jnp.stack(shares, axis=-1) if shares else None
        return _as_image(labels._replace(probabilities=stacked), image_px)

    with jax.named_scope("show"):
        return jax.lax.cond(show, image, lambda: jnp.zeros(image_px, jnp.uint8))


Step = Callable[[VoxelMap, Frame, MapperParams, PRNGKeyArray], tuple[VoxelMap, StepReport]]


class Mapper(NamedTuple):
    """The pure functions of a mapper.

    Attributes:
        design: what was decided before the step was compiled.
        init: `() -> VoxelMap`, an empty map.
        step: `(voxel_map, frame, params, key) -> (voxel_map, StepReport)`, compiled once; the map
            passed in is donated: its tensor must not be used again. The key is the run's: the step folds
            the number of fused frames into it.
        fuse: the same function, not jitted and donating nothing, to be composed and differentiated.
        scan: `(voxel_map, frames, params, key) -> (voxel_map, StepReport)` over frames stacked along
            a leading axis, equal to a loop over `step`.
        label_image: `(frame, params, key, number) -> uint8 (H, W)`, the labels that the step gives
            the pixels of the frame when `number` frames were fused before it; `IGNORE` where none.
        lower: the arguments of `step` -> `jax.stages.Lowered`, for its cost, memory and HLO.
        compilations: how often `step` has been compiled so far.
    """

    design: StepDesign
    init: Callable[[], VoxelMap]
    step: Step
    fuse: Step
    scan: Step
    label_image: Callable[[Frame, MapperParams, PRNGKeyArray, int], UInt8[Array, "H W"]]
    lower: Callable[[VoxelMap, Frame, MapperParams, PRNGKeyArray], jax.stages.Lowered]
    compilations: Callable[[], int]


def make_mapper(
    camera: StereoCamera,
    grid: GridSpec,
    labeller: Labeller,
    rule: FusionRule,
    depth_range_m: tuple[float, float],
    *,
    members: int = 0,
    match: MatchDesign | None = None,
    T_world_camera: Float[np.ndarray, "N 4 4"] | None = None,
) -> Mapper:
    """Builds a mapper.

    Args:
        camera: fixes the image size and the window of voxels a frame can touch; the camera that the
            step computes with is that of its params.
        grid: the bounds of the map.
        labeller: gives each point its class.
        rule: the discrete choices of fusion.
        depth_range_m: points nearer or farther than these are left out.
        members: of an ensemble that is fused beside the map; its params then hold `ensemble`, its frames
            `pose_errors`.
        match: how the step matches the images of a frame (`image` and `right_image`); its params then hold `match`.
            Without it, frames bring their disparity. With `raw` (`stereo.rectify.make_raw_pair`) in its params as well,
            the images are raw, and the pose of a frame is that of the raw left camera.
        T_world_camera: the poses of all frames, where they are known beforehand: the windows then are no larger
            than these need. What a frame of another pose sees beyond its window is left out.

    Raises:
        JaxmapError: an invalid depth range, or an ensemble without a class to ask about; when a step is traced, a
            frame or params that lack what it needs.
    """
    min_depth_m, max_depth_m = depth_range_m
    if not 0 <= min_depth_m < max_depth_m < float("inf"):
        raise JaxmapError(
            f"invalid depth range {min_depth_m} to {max_depth_m} m", where="mapper", fix="take 0 <= min < max"
        )
    if members and rule.target(labeller.classes) is None:
        raise JaxmapError(
            "an ensemble needs a class whose misses it estimates", where="mapper", fix="name one in priority_classes"
        )
    shape = window_shape(grid, camera, max_depth_m, T_world_camera)
    design = StepDesign(labeller, rule, depth_range_m, shape, members, match)

    def fuse(voxel_map: VoxelMap, frame: Frame, params: MapperParams, key: PRNGKeyArray) -> tuple[VoxelMap, StepReport]:
        check_inputs(design, frame, params)
        return fuse_frame(design, voxel_map, frame, params, key)

    def scan(
        voxel_map: VoxelMap, frames: Frame, params: MapperParams, key: PRNGKeyArray
    ) -> tuple[VoxelMap, StepReport]:
        return jax.lax.scan(lambda carried, frame: fuse(carried, frame, params, key), voxel_map, frames)

    def label(frame: Frame, params: MapperParams, key: PRNGKeyArray, number: Int[Array, ""]) -> UInt8[Array, "H W"]:
        check_inputs(design, frame, params)
        return label_image(design, frame, params, key, number)

    return Mapper(
        design=design,
        init=lambda: make_voxel_map(grid, labeller.classes, members, surface=rule.surface),
        fuse=fuse,
        scan=jax.jit(scan),
        label_image=jax.jit(label),
        **step_functions(fuse),
    )


def step_functions(fuse: Callable[..., Any]) -> dict[str, Any]:
    """The `step`, `lower` and `compilations` of a mapper, of a function whose first argument, the map, is donated."""

    def fuse_donated(tensors: _Tensors, rest: VoxelMap, *inputs: Any) -> Any:
        return fuse(replace(rest, **tensors._asdict()), *inputs)

    # Only the tensors are donated: the small arrays of the grid may be shared with other maps.
    compiled: Any = jax.jit(fuse_donated, donate_argnums=0)
    return {
        "step": lambda voxel_map, *inputs: compiled(*_apart(voxel_map), *inputs),
        "lower": lambda voxel_map, *inputs: compiled.lower(*_apart(voxel_map), *inputs),
        "compilations": compiled._cache_size,
    }


class StepCost(NamedTuple):
    """What the compiler says of a step: time to compile it, memory it takes beside the map, and its program as text."""

    compile_s: float
    temporary_bytes: int
    program: Callable[[], str | None]


def compile_step(
    mapper: Mapper, voxel_map: VoxelMap, frame: Frame, params: MapperParams, key: PRNGKeyArray
) -> tuple[Mapper, StepCost]:
    """Compiles the step ahead of its first use.

    Returns:
        A mapper whose step takes frames of just this size and kind, and refuses others; and what
        the compiler says of it.
    """
    started_s = time.perf_counter()
    executable = mapper.lower(voxel_map, frame, params, key).compile()
    compile_s = time.perf_counter() - started_s
    memory = executable.memory_analysis()
    cost = StepCost(compile_s, memory.temp_size_in_bytes if memory else 0, executable.as_text)
    return mapper._replace(step=lambda voxel_map, *inputs: executable(*_apart(voxel_map), *inputs)), cost


def check_inputs(design: StepDesign, frame: Frame, params: MapperParams) -> None:
    """Refuses a frame or params that lack what the step needs."""
    labeller = design.labeller
    where = f"{labeller.name} labeller"
    if labeller.needs is not None and getattr(frame, labeller.needs) is None:
        raise JaxmapError(f"the frame has no {labeller.needs}", where=where, fix="fill that field of Frame")
    if jax.tree.structure(params.labeller) != jax.tree.structure(labeller.params):
        raise JaxmapError(
            "the params hold other numbers than the labeller's",
            where=where,
            fix="build MapperParams with labeller=labeller.params",
        )
    if design.members and (params.ensemble is None or frame.pose_errors is None):
        raise JaxmapError(
            "the ensemble has no numbers to draw by",
            where="mapper",
            fix="fill MapperParams.ensemble and Frame.pose_errors",
        )
    _check_matching(design, frame, params)


def _check_matching(design: StepDesign, frame: Frame, params: MapperParams) -> None:
    """Refuses a frame or params that lack what matching needs, and a frame that is matched already."""
    if design.match is None:
        _ = frame.matched_px
        return
    if frame.disparity_px is not None:
        raise JaxmapError("the frame is matched already", where="mapper", fix="leave out Frame.disparity_px, or match")
    if frame.image is None or frame.right_image is None or params.match is None:
        raise JaxmapError(
            "the step has nothing to match",
            where="mapper",
            fix="fill Frame.image, Frame.right_image and MapperParams.match",
        )
    left, right = (image.shape[:2] for image in (frame.image, frame.right_image))
    if left != right:
        raise JaxmapError(f"the left image is {left}, the right one {right}", where="mapper", fix="give equal ones")


class _Tensors(NamedTuple):
    """The large arrays of a map, by their names in it."""

    log_odds: Array
    members: Array | None
    surface: Array | None


def _apart(voxel_map: VoxelMap) -> tuple[_Tensors, VoxelMap]:
    """The tensors of a map, and the map without them."""
    tensors = _Tensors(voxel_map.log_odds, voxel_map.members, voxel_map.surface)
    return tensors, replace(voxel_map, **dict.fromkeys(_Tensors._fields))
