"""The cache: what it fuses is what the mapper fuses, its gradients are true, and thinning hardly changes it."""

from __future__ import annotations

from functools import cache, partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from networks import small_model
from strategies import CLASSES, HEIGHT_PX, WIDTH_PX, disparities

from jaxmap.errors import JaxmapError
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.labellers.base import Labeller, make_no_labeller
from jaxmap.labellers.deeplab import make_deeplab_labeller
from jaxmap.labellers.files import make_files_labeller
from jaxmap.labellers.plane import make_plane_labeller
from jaxmap.mapping.step import MapperParams, make_mapper
from jaxmap.tuning.evidence_cache import (
    CacheRecipe,
    EvidenceCache,
    build_cache,
    fused_evidence,
    map_of_cache,
    tunable_numbers,
)
from jaxmap.tuning.parametrisation import TunedParams, constrained, unconstrained
from jaxmap.types import Frame, make_grid, make_stereo_camera

CAMERA = make_stereo_camera(
    fx_px=30, fy_px=28, cx_px=15.2, cy_px=11.7, baseline_m=0.3, doffs_px=0.4, width_px=WIDTH_PX, height_px=HEIGHT_PX
)
GRID = make_grid([-4, -3, -2], [4, 4, 3], 0.5)
RANGE_M = (0.3, 4.0)
FUSION = make_fusion_params(
    CLASSES, occupancy_prior=0.4, class_prior=[0.3, 0.5, 0.6], disparity_sigma_px=0.1, full_evidence_points=3.0
)
KEY = jax.random.key(3)
STEP = 1e-6

LABELLERS = {
    "hard": make_files_labeller(CLASSES, soft=False),
    "soft": make_files_labeller(CLASSES, soft=True),
    "plane": make_plane_labeller(CLASSES, softness_m=0.1, threshold_m=0.3, hypotheses=32, sample_points=256),
    "network": make_deeplab_labeller(
        small_model(), CLASSES, class_map={"sky": "background", "gravel": "sand", "boulder": "rock"}, temperature=1.5
    ),
}
RULES = {
    "own": FusionRule(),
    "sum": FusionRule("sum", carve=False, range_weighting=False),
    "paper": FusionRule("majority", range_weighting=False),
}


def frames_of(labeller: Labeller, count: int = 3) -> list[Frame]:
    """Random frames, with holes, that carry what the labeller needs."""
    rng, frames = np.random.default_rng(4), []
    for _ in range(count):
        made = {
            "image": rng.integers(0, 255, (HEIGHT_PX, WIDTH_PX, 3), np.uint8),
            "labels": rng.choice([0, 1, 2, 255], size=(HEIGHT_PX, WIDTH_PX)).astype(np.uint8),
            "class_probabilities": rng.dirichlet(np.ones(4), (HEIGHT_PX, WIDTH_PX))[..., :3].astype(np.float32),
        }
        pose = jaxlie.SE3.exp(jnp.asarray(rng.normal(0, 0.4, 6), jnp.float32))
        needed = {} if labeller.needs is None else {labeller.needs: jnp.asarray(made[labeller.needs])}
        disparity = disparities(rng, low_px=2.0, high_px=5.0)
        disparity[rng.random(disparity.shape) < 0.1] = 0.0
        frames.append(Frame(jnp.asarray(disparity, jnp.float32), pose, **needed))
    return frames


def recipe_of(labeller: Labeller, rule: FusionRule) -> CacheRecipe:
    return CacheRecipe(CAMERA, GRID, labeller, rule, RANGE_M)


def numbers_of(recipe: CacheRecipe) -> dict[str, jax.Array]:
    return tunable_numbers(recipe.labeller, recipe.rule)


LONG = ("plane", "network")
"""Their programs take long to compile."""
SOFT_FIRST = [pytest.param(name, marks=[] if name == "soft" else [pytest.mark.slow]) for name in LABELLERS]
NAMES = [pytest.param(name, marks=[pytest.mark.slow] if name in LONG else []) for name in LABELLERS]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("rule", RULES)
def test_it_fuses_what_the_mapper_fuses(name, rule):
    labeller, rule = LABELLERS[name], RULES[rule]
    recipe, frames = recipe_of(labeller, rule), frames_of(labeller)
    params = MapperParams(CAMERA, FUSION, labeller.params)
    mapper = make_mapper(CAMERA, GRID, labeller, rule, RANGE_M)
    voxel_map = mapper.init()
    for frame in frames:
        voxel_map, info = mapper.step(voxel_map, frame, params, KEY)
        assert int(info.voxels_hit) > 0
    kept = build_cache(recipe, frames, params, KEY, block_px=1)
    ours = map_of_cache(recipe, kept, fused_evidence(recipe, kept, FUSION, numbers_of(recipe)))
    hit = np.zeros(GRID.shape, bool)
    hit.reshape(-1)[np.asarray(kept.voxel)] = True
    np.testing.assert_allclose(
        np.where(hit, ours.log_odds, 0), np.where(hit, voxel_map.log_odds, 0), atol=2e-4, err_msg=name
    )
    # What no frame hit has no class: it was at most seen through.
    assert (np.asarray(voxel_map.log_odds)[1:, ~hit] == 0).all()
    assert not np.asarray(ours.log_odds)[:, ~hit].any()


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_keeping_blocks_of_points_as_one_hardly_changes_the_evidence(name):
    labeller = LABELLERS[name]
    recipe = recipe_of(labeller, FusionRule())
    frames, params = frames_of(labeller), MapperParams(CAMERA, FUSION, labeller.params)
    every, thinned = (build_cache(recipe, frames, params, KEY, block_px=size) for size in (1, 4))
    assert len(thinned.depth_m) < len(every.depth_m)
    np.testing.assert_array_equal(thinned.voxel, every.voxel)
    np.testing.assert_allclose(thinned.points.sum(), every.points.sum())
    one, other = (fused_evidence(recipe, kept, FUSION, numbers_of(recipe)) for kept in (every, thinned))
    # Disparities are random here: within a block and a voxel, points lie on both sides of the plane's threshold.
    most = 0.15 if name == "plane" else 0.05
    assert np.abs(one - other).max() < most * np.abs(one).max()


def doubled(tree):
    """The same values with float64 leaves."""

    def leaf_of(leaf):
        return jnp.asarray(leaf, jnp.float64) if jnp.result_type(leaf) == jnp.float32 else leaf

    return jax.tree.map(leaf_of, tree)


@partial(jax.jit, static_argnums=(0, 3))
@partial(jax.value_and_grad, argnums=1)
def smooth_score(name: str, free: TunedParams, kept: EvidenceCache, rule: FusionRule) -> jax.Array:
    recipe = recipe_of(LABELLERS[name], rule)
    params = constrained(free, recipe.labeller.bijectors)
    evidence = fused_evidence(recipe, kept, params.fusion, params.labeller)
    weight = np.random.default_rng(9).normal(size=evidence.shape)
    return (weight * jnp.tanh(evidence)).sum()


@cache
def cache_of(name: str) -> EvidenceCache:
    labeller = LABELLERS[name]
    params = MapperParams(CAMERA, FUSION, labeller.params)
    return build_cache(recipe_of(labeller, RULES["own"]), frames_of(labeller), params, KEY)


@pytest.mark.parametrize("name", SOFT_FIRST)
@given(seed=st.integers(0, 2**16))
@settings(max_examples=5, deadline=None)
def test_gradients_equal_finite_differences(name, seed):
    recipe = recipe_of(LABELLERS[name], RULES["own"])
    rng, single = np.random.default_rng(seed), cache_of(name)
    with jax.enable_x64(True):
        start = unconstrained(TunedParams(FUSION, numbers_of(recipe)), recipe.labeller.bijectors)
        free = jax.tree.map(lambda leaf: jnp.asarray(leaf + rng.normal(0, 0.3, leaf.shape), jnp.float64), start)
        kept = doubled(single)
        leaves, structure = jax.tree.flatten(free)
        slopes = jax.tree.leaves(smooth_score(name, free, kept, RULES["own"])[1])
        paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(free)]
        for place, leaf in enumerate(leaves):
            direction = rng.normal(size=leaf.shape)
            ahead, behind = (
                smooth_score(
                    name,
                    structure.unflatten([*leaves[:place], leaf + step * direction, *leaves[place + 1 :]]),
                    kept,
                    RULES["own"],
                )[0]
                for step in (STEP, -STEP)
            )
            np.testing.assert_allclose(
                (slopes[place] * direction).sum(),
                (ahead - behind) / (2 * STEP),
                rtol=1e-4,
                atol=1e-6,
                err_msg=f"{paths[place]} of {name}",
            )


@pytest.mark.parametrize("name", SOFT_FIRST)
@given(scale=st.sampled_from([0.0, 1.0, 30.0, 1e3]), seed=st.integers(0, 2**16))
@settings(max_examples=8, deadline=None)
def test_no_step_however_long_makes_an_illegal_or_infinite_number(name, scale, seed):
    recipe = recipe_of(LABELLERS[name], RULES["own"])
    rng = np.random.default_rng(seed)
    start = unconstrained(TunedParams(FUSION, numbers_of(recipe)), recipe.labeller.bijectors)
    free = jax.tree.map(lambda leaf: jnp.asarray(leaf + scale * rng.normal(size=leaf.shape), jnp.float32), start)
    for leaf in jax.tree.leaves(smooth_score(name, free, cache_of(name), RULES["own"])):
        assert np.isfinite(leaf).all()


def test_frames_that_see_nothing_and_labellers_without_classes_are_refused():
    labeller = LABELLERS["hard"]
    params = MapperParams(CAMERA, FUSION, labeller.params)
    frame = frames_of(labeller, 1)[0]
    blind = Frame(jnp.full_like(frame.disparity_px, jnp.nan), frame.T_world_camera, labels=frame.labels)
    with pytest.raises(JaxmapError, match="no frame has a point in the grid in tuning"):
        build_cache(recipe_of(labeller, RULES["own"]), [blind], params, KEY)
    with pytest.raises(JaxmapError, match="the labeller gives no classes"):
        build_cache(recipe_of(make_no_labeller(), RULES["own"]), [frame], params, KEY)
