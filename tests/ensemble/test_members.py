"""Members are maps of their own: each equals the map of a mapper that was given its errors."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import reference_ensemble
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import CLASSES, HEIGHT_PX, NO_SPREAD, WIDTH_PX, disparities, rngs

from jaxmap.ensemble.draws import MemberParams, draw_ensemble_params, draw_pose_errors
from jaxmap.ensemble.layer import ensemble_layers
from jaxmap.ensemble.members import doubted
from jaxmap.ensemble.options import EnsembleOptions
from jaxmap.errors import JaxmapError
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.labellers.base import make_no_labeller
from jaxmap.labellers.files import make_files_labeller
from jaxmap.mapping.step import Mapper, MapperParams, make_mapper
from jaxmap.types import Frame, PointLabels, VoxelMap, make_grid, make_stereo_camera

CAMERA = make_stereo_camera(
    fx_px=30, fy_px=28, cx_px=15.2, cy_px=11.7, baseline_m=0.3, doffs_px=0.4, width_px=WIDTH_PX, height_px=HEIGHT_PX
)
GRID = make_grid([-4, -3, -2], [4, 4, 3], 0.5)
KEY = jax.random.key(5)
FUSION = make_fusion_params(CLASSES)
MEMBERS = 4
ROCK = CLASSES.index("rock")
TIMES_S = np.arange(3.0)


def mapper_of(members: int, *, soft: bool = True, rule: FusionRule | None = None) -> Mapper:
    labeller = make_files_labeller(CLASSES, soft=soft)
    return make_mapper(CAMERA, GRID, labeller, rule or FusionRule(), (0.3, 4.0), members=members)


@pytest.fixture(scope="module")
def plain() -> Mapper:
    return mapper_of(0)


@pytest.fixture(scope="module")
def mapper() -> Mapper:
    return mapper_of(MEMBERS)


def a_frame(seed: int) -> Frame:
    rng = np.random.default_rng(seed)
    probabilities = rng.dirichlet([0.5] * 4, (HEIGHT_PX, WIDTH_PX))[..., :3]
    pose = jaxlie.SE3.exp(jnp.asarray(rng.normal(0, 0.6, 6), jnp.float32))
    return Frame(jnp.asarray(disparities(rng)), pose, class_probabilities=jnp.asarray(probabilities, jnp.float32))


FRAMES = [a_frame(seed) for seed in range(3)]


def mapped(mapper: Mapper, options: EnsembleOptions, frames: list[Frame] = FRAMES, key=KEY) -> VoxelMap:
    params = MapperParams(CAMERA, FUSION)
    if options.members:
        params = replace(params, ensemble=draw_ensemble_params(key, FUSION, options))
        errors = draw_pose_errors(key, TIMES_S, options)
        frames = [replace(one, pose_errors=jnp.asarray(error)) for one, error in zip(frames, errors, strict=False)]
    voxel_map = mapper.init()
    for frame in frames:
        voxel_map, _ = mapper.step(voxel_map, frame, params, key)
    return voxel_map


WIDE = EnsembleOptions(members=MEMBERS, position_sigma_m=0.3, heading_sigma_rad=0.2, disparity_sigma_px=0.5)


@pytest.mark.slow
def test_without_spread_every_member_is_the_map(mapper, plain):
    voxel_map = mapped(mapper, replace(NO_SPREAD, members=MEMBERS))
    own = np.asarray(voxel_map.log_odds)[[0, 1 + ROCK]]
    for member in np.asarray(voxel_map.members):
        np.testing.assert_allclose(member, own, rtol=0, atol=1e-5)
        np.testing.assert_array_equal(member != 0, own != 0)
    layers = ensemble_layers(voxel_map, FUSION, FusionRule())
    assert not np.nan_to_num(layers.missed).any()
    assert set(np.unique(layers.probability[~np.isnan(layers.probability)])) <= {0.0, 1.0}


def test_members_do_not_change_the_map(mapper, plain):
    with_members, without = mapped(mapper, WIDE), mapped(plain, EnsembleOptions())
    np.testing.assert_array_equal(with_members.log_odds, without.log_odds)
    assert without.members is None
    assert with_members.frames_fused == without.frames_fused == len(FRAMES)


def test_the_same_key_gives_the_same_members_and_another_one_others(mapper):
    one, again, other = mapped(mapper, WIDE), mapped(mapper, WIDE), mapped(mapper, WIDE, key=jax.random.key(6))
    np.testing.assert_array_equal(one.members, again.members)
    assert (np.asarray(one.members) != np.asarray(other.members)).any()
    assert len({np.asarray(member).tobytes() for member in one.members}) == MEMBERS


@pytest.mark.slow
@pytest.mark.parametrize("soft", [True, False])
def test_members_computed_together_are_those_computed_one_by_one(soft):
    rule = FusionRule() if soft else FusionRule("once", column="max")
    mapper, frames = mapper_of(MEMBERS, soft=soft, rule=rule), FRAMES
    if not soft:
        labels = jnp.full((HEIGHT_PX, WIDTH_PX), ROCK, jnp.uint8).at[::2].set(1)
        frames = [replace(frame, class_probabilities=None, labels=labels) for frame in FRAMES]
    one_by_one = mapped(mapper, WIDE, frames)
    for at_once in (2, 4):
        together = mapped(mapper, replace(WIDE, at_once=at_once), frames)
        differs = np.abs(np.asarray(together.members) - np.asarray(one_by_one.members)) > 1e-4
        # Contraction of a * b + c may move a point across a face: next to nothing of the members differs.
        assert differs.mean() < 2e-3
    # Three do not divide four: as many as fit are taken.
    assert mapped(mapper, replace(WIDE, at_once=3), frames).members.shape == one_by_one.members.shape


def test_a_member_is_the_map_of_its_own_poses_and_numbers(mapper, plain):
    """Without noise of disparities a member's errors can be given to a mapper without an ensemble."""
    options = replace(WIDE, disparity_sigma_px=0.0, temperature_sigma=0.0, label_bias_sigma=0.0)
    members = np.asarray(mapped(mapper, options).members)
    sensor, errors = draw_ensemble_params(KEY, FUSION, options).sensor, draw_pose_errors(KEY, TIMES_S, options)
    for number in (0, MEMBERS - 1):
        voxel_map = plain.init()
        params = MapperParams(CAMERA, jax.tree.map(lambda leaf, number=number: leaf[number], sensor.fusion))
        for frame, error in zip(FRAMES, errors[:, number], strict=True):
            turn = jaxlie.SO3.exp(jnp.asarray(error[3:]))
            pose = jaxlie.SE3.from_rotation_and_translation(
                turn @ frame.T_world_camera.rotation(), frame.T_world_camera.translation() + error[:3]
            )
            voxel_map, _ = plain.step(voxel_map, replace(frame, T_world_camera=pose), params, KEY)
        expected = np.asarray(voxel_map.log_odds)[[0, 1 + ROCK]]
        differs = np.abs(members[number] - expected) > 1e-4
        assert differs.mean() < 2e-3


@given(st.floats(0, 1e5), st.floats(0, 1e3), st.floats(0, 1e3), st.floats(0, 1e3))
@settings(max_examples=8)
def test_no_spread_makes_numbers_that_are_none(mapper, position_m, disparity_px, relative, bias):
    options = EnsembleOptions(
        members=MEMBERS,
        position_sigma_m=position_m,
        heading_sigma_rad=relative,
        disparity_sigma_px=disparity_px,
        increment_sigma=relative,
        temperature_sigma=relative,
        label_bias_sigma=bias,
    )
    voxel_map = mapped(mapper, options)
    assert np.isfinite(voxel_map.members).all()
    layers = ensemble_layers(voxel_map, FUSION, FusionRule())
    for layer in map(np.asarray, layers):
        known = layer[~np.isnan(layer)]
        assert known.size and known.min() >= 0 and known.max() <= 1


@pytest.mark.slow
def test_a_scan_fuses_members_as_a_loop_does(mapper):
    params = MapperParams(CAMERA, FUSION, ensemble=draw_ensemble_params(KEY, FUSION, WIDE))
    errors = draw_pose_errors(KEY, TIMES_S, WIDE)
    frames = [replace(one, pose_errors=jnp.asarray(error)) for one, error in zip(FRAMES, errors, strict=True)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *frames)
    scanned, _ = mapper.scan(mapper.init(), stacked, params, KEY)
    differs = np.abs(np.asarray(scanned.members) - np.asarray(mapped(mapper, WIDE).members)) > 1e-4
    assert differs.mean() < 2e-3


@given(rngs(), st.floats(0.05, 20), st.floats(-5, 5))
@settings(max_examples=10)
def test_doubted_labels_equal_the_twin(rng, temperature, bias):
    probabilities = rng.dirichlet([1.0] * 4, 50)[:, :3].astype(np.float32)
    probabilities[::2] /= probabilities[::2].sum(axis=1, keepdims=True)
    biases = np.array([bias, 0.0, -bias], np.float32)
    member = MemberParams(FUSION, jnp.float32(temperature), jnp.asarray(biases))
    ours = doubted(PointLabels(jnp.ones(50, bool), probabilities=jnp.asarray(probabilities)), member).probabilities
    np.testing.assert_allclose(ours, reference_ensemble.doubted(probabilities, temperature, biases), atol=2e-4)


def test_labels_that_nobody_doubts_stay_as_they_are():
    probabilities = jnp.asarray(np.random.default_rng(0).dirichlet([0.3] * 4, 50)[:, :3], jnp.float32)
    member = MemberParams(FUSION, jnp.float32(1.0), jnp.zeros(3))
    soft = PointLabels(jnp.ones(50, bool), probabilities=probabilities)
    np.testing.assert_array_equal(doubted(soft, member).probabilities, probabilities)
    hard = PointLabels(jnp.ones(50, bool), labels=jnp.zeros(50, jnp.int32))
    assert doubted(hard, member._replace(temperature=jnp.float32(3.0))) is hard


def test_an_ensemble_needs_a_class_and_its_numbers(mapper):
    with pytest.raises(JaxmapError, match="priority_classes"):
        make_mapper(CAMERA, GRID, make_no_labeller(), FusionRule(), (0.3, 4.0), members=2)
    with pytest.raises(JaxmapError, match=r"MapperParams\.ensemble"):
        mapper.step(mapper.init(), FRAMES[0], MapperParams(CAMERA, FUSION), KEY)
