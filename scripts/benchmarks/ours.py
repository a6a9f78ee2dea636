"""What is timed of jaxmap: the one place where the benchmarks call its lower-level functions.

Each function prepares one thing, compiles it and returns how to run it.
"""

from __future__ import annotations

import copy
import itertools
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optax
from harness import timed
from scene import DEPTH_RANGE_M, DISPARITIES, Scene, grid_of, moved_poses

from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.fusion.carve import carve
from jaxmap.fusion.frame import Sighting
from jaxmap.fusion.integrate import integrate
from jaxmap.fusion.kernel import add_sighting
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.fusion.query import top_down
from jaxmap.geometry import cloud as geometry
from jaxmap.geometry.grid import view_window, window_shape
from jaxmap.geometry.plane import fit_plane_mlesac
from jaxmap.geometry.relief import relief_of
from jaxmap.labellers.base import Labeller, label_points, make_no_labeller
from jaxmap.labellers.deeplab import make_deeplab_labeller
from jaxmap.labellers.files import make_files_labeller
from jaxmap.labellers.plane import make_plane_labeller
from jaxmap.labels import ROVER_CLASSES
from jaxmap.mapping.sequence import prepare_frames, run_sequence
from jaxmap.mapping.step import Mapper, MapperParams, compile_step, make_mapper
from jaxmap.models.architecture import torch_architecture
from jaxmap.models.checkpoint import SavedModel
from jaxmap.models.network import Weights, inference_network, initial_weights, training_form
from jaxmap.profiling.program import read_program
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import StereoOptions
from jaxmap.training.losses import total_loss
from jaxmap.training.options import PixelLossOptions
from jaxmap.training.step import is_statistic
from jaxmap.tuning.pull_back import make_pull_back, map_gradient
from jaxmap.types import Frame, GridSpec, PointLabels, StereoCamera, VoxelMap, make_grid, make_voxel_map

NETWORK_PX = (384, 512)
"""Height and width that the network sees."""
KEY = jax.random.key(0)
SIGMA_PX = 0.5
"""Standard deviation of disparity."""
RULE = FusionRule()


@dataclass
class Prepared:
    """Something compiled: how to run it, the time of compilation, its temporary memory, and the last result."""

    run: Callable[[], object]
    compile_s: float | None = None
    temporary_bytes: int | None = None
    result: Any = None


def prepare(function: Callable[..., Any], *arguments: Any) -> Prepared:
    """Compiles a pure function for these arguments."""
    executable, compile_s, temporary_bytes = _compile(jax.jit(function).lower(*arguments))
    return Prepared(lambda: jax.block_until_ready(executable(*arguments)), compile_s, temporary_bytes)


def prepare_update(function: Callable[..., Any], tensor: Any, *arguments: Any) -> Prepared:
    """Compiles an update of arrays, which are donated: each run updates the result of the one before."""
    executable, compile_s, temporary_bytes = _compile(jax.jit(function, donate_argnums=0).lower(tensor, *arguments))
    prepared = Prepared(lambda: None, compile_s, temporary_bytes, tensor)

    def run() -> None:
        prepared.result = jax.block_until_ready(executable(prepared.result, *arguments))

    prepared.run = run
    return prepared


def _compile(lowered: jax.stages.Lowered) -> tuple[jax.stages.Compiled, float, int]:
    started_s = time.perf_counter()
    executable = lowered.compile()
    memory = executable.memory_analysis()
    return executable, time.perf_counter() - started_s, memory.temp_size_in_bytes if memory else 0


class Points(NamedTuple):
    """The points of a frame as fusion takes them."""

    cloud: geometry.PointCloud
    labels: PointLabels


def project(scene: Scene) -> Prepared:
    """Disparity to points in the world."""

    def points(camera: Any, pose: jaxlie.SE3, disparity_px: jax.Array) -> tuple[jax.Array, jax.Array]:
        cloud = geometry.project(camera, pose, disparity_px, DEPTH_RANGE_M, SIGMA_PX)
        return cloud.points_world, cloud.valid

    return prepare(points, scene.camera, scene.pose, jnp.asarray(scene.disparity_px))


@cache
def points_of(scene: Scene) -> Points:
    """The points of the scene's frame; those above 0.3 m are rock, the others sand."""
    cloud = geometry.project(scene.camera, scene.pose, jnp.asarray(scene.disparity_px), DEPTH_RANGE_M, SIGMA_PX)
    classes = jnp.where(cloud.points_world[:, 2] > 0.3, ROVER_CLASSES.index("rock"), ROVER_CLASSES.index("sand"))
    return Points(cloud, PointLabels(cloud.in_range.reshape(-1), labels=classes.astype(jnp.int32)))


def relief(scene: Scene) -> Prepared:
    """The relief of the scene's frame."""
    up_camera = jnp.asarray(scene.T_world_camera[2, :3], jnp.float32)
    return prepare(relief_of, scene.camera, up_camera, jnp.asarray(scene.disparity_px))


def fit_plane(points: np.ndarray, hypotheses: int) -> Prepared:
    """MLESAC on a cloud, each run with another key; a run returns the plane (4,) `normal . p + offset = 0`."""

    def fit(key: jax.Array, points: jax.Array, valid: jax.Array) -> jax.Array:
        plane = fit_plane_mlesac(key, points, valid, up_hint=jnp.array((0.0, 0.0, 1.0)), hypotheses=hypotheses)
        return jnp.append(plane.normal, plane.offset_m)

    keys = itertools.cycle(list(jax.random.split(KEY, 64)))
    arguments = (jnp.asarray(points, jnp.float32), jnp.ones(len(points), bool))
    executable, compile_s, temporary_bytes = _compile(jax.jit(fit).lower(next(keys), *arguments))
    return Prepared(lambda: np.asarray(executable(next(keys), *arguments)), compile_s, temporary_bytes)


def window_of(scene: Scene, size: str) -> GridSpec:
    """The part of the grid that the scene's frame can touch."""
    grid = grid_of(size)
    shape = window_shape(grid, scene.camera, DEPTH_RANGE_M[1], moved_poses(scene, 1))
    return view_window(grid, scene.camera, scene.pose, DEPTH_RANGE_M[1], shape)


def carve_frame(scene: Scene, window: GridSpec) -> Prepared:
    """Free space in the window of a frame."""
    points, params = points_of(scene), make_fusion_params(ROVER_CLASSES)

    def free(pose: jaxlie.SE3, depth_m: jax.Array, valid: jax.Array, window: GridSpec) -> jax.Array:
        return carve(scene.camera, pose, depth_m, valid, window, params, depth_range_m=DEPTH_RANGE_M)

    return prepare(free, scene.pose, points.cloud.depth_m, points.cloud.valid, window)


def integrate_frame(scene: Scene, grid: GridSpec) -> Prepared:
    """The points of one frame into a map of their window, without carving."""
    params, empty = make_fusion_params(ROVER_CLASSES), make_voxel_map(grid, ROVER_CLASSES)

    def add(log_odds: jax.Array, rest: VoxelMap, points: Points, weights: jax.Array) -> jax.Array:
        voxel_map = replace(rest, log_odds=log_odds)
        return integrate(voxel_map, points.cloud.points_world, points.labels, weights, params, RULE)[0].log_odds

    rest = replace(empty, log_odds=None)
    return prepare_update(add, empty.log_odds, rest, points_of(scene), jnp.ones(scene.pixels))


def fuse_frame(scene: Scene, size: str, add: Callable[..., Any] = add_sighting) -> Prepared:
    """Projection, carving and integration of one frame, as the step does them; the result is the map's tensor.

    Args:
        scene: the frame.
        size: of the voxels.
        add: `kernel.add_sighting`, or its twin `frame.add_plainly`.
    """
    params, grid = make_fusion_params(ROVER_CLASSES), grid_of(size)
    empty = make_voxel_map(grid, ROVER_CLASSES)
    shape = window_shape(grid, scene.camera, DEPTH_RANGE_M[1], moved_poses(scene, 1))

    def fuse(
        log_odds: jax.Array, rest: VoxelMap, disparity_px: jax.Array, labels: PointLabels, pose: jaxlie.SE3
    ) -> Any:
        window = view_window(rest.grid, scene.camera, pose, DEPTH_RANGE_M[1], shape)
        sighting = Sighting(scene.camera, pose, disparity_px, labels)
        return add(replace(rest, log_odds=log_odds), sighting, window, params, RULE, DEPTH_RANGE_M)[0].log_odds

    seen = (jnp.asarray(scene.disparity_px), points_of(scene).labels, scene.pose)
    return prepare_update(fuse, empty.log_odds, replace(empty, log_odds=None), *seen)


@cache
def network_model(backbone: str = "mobilenet_v2") -> SavedModel:
    """DeepLabv3+ in the design of segmentation_models_pytorch, with initial weights."""
    architecture = torch_architecture(backbone, ROVER_CLASSES)
    return SavedModel(architecture, initial_weights(architecture, KEY), "network")


def logits(backbone: str, images: np.ndarray) -> tuple[Prepared, float]:
    """The network as `jaxmap segment` runs it on uint8 (B, H, W, 3), and its GFLOP."""
    model = network_model(backbone)
    network = inference_network(model.architecture, model.weights)
    executable, compile_s, temporary_bytes = _compile(jax.jit(network.apply).lower(network.weights, images))
    prepared = Prepared(lambda: executable(network.weights, images).block_until_ready(), compile_s, temporary_bytes)
    return prepared, sum(one.flops for one in read_program(executable.as_text()).values()) / 1e9


def training_step(images: np.ndarray, labels: np.ndarray) -> Prepared:
    """Forward, backward and AdamW on images uint8 (B, H, W, 3) and labels (B, H, W); batch norm by the batch."""
    model = network_model()
    # The peers are timed without dropout.
    network = training_form(replace(model.architecture, dropout=0.0), ("backbone", "aspp", "decoder"))
    optimiser = optax.adamw(1e-3, weight_decay=1e-4)

    def loss(trained: Weights, fixed: Weights) -> tuple[jax.Array, Weights]:
        logits, statistics = network({**trained, **fixed}, images, KEY)
        return total_loss(logits, labels, jnp.ones(logits.shape[-1]), PixelLossOptions()), statistics

    def step(state: tuple[Weights, Weights, Any]) -> tuple[Weights, Weights, Any]:
        trained, fixed, memory = state
        gradient, statistics = jax.grad(loss, has_aux=True)(trained, fixed)
        updates, memory = optimiser.update(gradient, memory, trained)
        return optax.apply_updates(trained, updates), {**fixed, **statistics}, memory

    trained = {name: jnp.array(value) for name, value in model.weights.items() if not is_statistic(name)}
    fixed = {name: jnp.array(value) for name, value in model.weights.items() if is_statistic(name)}
    return prepare_update(step, (trained, fixed, optimiser.init(trained)))


def product_rate() -> float:
    """GFLOP/s of a float32 product of matrices, the best of several: what this machine reaches."""
    size = 1024
    left = jnp.ones((size, size))
    prepared = prepare(jnp.dot, left, left)
    return 2e-9 * size**3 / min(timed(prepared.run) for _ in range(15))


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
    cloud = points_of(scene).cloud

    def probabilities(params: Any, frame: Frame) -> jax.Array | None:
        return label_points(labeller, frame, cloud, params, KEY)[0].probabilities

    return prepare(probabilities, labeller.params, frame)


def mapper_of(scene: Scene, labeller: Labeller, size: str) -> tuple[Mapper, MapperParams]:
    """A mapper with the default numbers, for a drive along which the camera is never turned (`moved_poses`)."""
    mapper = make_mapper(
        scene.camera, grid_of(size), labeller, RULE, DEPTH_RANGE_M, T_world_camera=moved_poses(scene, 1)
    )
    return mapper, MapperParams(scene.camera, make_fusion_params(labeller.classes), labeller.params)


class Step:
    """The compiled step on the scene's frame; each call fuses it into the same map once more."""

    def __init__(self, scene: Scene, labeller: Labeller, size: str) -> None:
        """Compiles it."""
        self.mapper, self.params = mapper_of(scene, labeller, size)
        self.voxel_map = self.mapper.init()
        image = jnp.asarray(scene.left) if labeller.needs == "image" else None
        self.frame = Frame(jnp.asarray(scene.disparity_px), scene.pose, image=image)
        self.mapper, cost = compile_step(self.mapper, self.voxel_map, self.frame, self.params, KEY)
        self.compile_s, self.temporary_bytes = cost.compile_s, cost.temporary_bytes

    def __call__(self) -> None:
        """Fuses the frame once more."""
        self.voxel_map, _ = self.mapper.step(self.voxel_map, self.frame, self.params, KEY)
        jax.block_until_ready(self.voxel_map.log_odds)

    def afresh(self) -> Step:
        """The same program with an empty map."""
        other = copy.copy(self)
        other.voxel_map = self.mapper.init()
        return other

    def drive(self, poses: np.ndarray) -> None:
        """Fuses the frame at each of these poses (N, 4, 4)."""
        for matrix in poses:
            frame = replace(self.frame, T_world_camera=jaxlie.SE3.from_matrix(jnp.asarray(matrix, jnp.float32)))
            self.voxel_map, _ = self.mapper.step(self.voxel_map, frame, self.params, KEY)
        jax.block_until_ready(self.voxel_map.log_odds)


def map_sequence(scene: Scene, folder: Path, frames: int, size: str) -> Prepared:
    """A whole sequence into an empty map, as `jaxmap map` does it: read, match, label by the network, carve, fuse."""
    sequence = open_sequence(folder, ReadOptions(stop=frames))
    labeller = labeller_of("deeplab")
    front_end = StereoFrontEnd(scene.camera, StereoOptions(num_disparities=DISPARITIES))
    mapper, params = mapper_of(scene, labeller, size)
    first = next(iter(prepare_frames(sequence, front_end, needs=labeller.needs)))
    executable, compile_s, temporary_bytes = _compile(mapper.lower(mapper.init(), first.frame, params, KEY))
    # `run_sequence` compiles with its first frame: here it gets the compiled program, so that runs time mapping alone.
    mapper = mapper._replace(lower=lambda *arguments: SimpleNamespace(compile=lambda: executable))

    def run() -> None:
        frames = prepare_frames(sequence, front_end, needs=labeller.needs)
        for voxel_map, _ in run_sequence(mapper, mapper.init(), frames, params, KEY):
            jax.block_until_ready(voxel_map.log_odds)

    return Prepared(run, compile_s, temporary_bytes)


def _scored_mapper(camera: StereoCamera) -> tuple[Mapper, MapperParams]:
    """A mapper of frames with soft labels into 8 x 12 x 1.4 m, and its parameters."""
    grid = make_grid([-4, -1, -0.4], [4, 11, 1.0], (0.1, 0.1, 0.2))
    mapper = make_mapper(camera, grid, make_files_labeller(ROVER_CLASSES, soft=True), RULE, (0.3, 6.0))
    return mapper, MapperParams(camera, make_fusion_params(ROVER_CLASSES))


def _rock_score(voxel_map: VoxelMap, params: MapperParams) -> jax.Array:
    """The probability of rock, summed over the map's columns."""
    top = top_down(voxel_map, params.fusion, RULE)
    return jnp.where(top.observed, top.probability[ROVER_CLASSES.index("rock")], 0.0).sum()


def gradient_by_pull_back(camera: StereoCamera, frames: Iterable[Frame]) -> tuple[Any, int]:
    """The gradient of the map's score in all parameters, and the bytes of temporary memory that the compiler counts."""
    mapper, params = _scored_mapper(camera)
    functions = make_pull_back(mapper, _rock_score)
    lowered = functions.lower(params, mapper.init().log_odds, next(iter(frames)), params, KEY, 0)
    temporary_bytes = lowered.compile().memory_analysis().temp_size_in_bytes
    return map_gradient(mapper, frames, params, KEY, _rock_score, pull_back=functions).gradient, temporary_bytes


def gradient_by_scan(camera: StereoCamera, frames: Frame) -> tuple[Any, int]:
    """The same by reverse mode through the scan; the frames lie in memory side by side."""
    mapper, params = _scored_mapper(camera)

    def loss(params: MapperParams, frames: Frame) -> jax.Array:
        return _rock_score(mapper.scan(mapper.init(), frames, params, KEY)[0], params)

    compiled = jax.jit(jax.grad(loss)).lower(params, frames).compile()
    return compiled(params, frames), compiled.memory_analysis().temp_size_in_bytes
