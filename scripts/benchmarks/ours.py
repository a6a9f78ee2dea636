"""What is timed of jaxmap: the one place where the benchmarks call its functions.

Each function prepares one thing, compiles it and gives back how to run it.
"""

from __future__ import annotations

import copy
import itertools
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from golden.seeded_weights import seeded_state_of
from safetensors.numpy import save_file

from benchmarks.scene import DEPTH_RANGE_M, DISPARITIES, Scene, grid_of, moved_poses
from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.fusion.carve import carve
from jaxmap.fusion.integrate import integrate
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.fusion.view import Reach, view_of
from jaxmap.geometry.camera import disparity_to_points, transform_points
from jaxmap.geometry.grid import view_window, window_shape
from jaxmap.geometry.plane import fit_plane_mlesac
from jaxmap.labellers.base import Labeller, make_no_labeller
from jaxmap.labellers.deeplab import make_deeplab_labeller
from jaxmap.labellers.plane import make_plane_labeller
from jaxmap.labels import ROVER_CLASSES
from jaxmap.mapping.sequence import prepare_frames, run_sequence
from jaxmap.mapping.step import Mapper, MapperParams, compile_step, make_mapper
from jaxmap.models.checkpoint import SavedModel
from jaxmap.models.importers import import_weights
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import StereoOptions
from jaxmap.types import Frame, GridSpec, PointLabels, VoxelMap, make_voxel_map

BACKBONE = "mobilenet_v2"
NETWORK_PX = (384, 512)
"""Height and width that the network sees."""
UP = (0.0, 0.0, 1.0)
RULE = FusionRule()


@dataclass
class Prepared:
    """Something compiled: how to run it, what compiling took, and the result of the last run."""

    run: Callable[[], object]
    compile_s: float | None = None
    temporary_bytes: int | None = None
    result: Any = None


def prepare(function: Callable[..., Any], *arguments: Any) -> Prepared:
    """Compiles a pure function for these arguments."""
    executable, compile_s, temporary_bytes = _compile(jax.jit(function).lower(*arguments))
    prepared = Prepared(lambda: None, compile_s, temporary_bytes)

    def run() -> None:
        prepared.result = jax.block_until_ready(executable(*arguments))

    prepared.run = run
    return prepared


def prepare_update(function: Callable[..., Any], tensor: jax.Array, *arguments: Any) -> Prepared:
    """Compiles an update of a tensor, which is donated; the runs go on with it, and it is their result."""
    executable, compile_s, temporary_bytes = _compile(jax.jit(function, donate_argnums=0).lower(tensor, *arguments))
    prepared = Prepared(lambda: None, compile_s, temporary_bytes, tensor)

    def run() -> None:
        prepared.result = jax.block_until_ready(executable(prepared.result, *arguments))

    prepared.run = run
    return prepared


def _compile(lowered: jax.stages.Lowered) -> tuple[jax.stages.Compiled, float, int]:
    started_s = time.perf_counter()
    executable = lowered.compile()
    compile_s = time.perf_counter() - started_s
    memory = executable.memory_analysis()
    return executable, compile_s, memory.temp_size_in_bytes if memory else 0


@dataclass(frozen=True)
class Points:
    """The points of a frame as fusion takes them."""

    points_world: jax.Array
    labels: PointLabels
    depth_m: jax.Array
    valid: jax.Array


def project(scene: Scene) -> Prepared:
    """Disparity to points in the world."""

    def points(camera: Any, pose: jaxlie.SE3, disparity_px: jax.Array) -> tuple[jax.Array, jax.Array]:
        points_camera, valid = disparity_to_points(camera, disparity_px)
        return transform_points(pose, points_camera), valid

    return prepare(points, scene.camera, scene.pose, jnp.asarray(scene.disparity_px))


@cache
def points_of(scene: Scene) -> Points:
    """The points of the scene's frame; those above 0.3 m are rock, the others sand."""
    points_camera, valid = disparity_to_points(scene.camera, jnp.asarray(scene.disparity_px))
    points_world = transform_points(scene.pose, points_camera).reshape(-1, 3)
    depth_m = points_camera[..., 2]
    keep = (valid & (depth_m >= DEPTH_RANGE_M[0]) & (depth_m <= DEPTH_RANGE_M[1])).reshape(-1)
    classes = jnp.where(points_world[:, 2] > 0.3, ROVER_CLASSES.index("rock"), ROVER_CLASSES.index("sand"))
    return Points(points_world, PointLabels(keep, labels=classes.astype(jnp.int32)), depth_m, valid)


def fit_plane(points: np.ndarray, hypotheses: int) -> tuple[Callable[[], np.ndarray], Prepared]:
    """MLESAC on a cloud, each fit with another key: a function that gives (4,) `normal . p + offset`; and its cost."""

    def fit(key: jax.Array, points: jax.Array, valid: jax.Array) -> jax.Array:
        plane = fit_plane_mlesac(key, points, valid, up_hint=jnp.array(UP), hypotheses=hypotheses)
        return jnp.append(plane.normal, plane.offset_m)

    keys = itertools.cycle(list(jax.random.split(jax.random.key(0), 64)))
    arguments = (jnp.asarray(points, jnp.float32), jnp.ones(len(points), bool))
    executable, compile_s, temporary_bytes = _compile(jax.jit(fit).lower(next(keys), *arguments))

    def fitted() -> np.ndarray:
        return np.asarray(executable(next(keys), *arguments))

    return fitted, Prepared(fitted, compile_s, temporary_bytes)


def window_of(scene: Scene, size: str) -> GridSpec:
    """The part of the grid that the scene's frame can touch."""
    grid = grid_of(size)
    shape = window_shape(grid, scene.camera, DEPTH_RANGE_M[1], moved_poses(scene, 1))
    return view_window(grid, scene.camera, scene.pose, DEPTH_RANGE_M[1], shape).grid


def carve_frame(scene: Scene, window: GridSpec) -> Prepared:
    """Free space in the window of a frame."""
    points, params = points_of(scene), make_fusion_params(ROVER_CLASSES)

    def free(pose: jaxlie.SE3, depth_m: jax.Array, valid: jax.Array, window: GridSpec) -> jax.Array:
        return carve(scene.camera, pose, depth_m, valid, window, params, depth_range_m=DEPTH_RANGE_M)

    return prepare(free, scene.pose, points.depth_m, points.valid, window)


def integrate_frame(scene: Scene, grid: GridSpec) -> Prepared:
    """The points of a frame into a map of their window, without carving."""
    points, params = points_of(scene), make_fusion_params(ROVER_CLASSES)
    empty = make_voxel_map(grid, ROVER_CLASSES)
    rest, weights = replace(empty, log_odds=None), jnp.ones(scene.pixels)

    def add(log_odds: jax.Array, rest: VoxelMap, points_world: jax.Array, labels: PointLabels, weights: Any) -> Any:
        voxel_map = replace(rest, log_odds=log_odds)
        return integrate(voxel_map, points_world, labels, weights, params, RULE)[0].log_odds

    return prepare_update(add, empty.log_odds, rest, points.points_world, points.labels, weights)


def fuse_frame(scene: Scene, size: str) -> Prepared:
    """Carving and integration of one frame, as the step does them; the result is the map's tensor."""
    points, params, grid = points_of(scene), make_fusion_params(ROVER_CLASSES), grid_of(size)
    empty = make_voxel_map(grid, ROVER_CLASSES)
    reach = Reach(DEPTH_RANGE_M, window_shape(grid, scene.camera, DEPTH_RANGE_M[1], moved_poses(scene, 1)))

    def fuse(log_odds: jax.Array, rest: VoxelMap, points: tuple[Any, ...], pose: jaxlie.SE3) -> jax.Array:
        voxel_map, (points_world, labels, depth_m, valid) = replace(rest, log_odds=log_odds), points
        view = view_of(grid, scene.camera, pose, depth_m, valid, params, RULE, reach)
        fused, _ = integrate(
            voxel_map, points_world, labels, view.weights, params, RULE, window=view.window, free=view.free
        )
        return fused.log_odds

    given = (points.points_world, points.labels, points.depth_m, points.valid)
    return prepare_update(fuse, empty.log_odds, replace(empty, log_odds=None), given, scene.pose)


@cache
def network_model() -> SavedModel:
    """DeepLabv3+ on MobileNetV2 as segmentation_models_pytorch builds it, with the weights that the peers have too."""
    with tempfile.TemporaryDirectory() as folder:
        save_file(seeded_state_of(BACKBONE), Path(folder) / "smp.safetensors")
        imported = import_weights(Path(folder) / "smp.safetensors")
    weights = {name: jnp.asarray(value) for name, value in imported.weights.items()}
    return SavedModel(imported.architecture, weights, imported.holds)


@cache
def labeller_of(name: str) -> Labeller:
    """The labellers by name; `deeplab` sees 384 x 512."""
    if name == "deeplab":
        return make_deeplab_labeller(network_model(), size_px=NETWORK_PX)
    return make_plane_labeller(ROVER_CLASSES) if name == "plane" else make_no_labeller()


def label_pixels(scene: Scene, size_px: tuple[int, int]) -> Prepared:
    """The network alone: class probabilities of all pixels of the scene's image, seen at `size_px` (height, width)."""
    labeller = make_deeplab_labeller(network_model(), size_px=size_px)
    frame = Frame(jnp.asarray(scene.disparity_px), scene.pose, image=jnp.asarray(scene.left))
    nowhere, valid = jnp.zeros((scene.pixels, 3)), jnp.ones(scene.pixels, bool)

    def probabilities(params: Any, frame: Frame) -> jax.Array | None:
        labels, _ = labeller.label(frame, nowhere, valid, params, jax.random.key(0))
        return labels.probabilities

    return prepare(probabilities, labeller.params, frame)


def mapper_of(scene: Scene, labeller: Labeller, size: str) -> tuple[Mapper, MapperParams]:
    """A mapper with the default numbers, for a drive along which the camera is never turned (`moved_poses`)."""
    mapper = make_mapper(
        scene.camera, grid_of(size), labeller, RULE, DEPTH_RANGE_M, T_world_camera=moved_poses(scene, 1)
    )
    return mapper, MapperParams(scene.camera, make_fusion_params(labeller.classes), labeller.params)


class Step:
    """The compiled step on the scene's frame, into a map that it goes on filling."""

    def __init__(self, scene: Scene, labeller: Labeller, size: str) -> None:
        """Compiles it."""
        self.mapper, self.params = mapper_of(scene, labeller, size)
        self.key, self.voxel_map = jax.random.key(0), self.mapper.init()
        image = jnp.asarray(scene.left) if labeller.needs == "image" else None
        self.frame = Frame(jnp.asarray(scene.disparity_px), scene.pose, image=image)
        self.mapper, cost = compile_step(self.mapper, self.voxel_map, self.frame, self.params, self.key)
        self.compile_s, self.temporary_bytes, self.scene = cost.compile_s, cost.temporary_bytes, scene

    def __call__(self) -> None:
        """Fuses the frame once more."""
        self.voxel_map, _ = self.mapper.step(self.voxel_map, self.frame, self.params, self.key)
        jax.block_until_ready(self.voxel_map.log_odds)

    def afresh(self) -> Step:
        """The same program with an empty map."""
        other = copy.copy(self)
        other.voxel_map = self.mapper.init()
        return other

    def drive(self, frames: int) -> None:
        """Fuses so many frames along a drive."""
        for matrix in moved_poses(self.scene, frames):
            pose = jaxlie.SE3.from_matrix(jnp.asarray(matrix, jnp.float32))
            frame = replace(self.frame, T_world_camera=pose)
            self.voxel_map, _ = self.mapper.step(self.voxel_map, frame, self.params, self.key)
        jax.block_until_ready(self.voxel_map.log_odds)


def map_sequence(scene: Scene, folder: Path, frames: int, size: str) -> Prepared:
    """A whole sequence into an empty map, as `jaxmap map` does it: read, match, label by the network, carve, fuse."""
    sequence = open_sequence(folder, ReadOptions(stop=frames))
    labeller = labeller_of("deeplab")
    front_end = StereoFrontEnd(scene.camera, StereoOptions(num_disparities=DISPARITIES))
    mapper, params = mapper_of(scene, labeller, size)
    key = jax.random.key(0)

    first = next(iter(prepare_frames(sequence, front_end, needs=labeller.needs)))
    assert first.frame is not None
    executable, compile_s, temporary_bytes = _compile(mapper.lower(mapper.init(), first.frame, params, key))
    # `run_sequence` compiles with its first frame: here it gets the program ready made, so that runs time mapping.
    mapper = mapper._replace(lower=lambda *arguments: _Ready(executable))

    def run() -> None:
        frames = prepare_frames(sequence, front_end, needs=labeller.needs)
        for voxel_map, _ in run_sequence(mapper, mapper.init(), frames, params, key):
            jax.block_until_ready(voxel_map.log_odds)

    return Prepared(run, compile_s, temporary_bytes)


@dataclass(frozen=True)
class _Ready:
    """A lowered program that was compiled before."""

    executable: jax.stages.Compiled

    def compile(self) -> jax.stages.Compiled:
        return self.executable
