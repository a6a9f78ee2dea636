"""The compiled step: one stereo frame into the map, as one jitted function."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree, UInt8

from jaxmap.ensemble.draws import EnsembleParams
from jaxmap.ensemble.members import Site, fuse_members
from jaxmap.errors import JaxmapError
from jaxmap.fusion.integrate import integrate
from jaxmap.fusion.params import FusionParams, FusionRule
from jaxmap.fusion.view import Reach, view_of
from jaxmap.geometry.camera import disparity_to_points, transform_points
from jaxmap.geometry.grid import window_shape
from jaxmap.labellers.base import Labeller, harden
from jaxmap.labels import IGNORE
from jaxmap.types import Frame, GridSpec, Plane, PointLabels, StereoCamera, VoxelMap, make_voxel_map

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def in_full_float32(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """The same with products of matrices in full float32: a GPU by itself rounds the factors to ten bits.

    Positions of many metres would be off by centimetres. A CPU computes them in full whatever it is told.
    """

    @functools.wraps(function)
    def exact(*arguments: Arguments.args, **options: Arguments.kwargs) -> Result:
        with jax.default_matmul_precision(None if jax.default_backend() == "cpu" else "highest"):
            return function(*arguments, **options)

    return exact


_ENSEMBLE_DRAW = 1
"""Folded into a frame's key for the draws of the ensemble; the labeller draws from the key itself."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MapperParams:
    """All the numbers the step depends on; every leaf is differentiable."""

    camera: StereoCamera
    fusion: FusionParams
    labeller: PyTree = ()
    """`Labeller.params`; most labellers have none."""
    ensemble: EnsembleParams | None = None
    """The numbers of an ensemble's members, where the mapper has any."""


class StepInfo(NamedTuple):
    """What one step did.

    `points_valid` have a disparity, `points_in_range` lie between the depths, `points_kept` were
    kept by the labeller; `voxels_hit` hold points, `voxels_freed` were seen through; `plane` is the
    labeller's, or None.
    """

    points_valid: Int[Array, ""]
    points_in_range: Int[Array, ""]
    points_kept: Int[Array, ""]
    voxels_hit: Int[Array, ""]
    voxels_freed: Int[Array, ""]
    plane: Plane | None


class Mapper(NamedTuple):
    """The pure functions of a mapper.

    Attributes:
        init: `() -> VoxelMap`, an empty map.
        step: `(voxel_map, frame, params, key) -> (voxel_map, StepInfo)`, compiled once; the map
            passed in is donated: its tensor must not be used again. The key is the run's: the step folds
            the number of fused frames into it.
        fuse: the same function, not jitted and donating nothing, to be composed and differentiated.
        scan: `(voxel_map, frames, params, key) -> (voxel_map, StepInfo)` over frames stacked along
            a leading axis, equal to a loop over `step`.
        label_image: `(frame, params, key, number) -> uint8 (H, W)`, the labels that the step gives
            the pixels of the frame when `number` frames were fused before it; `IGNORE` where none.
        lower: the arguments of `step` -> `jax.stages.Lowered`, for its cost, memory and HLO.
        compilations: how often `step` has been compiled so far.
    """

    init: Callable[[], VoxelMap]
    step: Callable[[VoxelMap, Frame, MapperParams, PRNGKeyArray], tuple[VoxelMap, StepInfo]]
    fuse: Callable[[VoxelMap, Frame, MapperParams, PRNGKeyArray], tuple[VoxelMap, StepInfo]]
    scan: Callable[[VoxelMap, Frame, MapperParams, PRNGKeyArray], tuple[VoxelMap, StepInfo]]
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
        T_world_camera: the poses of all frames, where they are known beforehand: the windows then are no larger
            than these need. What a frame of another pose sees beyond its window is left out.

    Raises:
        JaxmapError: a depth range that is none, or an ensemble without a class to ask about.
    """
    min_depth_m, max_depth_m = depth_range_m
    if not 0 <= min_depth_m < max_depth_m < float("inf"):
        raise JaxmapError(f"depth range {min_depth_m} to {max_depth_m} m", where="mapper", fix="take 0 <= min < max")
    if members and rule.target(labeller.classes) is None:
        raise JaxmapError(
            "an ensemble needs a class whose misses it tells", where="mapper", fix="name one in priority_classes"
        )
    reach = Reach(depth_range_m, window_shape(grid, camera, max_depth_m, T_world_camera))
    design = _Design(labeller, rule, reach, members)
    fuse = functools.partial(_fuse, design)

    def scan(voxel_map: VoxelMap, frames: Frame, params: MapperParams, key: PRNGKeyArray) -> tuple[VoxelMap, StepInfo]:
        return jax.lax.scan(lambda carried, frame: fuse(carried, frame, params, key), voxel_map, frames)

    def fuse_donated(tensors: _Tensors, rest: VoxelMap, *inputs: Any) -> tuple[VoxelMap, StepInfo]:
        return fuse(replace(rest, **tensors._asdict()), *inputs)

    # Only the tensors are donated: the small arrays of the grid may be shared with other maps.
    compiled: Any = jax.jit(fuse_donated, donate_argnums=0)

    def step(voxel_map: VoxelMap, frame: Frame, params: MapperParams, key: PRNGKeyArray) -> tuple[VoxelMap, StepInfo]:
        return compiled(*_apart(voxel_map), frame, params, key)

    def lower(voxel_map: VoxelMap, frame: Frame, params: MapperParams, key: PRNGKeyArray) -> jax.stages.Lowered:
        return compiled.lower(*_apart(voxel_map), frame, params, key)

    return Mapper(
        init=lambda: make_voxel_map(grid, labeller.classes, members),
        step=step,
        fuse=fuse,
        scan=jax.jit(scan),
        label_image=jax.jit(functools.partial(_label_image, design)),
        lower=lower,
        compilations=compiled._cache_size,
    )


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

    def step(voxel_map: VoxelMap, frame: Frame, params: MapperParams, key: PRNGKeyArray) -> tuple[VoxelMap, StepInfo]:
        return executable(*_apart(voxel_map), frame, params, key)

    return mapper._replace(step=step), StepCost(
        compile_s, memory.temp_size_in_bytes if memory else 0, executable.as_text
    )


class _Design(NamedTuple):
    """What is decided before the step is compiled."""

    labeller: Labeller
    rule: FusionRule
    reach: Reach
    members: int


class _Observation(NamedTuple):
    """The labelled points of one frame; images are (H, W), lists (H W)."""

    depth_m: Array
    valid: Array
    in_range: Array
    points_world: Array
    labels: PointLabels
    plane: Plane | None


@in_full_float32
def _observe(design: _Design, frame: Frame, params: MapperParams, key: PRNGKeyArray) -> _Observation:
    """The labelled points of a frame; `key` is the frame's own."""
    labeller = design.labeller
    if labeller.needs is not None and getattr(frame, labeller.needs) is None:
        raise JaxmapError(
            f"the frame has no {labeller.needs}", where=f"{labeller.name} labeller", fix="fill that field of Frame"
        )
    if jax.tree.structure(params.labeller) != jax.tree.structure(labeller.params):
        raise JaxmapError(
            "the params hold other numbers than the labeller's",
            where=f"{labeller.name} labeller",
            fix="build MapperParams with labeller=labeller.params",
        )
    min_depth_m, max_depth_m = design.reach.depth_range_m
    points_camera, valid = disparity_to_points(params.camera, frame.disparity_px)
    depth_m = points_camera[..., 2]
    in_range = valid & (depth_m >= min_depth_m) & (depth_m <= max_depth_m)
    points_world = transform_points(frame.T_world_camera, points_camera).reshape(-1, 3)
    # Kept apart: labeller and scatter would each compute the points anew, one by one.
    points_world, depth_m, in_range = jax.lax.optimization_barrier((points_world, depth_m, in_range))
    labels, plane = labeller.label(frame, points_world, in_range.reshape(-1), params.labeller, key)
    return _Observation(depth_m, valid, in_range, points_world, labels, plane)


@in_full_float32
def _fuse(
    design: _Design, voxel_map: VoxelMap, frame: Frame, params: MapperParams, key: PRNGKeyArray
) -> tuple[VoxelMap, StepInfo]:
    """The step itself: one frame into the map."""
    rule, grid = design.rule, voxel_map.grid
    frame_key = jax.random.fold_in(key, voxel_map.frames_fused)
    seen = _observe(design, frame, params, frame_key)
    labels = harden(seen.labels) if rule.per_frame == "once" else seen.labels
    view = view_of(
        grid, params.camera, frame.T_world_camera, seen.depth_m, seen.valid, params.fusion, rule, design.reach
    )
    fused, hits = integrate(
        voxel_map, seen.points_world, labels, view.weights, params.fusion, rule, window=view.window, free=view.free
    )
    if design.members:
        fused = replace(fused, members=_fuse_ensemble(design, voxel_map, frame, labels, params, frame_key))
    free = view.free
    info = StepInfo(
        points_valid=seen.valid.sum(),
        points_in_range=seen.in_range.sum(),
        points_kept=labels.keep.sum(),
        voxels_hit=(hits > 0).sum(),
        voxels_freed=(free & (hits == 0)).sum() if free is not None else jnp.zeros((), jnp.int32),
        plane=seen.plane,
    )
    return fused, info


def _fuse_ensemble(
    design: _Design,
    voxel_map: VoxelMap,
    frame: Frame,
    labels: PointLabels,
    params: MapperParams,
    frame_key: PRNGKeyArray,
) -> Array:
    """The members of the ensemble, with the frame in each."""
    if params.ensemble is None or frame.pose_errors is None:
        raise JaxmapError(
            "the ensemble has no numbers to draw by",
            where="mapper",
            fix="fill MapperParams.ensemble and Frame.pose_errors",
        )
    classes, target = design.labeller.classes, design.rule.target(design.labeller.classes)
    assert target is not None
    site = Site(params.camera, voxel_map.grid, design.rule, design.reach, len(classes), classes.index(target))
    # Kept apart, so that the map comes out as it does without members.
    frame, labels = jax.lax.optimization_barrier((frame, labels))
    return fuse_members(voxel_map, frame, labels, site, params.ensemble, jax.random.fold_in(frame_key, _ENSEMBLE_DRAW))


def _label_image(
    design: _Design, frame: Frame, params: MapperParams, key: PRNGKeyArray, number: Int[Array, ""]
) -> UInt8[Array, "H W"]:
    """See `Mapper.label_image`."""
    labels = harden(_observe(design, frame, params, jax.random.fold_in(key, number)).labels)
    assert labels.labels is not None
    hard = jnp.where(labels.keep, labels.labels, IGNORE)
    return hard.astype(jnp.uint8).reshape(frame.disparity_px.shape)


class _Tensors(NamedTuple):
    """The large arrays of a map, by their names in it."""

    log_odds: Array
    members: Array | None


def _apart(voxel_map: VoxelMap) -> tuple[_Tensors, VoxelMap]:
    """The tensors of a map, and the map without them."""
    return _Tensors(voxel_map.log_odds, voxel_map.members), replace(voxel_map, log_odds=None, members=None)
