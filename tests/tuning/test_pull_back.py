"""The pull-back of a map's loss: it is the gradient through the scan, whatever the frames and their order."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import scenes
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import small_camera

from jaxmap.errors import JaxmapError
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.fusion.query import class_probabilities, top_down
from jaxmap.labellers.files import make_files_labeller
from jaxmap.labellers.plane import make_plane_labeller
from jaxmap.labels import ROVER_CLASSES
from jaxmap.mapping.step import Mapper, MapperParams, make_mapper
from jaxmap.tuning.pull_back import make_pull_back, map_gradient
from jaxmap.types import Frame, VoxelMap, make_grid

EVERY_PX = 5
"""The scenes' pixels are taken so far apart: small frames of the same view."""

CAMERA = small_camera(EVERY_PX)
GRID = make_grid([-2.0, 0.0, -0.4], [2.0, 5.0, 1.2], 0.2)
DEPTH_RANGE_M = (0.3, 4.0)
FUSION = make_fusion_params(ROVER_CLASSES, occupancy_prior=0.4, class_prior=[0.3, 0.5, 0.6])
PARAMS = MapperParams(CAMERA, FUSION)
KEY = jax.random.key(3)
RULES = {
    "own": FusionRule(),
    "sum": FusionRule("sum", carve=False),
    "paper": FusionRule("majority", carve=False, range_weighting=False),
}
MAPPERS = {
    name: make_mapper(CAMERA, GRID, make_files_labeller(ROVER_CLASSES, soft=True), rule, DEPTH_RANGE_M)
    for name, rule in RULES.items()
}


def a_loss(voxel_map: VoxelMap, params: MapperParams) -> jax.Array:
    """A smooth score of the map, read with the parameters in two ways."""
    weight = np.random.default_rng(9).normal(size=voxel_map.log_odds.shape)
    view = top_down(voxel_map, params.fusion, FusionRule())
    seen = jnp.where(view.observed, view.probability, 0.0).sum()
    return (weight[1:] * class_probabilities(voxel_map, params.fusion)).sum() + seen / params.camera.baseline_m


PULL_BACKS = {name: make_pull_back(mapper, a_loss) for name, mapper in MAPPERS.items()}


@partial(jax.jit, static_argnums=0)
def through_the_scan(mapper: Mapper, frames: Frame, params: MapperParams) -> tuple[jax.Array, MapperParams]:
    """The twin: reverse mode through the scan."""

    def loss(params: MapperParams) -> jax.Array:
        return a_loss(mapper.scan(mapper.init(), frames, params, KEY)[0], params)

    return jax.value_and_grad(loss)(params)


def scene_frame(index: int, rng: np.random.Generator) -> Frame:
    """A view of the scene, with noisy disparity, holes, and soft labels."""
    seen = scenes.scene_frame(index)
    disparity_px = seen.disparity_px[::EVERY_PX, ::EVERY_PX] / EVERY_PX
    disparity_px = np.where(rng.random(disparity_px.shape) < 0.1, np.nan, disparity_px * rng.uniform(0.98, 1.02))
    labels = seen.labels[::EVERY_PX, ::EVERY_PX]
    soft = 0.5 * np.eye(3)[labels] + 0.5 * rng.dirichlet(np.ones(3), labels.shape)
    pose = jaxlie.SE3.from_matrix(jnp.asarray(seen.T_world_camera, jnp.float32))
    return Frame(jnp.asarray(disparity_px, jnp.float32), pose, class_probabilities=jnp.asarray(soft, jnp.float32))


@st.composite
def scene_frames(draw: st.DrawFn) -> list[Frame]:
    """Three frames, so that the scan is compiled once; some may be the same view."""
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    return [scene_frame(draw(st.integers(0, 4)), rng) for _ in range(3)]


def stacked(frames: list[Frame]) -> Frame:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *frames)


def gradient_of(name: str, frames: list[Frame]) -> tuple[float, MapperParams]:
    found = map_gradient(MAPPERS[name], frames, PARAMS, KEY, a_loss, pull_back=PULL_BACKS[name])
    return float(found.loss), found.gradient


def assert_close(ours: MapperParams, expected: MapperParams) -> None:
    for (path, leaf), other in zip(jax.tree_util.tree_leaves_with_path(ours), jax.tree.leaves(expected), strict=True):
        scale = max(1.0, float(np.abs(other).max()))
        np.testing.assert_allclose(leaf, other, rtol=2e-4, atol=2e-5 * scale, err_msg=jax.tree_util.keystr(path))


@pytest.mark.parametrize("name", ["own", *(pytest.param(name, marks=pytest.mark.slow) for name in ("paper", "sum"))])
@given(frames=scene_frames())
@settings(max_examples=5)
def test_it_is_the_gradient_through_the_scan(name, frames):
    expected_loss, expected = through_the_scan(MAPPERS[name], stacked(frames), PARAMS)
    loss, gradient = gradient_of(name, frames)
    np.testing.assert_allclose(loss, expected_loss, rtol=1e-5)
    assert_close(gradient, expected)
    assert any(np.asarray(leaf).any() for leaf in jax.tree.leaves(gradient.fusion))


@pytest.mark.slow
@given(frames=scene_frames(), order=st.permutations(range(3)))
@settings(max_examples=5)
def test_the_order_of_the_frames_does_not_matter(frames, order):
    loss, gradient = gradient_of("own", frames)
    other_loss, other = gradient_of("own", [frames[place] for place in order])
    np.testing.assert_allclose(loss, other_loss, rtol=1e-5)
    assert_close(gradient, other)


@pytest.mark.slow
def test_a_frame_labels_with_its_own_number():
    # The plane labeller draws with the number of the frame: what is pulled back must be what was fused.
    labeller = make_plane_labeller(ROVER_CLASSES, hypotheses=8, sample_points=64)
    mapper = make_mapper(CAMERA, GRID, labeller, FusionRule(), DEPTH_RANGE_M)
    rng = np.random.default_rng(0)
    frames = [replace(scene_frame(index, rng), class_probabilities=None) for index in range(3)]
    params = replace(PARAMS, labeller=labeller.params)
    loss, expected = through_the_scan(mapper, stacked(frames), params)
    found = map_gradient(mapper, frames, params, KEY, a_loss)
    np.testing.assert_allclose(found.loss, loss, rtol=1e-5)
    assert_close(found.gradient, expected)


def test_without_frames_only_reading_has_a_gradient():
    loss, gradient = gradient_of("own", [])
    assert float(loss) == pytest.approx(float(a_loss(MAPPERS["own"].init(), PARAMS)))
    reading = {".fusion.class_prior"}
    moved = {
        jax.tree_util.keystr(path)
        for path, leaf in jax.tree_util.tree_leaves_with_path(gradient)
        if np.asarray(leaf).any()
    }
    assert moved == reading

    def of_the_map(voxel_map: VoxelMap, params: MapperParams) -> jax.Array:
        return jnp.tanh(voxel_map.log_odds).sum()

    found = map_gradient(MAPPERS["own"], [], PARAMS, KEY, of_the_map)
    assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(found.gradient))
    assert found.voxel_map.frames_fused == 0


def test_what_can_be_gone_through_only_once_is_refused():
    with pytest.raises(JaxmapError, match="only once"):
        map_gradient(MAPPERS["own"], iter([]), PARAMS, KEY, a_loss)


def test_all_frames_share_one_program():
    traced = 0
    files = make_files_labeller(ROVER_CLASSES, soft=True)

    def label(*inputs):
        nonlocal traced
        traced += 1
        return files.label(*inputs)

    mapper = make_mapper(CAMERA, GRID, files._replace(label=label), FusionRule(), DEPTH_RANGE_M)
    pull_back = make_pull_back(mapper, a_loss)
    rng = np.random.default_rng(1)
    after = []
    for count in (1, 4):
        frames = [scene_frame(index, rng) for index in range(count)]
        map_gradient(mapper, frames, PARAMS, KEY, a_loss, pull_back=pull_back)
        after.append(traced)
    assert after[0] == after[1]


@pytest.mark.slow
def test_a_frame_takes_the_memory_of_its_window_however_large_the_map():
    taken, room = [], []
    for reach_m in (10.0, 40.0):
        grid = make_grid([-reach_m, -reach_m, -0.4], [reach_m, reach_m, 1.2], 0.2)
        mapper = make_mapper(CAMERA, grid, make_files_labeller(ROVER_CLASSES, soft=True), FusionRule(), DEPTH_RANGE_M)
        frame, voxel_map = scene_frame(0, np.random.default_rng(0)), mapper.init()
        lowered = make_pull_back(mapper, a_loss).lower(PARAMS, voxel_map.log_odds, frame, PARAMS, KEY, 0)
        taken.append(lowered.compile().memory_analysis().temp_size_in_bytes)
        room.append(voxel_map.log_odds.nbytes)
    assert room[1] > 15 * room[0]
    assert taken[1] < 1.05 * taken[0] < room[1]
