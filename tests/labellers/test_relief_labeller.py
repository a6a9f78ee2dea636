"""Relief as a labeller, and added to the labels of others."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import relief_scenes
from golden.seeded_weights import seeded_image, seeded_weights
from hypothesis import given
from hypothesis import strategies as st
from networks import SMALL
from relief_scenes import Box, View, view_of
from strategies import CLASSES, rngs

from jaxmap.errors import JaxmapError
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.geometry.options import GroundOptions
from jaxmap.labellers.base import Labeller
from jaxmap.labellers.deeplab import make_deeplab_labeller
from jaxmap.labellers.files import make_files_labeller
from jaxmap.labellers.options import ReliefOptions
from jaxmap.labellers.plane import make_plane_labeller
from jaxmap.labellers.relief import GroundSeen, combine_with_relief, make_relief_labeller, rock_log_odds
from jaxmap.labels import IGNORE
from jaxmap.mapping.step import MapperParams, make_mapper
from jaxmap.models.checkpoint import SavedModel
from jaxmap.models.pixelwise import map_pixels, upsampling
from jaxmap.tuning.evidence_cache import CacheRecipe, build_cache, fused_evidence, tunable_numbers
from jaxmap.types import Frame, make_grid, make_stereo_camera

SAND, ROCK = CLASSES.index("sand"), CLASSES.index("rock")
CAMERA = make_stereo_camera(fx_px=90.0, fy_px=90.0, cx_px=63.5, cy_px=47.5, baseline_m=0.4, width_px=128, height_px=96)
# No face of voxels lies in a face of the scene.
GRID = make_grid([0, -4, -2], [8, 4, 1], 0.26)
RANGE_M = (0.3, 8.0)
FUSION = make_fusion_params(CLASSES, disparity_sigma_px=0.05)
KEY = jax.random.key(1)
RELIEF = make_relief_labeller(CLASSES, range_m=8.0, cell_m=0.2)
HARD, SOFT = (make_files_labeller(CLASSES, soft=soft) for soft in (False, True))
NUMBERS = RELIEF.params.numbers
BOXES = (Box(3.0, -0.5, 1.0, 0.5), Box(4.5, 0.8, 0.9, 0.7))


@cache
def scene(*, slopes: tuple[float, float] = (0.0, 0.0), boxes: tuple[Box, ...] = BOXES, rolling: bool = False) -> View:
    def waves(x, y):
        return 0.2 * np.sin(1.1 * x) * np.cos(0.9 * y)

    return view_of(slopes, boxes, bumps=waves if rolling else None, camera=CAMERA)


def frame_of(view: View, disparity_px: np.ndarray | None = None, **fields) -> Frame:
    T = np.eye(4)
    T[:3, :3] = view.R_level_camera
    T[2, 3] = relief_scenes.CAMERA_HEIGHT_M - 1.0
    pose = jaxlie.SE3.from_matrix(jnp.asarray(T, jnp.float32))
    return Frame(jnp.asarray(view.disparity_px if disparity_px is None else disparity_px), pose, **fields)


@cache
def mapper_of(labeller_of):
    labeller = labeller_of()
    return labeller, make_mapper(CAMERA, GRID, labeller, FusionRule(carve=False), RANGE_M)


def relief_alone() -> Labeller:
    return RELIEF


def plane_alone() -> Labeller:
    return make_plane_labeller(CLASSES, hypotheses=64, sample_points=2048)


def labelled(labeller_of, frame: Frame) -> np.ndarray:
    labeller, mapper = mapper_of(labeller_of)
    return np.asarray(mapper.label_image(frame, MapperParams(CAMERA, FUSION, labeller.params), KEY, 0))


def test_rocks_are_rock_and_the_rest_is_sand():
    view = scene()
    labels = labelled(relief_alone, frame_of(view))
    known = labels != IGNORE
    top = known & (view.height_m > 0.3)
    ground = known & (np.abs(view.height_m) < 1e-3) & (view.depth_m < 5)
    assert top.sum() > 150 and (labels[top] == ROCK).mean() > 0.95
    assert ground.sum() > 3000 and (labels[ground] == SAND).mean() > 0.9


@pytest.mark.parametrize("where", ["slope", "rolling ground"])
def test_hills_are_sand_where_the_plane_calls_them_rock(where):
    hill = np.tan(np.radians(25.0))
    view = scene(slopes=(0.0, hill), boxes=()) if where == "slope" else scene(rolling=True, boxes=())
    frame = frame_of(view)
    ours, planes = labelled(relief_alone, frame), labelled(plane_alone, frame)
    near = view.depth_m < 6
    seen = near & (ours != IGNORE)
    assert seen.sum() > 0.7 * near.sum() and (ours[seen] == ROCK).mean() < 0.05
    if where == "rolling ground":
        assert (planes[near] == ROCK).mean() > 0.08


def test_a_plane_steeper_than_its_greatest_tilt_is_not_found_and_a_slope_of_sand_is():
    view = scene(slopes=(0.0, np.tan(np.radians(40.0))), boxes=())
    frame = frame_of(view)
    near = view.depth_m < 5
    assert (labelled(plane_alone, frame)[near] == SAND).mean() < 0.5
    labels = labelled(relief_alone, frame)
    assert (labels[near & (labels != IGNORE)] == SAND).mean() > 0.5


def test_what_is_unknown_has_no_class_and_what_floats_is_left_out():
    view = scene()
    disparity_px = view.disparity_px.copy()
    disparity_px[40:80, 20:40] = np.nan
    disparity_px[44, 24] = view.disparity_px[44, 24]
    disparity_px[4:12, 60:72] = 18.0
    labels = labelled(relief_alone, frame_of(view, disparity_px))
    assert (labels[40:80, 20:40] == IGNORE).all()
    assert (labels[4:12, 60:72] == IGNORE).all()


@pytest.mark.parametrize(
    "labeller_of", [relief_alone, pytest.param(plane_alone, marks=pytest.mark.slow)], ids=["relief", "plane"]
)
def test_the_estimate_of_a_frame_says_whether_there_is_ground(labeller_of):
    labeller, mapper = mapper_of(labeller_of)
    params = MapperParams(CAMERA, FUSION, labeller.params)
    _, report = mapper.step(mapper.init(), frame_of(scene()), params, KEY)
    assert bool(report.estimate.found)
    nothing = frame_of(scene(), np.full((96, 128), np.nan, np.float32))
    _, report = mapper.step(mapper.init(), nothing, params, KEY)
    assert not bool(report.estimate.found)
    assert mapper.compilations() == 1


@pytest.mark.slow
def test_scan_equals_loop():
    labeller, mapper = mapper_of(relief_alone)
    params = MapperParams(CAMERA, FUSION, labeller.params)
    frames = [frame_of(scene(), scene().disparity_px + np.float32(0.1 * shift)) for shift in range(2)]
    looped = mapper.init()
    for frame in frames:
        looped, _ = mapper.step(looped, frame, params, KEY)
    scanned, _ = mapper.scan(mapper.init(), jax.tree.map(lambda *leaves: jnp.stack(leaves), *frames), params, KEY)
    # A block at the edge of a cell may round into the next.
    differ = np.abs(np.asarray(scanned.log_odds) - np.asarray(looped.log_odds)) > 1e-3
    assert np.asarray(looped.log_odds).any() and differ.mean() < 1e-3


@given(st.floats(-0.5, 1.5), st.floats(0.001, 0.3), st.floats(0, 1.4), st.floats(0.001, 0.2))
def test_rock_grows_likelier_with_height_and_slope_and_unsure_with_noise(height_m, sigma_m, angle, more):
    rows = [(height_m, sigma_m, angle), (height_m + more, sigma_m, angle), (height_m, sigma_m, angle + more)]
    values = jnp.asarray([[*row, 1.0] for row in rows], jnp.float32)
    log_odds = np.asarray(rock_log_odds(values, NUMBERS))
    assert log_odds[1] >= log_odds[0] and log_odds[2] > log_odds[0]
    level = jnp.asarray([[height_m, 1e6, 0.0, 1.0]], jnp.float32)
    np.testing.assert_allclose(rock_log_odds(level, NUMBERS), float(NUMBERS["bias"]), atol=1e-3)


def label_values(labeller: Labeller, own: np.ndarray, relief: np.ndarray, **numbers: float) -> np.ndarray:
    """The combined labels of points, from the other labeller's features and relief."""
    combined = combine_with_relief(labeller)
    given_numbers = {**combined.params.numbers, **{name: jnp.float32(value) for name, value in numbers.items()}}
    values = jnp.asarray(np.concatenate([own, relief], axis=1), jnp.float32)
    return np.stack(combined.label(values, GroundSeen(jnp.asarray(True)), given_numbers), axis=-1)


def shares_of(rng: np.random.Generator, count: int = 40) -> np.ndarray:
    return rng.dirichlet(np.ones(len(CLASSES) + 1), count)[:, :-1].astype(np.float32)


def relief_values(rng: np.random.Generator, known: float, count: int = 40) -> np.ndarray:
    columns = rng.uniform(-0.2, 0.6, count), rng.uniform(0.01, 0.2, count), rng.uniform(0, 1.5, count)
    return np.stack([*columns, np.full(count, known)], axis=1).astype(np.float32)


@given(rngs())
def test_labels_stay_as_they_are_where_relief_is_unknown_or_weighs_nothing(rng):
    shares = shares_of(rng)
    for known, numbers in ((0.0, {}), (1.0, {"weight": 0.0})):
        combined = label_values(SOFT, shares, relief_values(rng, known), **numbers)
        np.testing.assert_allclose(combined, shares, atol=1e-5)


@given(rngs())
def test_the_log_odds_of_relief_are_added_to_those_of_the_labels(rng):
    shares, relief = shares_of(rng), relief_values(rng, 1.0)
    combined = label_values(SOFT, shares, relief, weight=0.7, offset=0.4)
    ratio = 0.7 * (np.asarray(rock_log_odds(jnp.asarray(relief), NUMBERS)) + 0.4)
    np.testing.assert_allclose(combined.sum(axis=-1), shares.sum(axis=-1), atol=1e-5)
    for other in (name for name in range(len(CLASSES)) if name != ROCK):
        sure = np.minimum(shares[:, ROCK], shares[:, other]) > 1e-4
        gained = np.log(combined[:, ROCK] / combined[:, other]) - np.log(shares[:, ROCK] / shares[:, other])
        np.testing.assert_allclose(gained[sure], ratio[sure], atol=2e-2)


def test_labels_without_probabilities_are_right_with_a_certainty():
    labels = np.array([[ROCK], [SAND], [IGNORE]], np.float32)
    shares = label_values(HARD, labels, relief_values(np.random.default_rng(0), 0.0, 3))
    certainty = ReliefOptions().certainty
    doubt = (1 - certainty) / 2
    np.testing.assert_allclose(shares[0], np.where(np.arange(3) == ROCK, certainty, doubt), atol=1e-6)
    np.testing.assert_allclose(shares[1], np.where(np.arange(3) == SAND, certainty, doubt), atol=1e-6)
    np.testing.assert_array_equal(shares[2], 0.0)


def test_extreme_numbers_leave_probabilities():
    rng = np.random.default_rng(3)
    combined = label_values(SOFT, shares_of(rng), relief_values(rng, 1.0), weight=20.0, height_gain=50.0)
    assert np.isfinite(combined).all() and (combined >= 0).all()


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: make_relief_labeller(("sand",)), "the class 'rock' is not one of"),
        (lambda: make_relief_labeller(CLASSES, softness_m=0.0), "relief.softness_m is 0.0"),
    ],
    ids=["no rock", "out of bounds"],
)
def test_what_cannot_be_is_refused(make, says):
    with pytest.raises(JaxmapError, match=says):
        make()


@cache
def seeing_model() -> SavedModel:
    record = replace(SMALL, classes=CLASSES, relief_channels=6)
    return SavedModel(record, seeded_weights(record), "network")


def network_labeller() -> Labeller:
    return make_deeplab_labeller(seeing_model())


@pytest.mark.slow
def test_a_network_sees_the_relief_of_the_frame_in_the_step():
    labeller, mapper = mapper_of(network_labeller)
    assert labeller.ground == GroundOptions()
    params = MapperParams(CAMERA, FUSION, labeller.params)
    image = jnp.asarray(seeded_image(96, 128))
    _, report = mapper.step(mapper.init(), frame_of(scene(), image=image), params, KEY)
    blind, _ = mapper.step(mapper.init(), frame_of(scene(boxes=()), image=image), params, KEY)
    assert bool(report.estimate.found) and np.isfinite(blind.log_odds).all()
    assert mapper.compilations() == 1


@pytest.mark.parametrize(("image_px", "stride"), [((24, 32), 1), ((24, 32), 4), ((22, 29), 4)])
def test_further_numbers_of_pixels_follow_the_logits(image_px, stride):
    rng = np.random.default_rng(2)
    more_px = [-(-length // stride) for length in image_px]
    coarse, more = (jnp.asarray(rng.normal(size=size), jnp.float32) for size in ((6, 8, 3), (*more_px, 2)))
    places = upsampling(SMALL, (6, 8), image_px, None)
    alone = map_pixels(lambda logits: (logits[:, 0], logits[:, 2]), coarse, places)
    both = map_pixels(
        lambda values: (values[:, 0], values[:, 2], values[:, 3], values[:, 4]), coarse, places, more, stride
    )
    fine = np.kron(more, np.ones((stride, stride, 1)))[: image_px[0], : image_px[1]]
    for one, other in zip((*alone, fine[..., 0], fine[..., 1]), both, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


@pytest.mark.slow
def test_relief_can_be_tuned():
    rule = FusionRule(carve=False)
    recipe = CacheRecipe(CAMERA, GRID, RELIEF, rule, RANGE_M)
    params = MapperParams(CAMERA, FUSION, RELIEF.params)
    frame = frame_of(scene())
    cache_ = build_cache(recipe, [frame], params, KEY, block_px=1)
    numbers = tunable_numbers(RELIEF, rule)
    assert numbers.keys() == RELIEF.bijectors.keys()
    mapper = mapper_of(relief_alone)[1]
    mapped, _ = mapper.step(mapper.init(), frame, params, KEY)

    def rock(numbers):
        return fused_evidence(recipe, cache_, FUSION, numbers)[1 + ROCK].sum()

    total, gradient = jax.value_and_grad(rock)(numbers)
    np.testing.assert_allclose(total, np.asarray(mapped.log_odds)[1 + ROCK].sum(), rtol=1e-3, atol=1e-2)
    assert all(np.isfinite(slope) and slope != 0 for slope in gradient.values())
