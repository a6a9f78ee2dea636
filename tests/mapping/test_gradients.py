"""Gradients of the whole step: they equal finite differences, and are finite where the data are not."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from strategies import CLASSES, HEIGHT_PX, WIDTH_PX, disparities

from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.fusion.query import class_probabilities, top_down
from jaxmap.labellers.files import make_files_labeller
from jaxmap.labellers.plane import make_plane_labeller
from jaxmap.mapping.step import Mapper, MapperParams, make_mapper
from jaxmap.types import Frame, VoxelMap, make_grid, make_stereo_camera

CAMERA = make_stereo_camera(
    fx_px=30, fy_px=28, cx_px=15.2, cy_px=11.7, baseline_m=0.3, doffs_px=0.4, width_px=WIDTH_PX, height_px=HEIGHT_PX
)
GRID = make_grid([-4, -3, -2], [4, 4, 3], 0.5)
PARAMS = MapperParams(
    CAMERA, make_fusion_params(CLASSES, occupancy_prior=0.4, class_prior=[0.3, 0.5, 0.6], disparity_sigma_px=0.1)
)
KEY = jax.random.key(0)
STEP = 1e-6


def soft_mapper(rule: FusionRule) -> Mapper:
    return make_mapper(CAMERA, GRID, make_files_labeller(CLASSES, soft=True), rule, (0.3, 4.0))


MAPPERS = {
    "own": soft_mapper(FusionRule()),
    "sum": soft_mapper(FusionRule("sum")),
    "paper": soft_mapper(FusionRule("majority", carve=False, range_weighting=False)),
}


def an_example_frame(disparity: np.ndarray | None = None) -> Frame:
    rng = np.random.default_rng(4)
    drawn = disparities(rng, low_px=3.0, high_px=4.0)
    pose = jaxlie.SE3.exp(jnp.asarray(rng.normal(0, 0.4, 6), jnp.float32))
    soft = rng.dirichlet(np.ones(3), (HEIGHT_PX, WIDTH_PX))
    return Frame(
        jnp.asarray(drawn if disparity is None else disparity, jnp.float32),
        pose,
        class_probabilities=jnp.asarray(soft, jnp.float32),
    )


def doubled(tree):
    """The same values with float64 leaves."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float64) if leaf.dtype == jnp.float32 else leaf, tree)


@partial(jax.jit, static_argnums=0)
def score(mapper: Mapper, params: MapperParams, voxel_map: VoxelMap, frame: Frame) -> jax.Array:
    """A smooth score of the map after the frame."""
    weight = np.random.default_rng(9).normal(size=voxel_map.log_odds.shape)
    voxel_map, _ = mapper.fuse(voxel_map, frame, params, KEY)
    classes = class_probabilities(voxel_map, params.fusion)
    return (weight * jnp.tanh(voxel_map.log_odds)).sum() + (weight[1:] * classes).sum()


gradient_of = jax.jit(jax.grad(score, argnums=1), static_argnums=0)


def named_leaves(tree) -> dict[str, np.ndarray]:
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


@pytest.mark.parametrize("name", ["own", *(pytest.param(name, marks=pytest.mark.slow) for name in ("paper", "sum"))])
def test_gradients_equal_finite_differences(name):
    with jax.enable_x64(True):
        mapper, params, frame = MAPPERS[name], doubled(PARAMS), doubled(an_example_frame())
        voxel_map = doubled(mapper.init())
        leaves, structure = jax.tree.flatten(params)
        gradients = jax.tree.leaves(gradient_of(mapper, params, voxel_map, frame))
        names = list(named_leaves(params))
        for place, leaf in enumerate(leaves):
            direction = np.random.default_rng(place).normal(size=leaf.shape)
            ahead, behind = (
                score(mapper, structure.unflatten([*leaves[:place], moved, *leaves[place + 1 :]]), voxel_map, frame)
                for moved in (leaf + STEP * direction, leaf - STEP * direction)
            )
            slope = (float(ahead) - float(behind)) / (2 * STEP)
            ours = float((gradients[place] * direction).sum())
            np.testing.assert_allclose(ours, slope, rtol=1e-4, atol=1e-5, err_msg=names[place])


def test_every_number_that_made_the_map_has_a_gradient():
    gradient = named_leaves(gradient_of(MAPPERS["own"], PARAMS, MAPPERS["own"].init(), an_example_frame()))
    # Where a voxel lies is no smooth function of the principal point; thresholds only decide.
    flat = {".camera.cx_px", ".camera.cy_px", ".camera.fy_px", ".fusion.occupancy_threshold", ".fusion.class_threshold"}
    assert {name for name, leaf in gradient.items() if not np.asarray(leaf).any()} == flat


HOLES = {"nan": np.nan, "zero": 0.0, "infinite": np.inf, "negative": -9.0, "tiny": 1e-30, "at infinity": -0.4}


@pytest.mark.parametrize("hole", HOLES.values(), ids=HOLES.keys())
@pytest.mark.parametrize("name", ["own", "paper"])
def test_no_gradient_is_nan_whatever_the_disparity(name, hole):
    disparity = disparities(np.random.default_rng(1), low_px=3.0)
    disparity[::2] = hole
    mapper, frame = MAPPERS[name], an_example_frame(disparity)
    params = replace(PARAMS, camera=replace(CAMERA, doffs_px=jnp.zeros(())))
    for one in (PARAMS, params):
        for leaf_name, leaf in named_leaves(gradient_of(mapper, one, mapper.init(), frame)).items():
            assert np.isfinite(leaf).all(), leaf_name


@pytest.mark.parametrize("scale", [0.0, 1e4])
def test_no_gradient_is_nan_in_empty_and_saturated_maps(scale):
    mapper = MAPPERS["own"]
    sign = np.sign(np.random.default_rng(0).normal(size=mapper.init().log_odds.shape))
    voxel_map = replace(mapper.init(), log_odds=jnp.asarray(scale * sign, jnp.float32))
    blind = np.full((HEIGHT_PX, WIDTH_PX), np.nan, np.float32)
    for frame in (an_example_frame(), an_example_frame(blind)):
        gradient = gradient_of(mapper, PARAMS, voxel_map, frame)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("column", ["sum", "max"])
@pytest.mark.parametrize("scale", [0.0, 1.0, 1e4])
def test_the_view_from_above_passes_finite_gradients(column, scale):
    empty = MAPPERS["own"].init()
    log_odds = jnp.asarray(scale * np.random.default_rng(0).normal(size=empty.log_odds.shape), jnp.float32)

    def rock_seen(log_odds, fusion):
        view = top_down(replace(empty, log_odds=log_odds), fusion, FusionRule(column=column))
        return jnp.where(view.observed, view.probability[2], 0.0).sum()

    gradient = jax.grad(rock_seen, argnums=(0, 1))(log_odds, PARAMS.fusion)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    if scale == 1.0:
        assert np.abs(gradient[0]).max() > 0


@pytest.mark.slow
@pytest.mark.parametrize("softness_m", [0.0, pytest.param(0.1, marks=pytest.mark.slow)])
def test_no_gradient_is_nan_with_the_plane_labeller(softness_m):
    labeller = make_plane_labeller(CLASSES, hypotheses=32, sample_points=256, softness_m=softness_m)
    mapper, params = (
        make_mapper(CAMERA, GRID, labeller, FusionRule(), (0.3, 4.0)),
        replace(PARAMS, labeller=labeller.params),
    )
    seen = replace(an_example_frame(), class_probabilities=None)
    blind = replace(seen, disparity_px=jnp.full_like(seen.disparity_px, jnp.nan))
    for frame in (seen, blind):
        gradient = gradient_of(mapper, params, mapper.init(), frame)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
        # A sharp threshold passes no gradient; a soft one does.
        numbers = gradient.labeller.numbers
        moved = [bool(np.asarray(numbers[name]).any()) for name in ("threshold_m", "softness_m")]
        assert moved == [softness_m > 0 and frame is seen] * 2
