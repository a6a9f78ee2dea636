from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import reference
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import CLASSES, HEIGHT_PX, WIDTH_PX, disparities, poses, rngs

from jaxmap.errors import JaxmapError
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.fusion.query import top_down
from jaxmap.labellers.base import make_no_labeller
from jaxmap.labellers.files import make_files_labeller
from jaxmap.labellers.plane import make_plane_labeller
from jaxmap.labels import IGNORE
from jaxmap.mapping.step import Mapper, MapperParams, make_mapper
from jaxmap.types import Frame, PointLabels, make_grid, make_stereo_camera

CAMERA = make_stereo_camera(
    fx_px=30, fy_px=28, cx_px=15.2, cy_px=11.7, baseline_m=0.3, doffs_px=0.4, width_px=WIDTH_PX, height_px=HEIGHT_PX
)
GRID = make_grid([-4, -3, -2], [4, 4, 3], 0.5)
WIDE_GRID = make_grid([-40, -40, -2], [40, 40, 3], 0.25)
DEPTH_RANGE_M = (0.3, 4.0)
KEY = jax.random.key(7)
PARAMS = MapperParams(CAMERA, make_fusion_params(CLASSES))
PLANE = make_plane_labeller(CLASSES, hypotheses=32, sample_points=256)
PLANE_PARAMS = replace(PARAMS, labeller=PLANE.params)
RULES = {
    "own": FusionRule(),
    "sum": FusionRule("sum", left_out_classes=()),
    "paper": FusionRule("majority", carve=False, range_weighting=False),
}


def files_mapper(rule: FusionRule, grid=GRID) -> Mapper:
    return make_mapper(CAMERA, grid, make_files_labeller(CLASSES, soft=False), rule, DEPTH_RANGE_M)


@pytest.fixture(scope="session")
def mappers() -> dict[str, Mapper]:
    return {name: files_mapper(rule) for name, rule in RULES.items()}


@pytest.fixture(scope="session")
def plane_mapper() -> Mapper:
    return make_mapper(CAMERA, GRID, PLANE, FusionRule(), DEPTH_RANGE_M)


@pytest.fixture(scope="session")
def wide_mapper() -> Mapper:
    return files_mapper(FusionRule(left_out_classes=()), WIDE_GRID)


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    rng = draw(rngs())
    labels = rng.choice(np.array([0, 1, 2, 255], np.uint8), (HEIGHT_PX, WIDTH_PX))
    return Frame(jnp.asarray(disparities(rng)), draw(poses()), labels=jnp.asarray(labels))


def unlabelled(frame: Frame) -> Frame:
    return replace(frame, labels=None)


def an_example_frame(seed: int) -> Frame:
    rng = np.random.default_rng(seed)
    labels = rng.choice(np.array([0, 1, 2, 255], np.uint8), (HEIGHT_PX, WIDTH_PX))
    pose = jaxlie.SE3.exp(jnp.asarray(rng.normal(0, 0.6, 6), jnp.float32))
    return Frame(jnp.asarray(disparities(rng)), pose, labels=jnp.asarray(labels))


def assert_maps_equal(one, other, atol: float = 0.0) -> None:
    # Where sums may round otherwise, large ones do so by more.
    np.testing.assert_allclose(one.log_odds, other.log_odds, rtol=0.1 * atol, atol=atol)
    assert one.frames_fused == other.frames_fused


@given(frames(), st.sampled_from(sorted(RULES)))
@settings(max_examples=12)
def test_the_whole_step_equals_the_twin(mappers, frame, name):
    voxel_map, info = mappers[name].step(mappers[name].init(), frame, PARAMS, KEY)
    labels = np.asarray(frame.labels).reshape(-1)
    expected = reference.step(
        np.zeros(voxel_map.log_odds.shape),
        GRID,
        frame,
        CAMERA,
        PARAMS.fusion,
        RULES[name],
        DEPTH_RANGE_M,
        lambda points, valid: PointLabels(keep=valid, labels=labels),
        () if name == "sum" else (CLASSES.index("background"),),
    )
    assert expected.sure.mean() > 0.5
    ours = np.asarray(voxel_map.log_odds)
    np.testing.assert_allclose(ours[:, expected.sure], expected.log_odds[:, expected.sure], rtol=1e-4, atol=2e-4)
    assert info.points_kept <= info.points_in_range <= info.points_valid
    assert (info.points_kept == info.points_in_range) == (name == "sum")
    assert voxel_map.frames_fused == 1


@pytest.mark.slow
@pytest.mark.parametrize("soft", [False, True])
def test_a_frame_shows_its_labels_where_it_asks_for_them(soft):
    mapper = make_mapper(CAMERA, GRID, make_files_labeller(CLASSES, soft=soft), RULES["own"], DEPTH_RANGE_M)
    frame = an_example_frame(0)
    if soft:
        shares = np.random.default_rng(1).dirichlet(np.ones(4), (HEIGHT_PX, WIDTH_PX))[..., : len(CLASSES)]
        frame = replace(frame, labels=None, class_probabilities=jnp.asarray(shares, jnp.float32))
    fused, info = mapper.step(mapper.init(), frame, PARAMS, KEY)
    assert info.labels is None
    labels = np.asarray(mapper.label_image(frame, PARAMS, KEY, 0))
    assert len(np.unique(labels)) > 2
    for show in (False, True):
        with_labels, info = mapper.step(mapper.init(), replace(frame, show=jnp.asarray(show)), PARAMS, KEY)
        np.testing.assert_array_equal(info.labels, labels if show else 0)
        assert_maps_equal(with_labels, fused)
    assert mapper.compilations() == 2


@pytest.mark.slow
def test_what_is_drawn_for_a_frame_is_shown(plane_mapper):
    frame, voxel_map = replace(unlabelled(an_example_frame(0)), show=jnp.asarray(True)), plane_mapper.init()
    for number in range(2):
        voxel_map, info = plane_mapper.step(voxel_map, frame, PLANE_PARAMS, KEY)
        np.testing.assert_array_equal(info.labels, plane_mapper.label_image(frame, PLANE_PARAMS, KEY, number))


def test_background_stays_a_class_of_the_image_and_makes_no_voxels(mappers):
    frame, mapper = an_example_frame(0), mappers["own"]
    sky = replace(frame, labels=jnp.zeros_like(frame.labels))
    assert set(np.unique(mapper.label_image(sky, PARAMS, KEY, 0))) == {CLASSES.index("background"), IGNORE}
    voxel_map, info = mapper.step(mapper.init(), sky, PARAMS, KEY)
    assert info.points_kept == 0 and info.voxels_freed > 0
    assert not np.asarray(voxel_map.log_odds[1:]).any() and (np.asarray(voxel_map.log_odds[0]) <= 0).all()


@pytest.mark.slow
@given(st.lists(frames(), min_size=2, max_size=3))
@settings(max_examples=8)
def test_the_window_of_the_camera_loses_no_point(wide_mapper, sequence):
    voxel_map = wide_mapper.init()
    weight = 0
    for frame in sequence:
        voxel_map, info = wide_mapper.step(voxel_map, frame, PARAMS, KEY)
        points, valid = reference.disparity_to_points(CAMERA, frame.disparity_px)
        in_range = valid & (points[..., 2] >= DEPTH_RANGE_M[0]) & (points[..., 2] <= DEPTH_RANGE_M[1])
        world = reference.transform_points(frame.T_world_camera, points[in_range])
        index, inside = reference.world_to_voxel(WIDE_GRID, world)
        hit = {tuple(place) for place in index[inside]}
        # A point within rounding of a face may fall into either voxel.
        assert abs(int(info.voxels_hit) - len(hit)) <= 2
        weight += inside.sum()
    assert weight > 0
    assert voxel_map.log_odds.shape == (4, *WIDE_GRID.shape)


def test_a_window_gives_the_map_of_the_whole_grid_bit_for_bit():
    # A step that looks far sees the whole grid through its window, one that looks near a part of it.
    near, far = (0.3, 4.0), (0.3, 40.0)
    labeller = make_files_labeller(CLASSES, soft=False)
    rule = FusionRule(carve=False)
    grid = make_grid([-9.1, -8.3, -3.7], [9.1, 8.3, 3.7], 0.2)
    maps = []
    for limits in (near, far):
        mapper = make_mapper(CAMERA, grid, labeller, rule, limits)
        voxel_map = mapper.init()
        for seed in range(6):
            frame = an_example_frame(seed)
            depth_m, _ = reference.disparity_to_points(CAMERA, frame.disparity_px)
            cut = jnp.asarray(np.where(depth_m[..., 2] < 3.9, frame.disparity_px, np.nan), jnp.float32)
            voxel_map, _ = mapper.step(voxel_map, replace(frame, disparity_px=cut), PARAMS, KEY)
        maps.append(voxel_map)
    assert_maps_equal(*maps)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper", pytest.param("own", marks=pytest.mark.slow)])
def test_compiled_equals_eager(mappers, name):
    frame, mapper = an_example_frame(3), mappers[name]
    eager, eager_info = mapper.fuse(mapper.init(), frame, PARAMS, KEY)
    compiled, info = mapper.step(mapper.init(), frame, PARAMS, KEY)
    # Contraction of a * b + c may move a point across a face: next to nothing of the map differs.
    differs = np.abs(np.asarray(eager.log_odds) - np.asarray(compiled.log_odds)) > 1e-4
    assert differs.mean() < 2e-3
    assert info.points_kept == eager_info.points_kept
    assert abs(int(info.voxels_hit) - int(eager_info.voxels_hit)) <= 2


@pytest.mark.slow
def test_a_scan_equals_a_loop_of_steps(plane_mapper):
    sequence = [unlabelled(an_example_frame(seed)) for seed in range(3)]
    looped, infos = plane_mapper.init(), []
    for frame in sequence:
        looped, info = plane_mapper.step(looped, frame, PLANE_PARAMS, KEY)
        infos.append(info)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *sequence)
    scanned, scanned_info = plane_mapper.scan(plane_mapper.init(), stacked, PLANE_PARAMS, KEY)
    assert_maps_equal(scanned, looped, atol=1e-5)
    for field in ("points_valid", "points_kept", "voxels_hit", "voxels_freed"):
        np.testing.assert_array_equal(getattr(scanned_info, field), [getattr(one, field) for one in infos])


@given(frames(), frames(), st.sampled_from(sorted(RULES)))
def test_frames_commute(mappers, first, second, name):
    mapper, forth, back = mappers[name], mappers[name].init(), mappers[name].init()
    for one, other in ((first, second), (second, first)):
        forth, _ = mapper.step(forth, one, PARAMS, KEY)
        back, _ = mapper.step(back, other, PARAMS, KEY)
    assert_maps_equal(forth, back, atol=1e-5)


@given(st.lists(frames(), min_size=1, max_size=3))
@settings(max_examples=10)
def test_the_same_key_gives_the_same_map_bit_for_bit(plane_mapper, sequence):
    maps = []
    for _ in range(2):
        voxel_map = plane_mapper.init()
        for frame in sequence:
            voxel_map, _ = plane_mapper.step(voxel_map, unlabelled(frame), PLANE_PARAMS, KEY)
        maps.append(voxel_map)
    assert_maps_equal(*maps)


def test_each_frame_of_a_run_draws_its_own_hypotheses(plane_mapper):
    frame, planes = unlabelled(an_example_frame(0)), []
    voxel_map = plane_mapper.init()
    for _ in range(2):
        voxel_map, info = plane_mapper.step(voxel_map, frame, PLANE_PARAMS, KEY)
        planes.append(np.asarray(info.estimate.normal))
    assert not np.array_equal(*planes)


@given(frames(), st.floats(0.2, 2.0))
@settings(max_examples=10)
def test_the_step_compiles_once_whatever_the_frame_pose_and_parameters(frame, hit):
    mapper = COMPILED_ONCE
    params = MapperParams(replace(CAMERA, fx_px=jnp.float32(20 + hit)), make_fusion_params(CLASSES, occupancy_hit=hit))
    voxel_map = mapper.init()
    for key in (KEY, jax.random.key(3)):
        voxel_map, _ = mapper.step(voxel_map, frame, params, key)
    assert mapper.compilations() == 1


COMPILED_ONCE = files_mapper(FusionRule("sum", carve=False))


@pytest.mark.parametrize("hole", [np.nan, np.inf, 0.0, -5.0, 1e-30])
def test_a_frame_without_depth_leaves_the_map_as_it_was(mappers, hole):
    mapper, frame = mappers["own"], an_example_frame(0)
    before, _ = mapper.fuse(mapper.init(), frame, PARAMS, KEY)
    blind = replace(frame, disparity_px=jnp.full((HEIGHT_PX, WIDTH_PX), hole) - CAMERA.doffs_px * (hole <= 0))
    expected = np.asarray(before.log_odds)
    after, info = mapper.step(before, blind, PARAMS, KEY)
    assert info.points_in_range == info.voxels_hit == 0
    # A hair's breadth of disparity is a wall far away: free space, but no point.
    if info.points_valid == 0:
        np.testing.assert_array_equal(after.log_odds, expected)
    assert np.isfinite(after.log_odds).all()


@pytest.mark.parametrize("translation_m", [(1e4, 0, 0), (0, -1e30, 0), (0, 0, np.nan), (np.inf, 0, 0)])
def test_a_pose_outside_the_grid_or_nowhere_changes_no_bit(mappers, translation_m):
    mapper = mappers["own"]
    frame = replace(an_example_frame(0), T_world_camera=jaxlie.SE3.from_translation(jnp.array(translation_m, float)))
    after, info = mapper.step(mapper.init(), frame, PARAMS, KEY)
    assert not np.asarray(after.log_odds).any()
    assert info.voxels_hit == info.voxels_freed == 0


@pytest.mark.parametrize(
    "classes", [(), pytest.param(tuple(f"class {n}" for n in range(21)), marks=pytest.mark.slow)], ids=len
)
def test_any_number_of_classes_goes_through_the_step(classes):
    labeller = make_files_labeller(classes, soft=True) if classes else make_no_labeller()
    mapper = make_mapper(CAMERA, GRID, labeller, FusionRule(priority_classes=()), DEPTH_RANGE_M)
    params = MapperParams(CAMERA, make_fusion_params(classes))
    soft = np.random.default_rng(0).dirichlet(np.ones(len(classes)), (HEIGHT_PX, WIDTH_PX)) if classes else None
    frame = replace(
        an_example_frame(1),
        labels=None,
        class_probabilities=None if soft is None else jnp.asarray(soft, jnp.float32),
    )
    voxel_map, info = mapper.step(mapper.init(), frame, params, KEY)
    assert info.voxels_hit > 0
    assert voxel_map.classes == classes
    view = top_down(voxel_map, params.fusion, FusionRule(priority_classes=()))
    assert view.probability.shape == (len(classes), *GRID.shape[:2])
    assert np.asarray(view.observed).any()


def test_soft_labels_are_hardened_where_each_point_has_one_label(mappers):
    soft = make_mapper(CAMERA, GRID, make_files_labeller(CLASSES, soft=True), RULES["paper"], DEPTH_RANGE_M)
    hard = mappers["paper"]
    frame = an_example_frame(2)
    labels = jnp.where(frame.labels == 255, 0, frame.labels)
    hesitant = 0.6 * jax.nn.one_hot(labels, 3) + 0.4 / 3
    one, _ = soft.step(soft.init(), replace(frame, labels=None, class_probabilities=hesitant), PARAMS, KEY)
    other, _ = hard.step(hard.init(), replace(frame, labels=labels), PARAMS, KEY)
    assert_maps_equal(one, other)


def test_only_the_tensor_of_the_map_is_donated(mappers):
    mapper, frame = mappers["own"], an_example_frame(0)
    before = mapper.init()
    after, _ = mapper.step(before, frame, PARAMS, KEY)
    assert before.log_odds.is_deleted()
    assert not any(leaf.is_deleted() for leaf in jax.tree.leaves((before.grid, GRID, frame, PARAMS, after)))


def test_the_step_updates_the_map_in_place_and_works_in_a_window(wide_mapper):
    voxel_map, frame = wide_mapper.init(), an_example_frame(0)
    memory = wide_mapper.lower(voxel_map, frame, PARAMS, KEY).compile().memory_analysis()
    assert memory.alias_size_in_bytes >= voxel_map.log_odds.nbytes
    assert memory.temp_size_in_bytes < 0.25 * voxel_map.log_odds.nbytes


@pytest.mark.parametrize("limits", [(2.0, 1.0), (-1.0, 2.0), (1.0, 1.0), (0.0, np.nan), (0.0, np.inf)])
def test_a_depth_range_that_is_none_is_refused(limits):
    with pytest.raises(JaxmapError, match=r"depth range .* in mapper; take 0 <= min < max") as caught:
        make_mapper(CAMERA, GRID, make_no_labeller(), FusionRule(), limits)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("choice", [{"per_frame": "median"}, {"column": "mean"}])
def test_a_rule_that_does_not_exist_is_refused(choice):
    with pytest.raises(JaxmapError, match=r"median|mean"):
        FusionRule(**choice)


def test_a_frame_that_lacks_what_the_labeller_needs_is_refused(mappers):
    with pytest.raises(JaxmapError, match="labels"):
        mappers["own"].step(mappers["own"].init(), unlabelled(an_example_frame(0)), PARAMS, KEY)
