from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st
from strategies import CLASSES, HEIGHT_PX, WIDTH_PX, cloud_of, hard_labels, rngs, soft_labels

from jaxmap.errors import JaxmapError
from jaxmap.fusion.options import FusionOptions, FusionRule
from jaxmap.labellers.base import Labeller, fusible, label_points, make_no_labeller
from jaxmap.labellers.files import make_files_labeller
from jaxmap.labellers.plane import make_plane_labeller
from jaxmap.labels import IGNORE
from jaxmap.types import Frame, PointLabels

PIXELS = HEIGHT_PX * WIDTH_PX
FIT = dict(threshold_m=0.1, max_height_m=1.0, hypotheses=64, sample_points=512, sigma_m=0.02)
PLANE, SOFT_PLANE = make_plane_labeller(CLASSES, **FIT), make_plane_labeller(CLASSES, softness_m=0.01, **FIT)
HARD = make_files_labeller(CLASSES, soft=False)
SOFT = make_files_labeller(CLASSES, soft=True)


def frame_of(**fields) -> Frame:
    return Frame(jnp.zeros((HEIGHT_PX, WIDTH_PX)), jaxlie.SE3.identity(), **fields)


ALL = np.ones(PIXELS, bool)


compiled: dict = {}


def label_with(labeller: Labeller, frame, points, valid, key):
    # By its function: the numbers of a labeller cannot be hashed.
    label = compiled.setdefault(labeller.label, jax.jit(partial(label_points, labeller)))
    return label(frame, cloud_of(points, valid), labeller.params, key)


def beach(rng: np.random.Generator) -> np.ndarray:
    """Flat sand with some things on it, below it and high above it."""
    points = np.column_stack([rng.uniform(-4, 4, (PIXELS, 2)), rng.normal(0, 0.01, PIXELS)])
    points[:, 2] += rng.choice([0, 0.4, -0.3, 3.0], PIXELS, p=[0.8, 0.1, 0.05, 0.05])
    return points.astype(np.float32)


@pytest.mark.slow
@given(rngs())
def test_plane_labels_equal_the_twin(rng):
    points, valid = beach(rng), rng.random(PIXELS) < 0.9
    labels, plane = label_with(PLANE, frame_of(), points, valid, jax.random.key(1))
    expected, keep = reference.plane_labels(plane, points, valid, 0.1, 1.0, sand=1, rock=2)
    off = np.abs(points @ reference.f64(plane.normal) + float(plane.offset_m))
    sure = (np.abs(off - 0.1) > 1e-5) & (np.abs(off - 1.0) > 1e-5)
    np.testing.assert_array_equal(np.asarray(labels.labels)[sure], expected[sure])
    np.testing.assert_array_equal(np.asarray(labels.keep)[sure], keep[sure])


@given(rngs())
def test_the_beach_is_sand_and_what_stands_out_is_rock(rng):
    points = beach(rng)
    labels, plane = label_with(PLANE, frame_of(), points, np.ones(PIXELS, bool), jax.random.key(0))
    assert bool(plane.found)
    low, high = np.abs(points[:, 2]) < 0.05, points[:, 2] > 2.5
    assert np.all(np.asarray(labels.labels)[low] == 1)
    assert np.all(np.asarray(labels.labels)[~low] == 2)
    np.testing.assert_array_equal(labels.keep, ~high)


@pytest.mark.slow
@given(rngs())
def test_a_soft_threshold_goes_to_the_sharp_one(rng):
    points, key = beach(rng), jax.random.key(1)
    soft, plane = label_with(SOFT_PLANE, frame_of(), points, ALL, key)
    sharp, _ = label_with(PLANE, frame_of(), points, ALL, key)
    off = np.abs(points @ reference.f64(plane.normal) + float(plane.offset_m))
    rock = 1 / (1 + np.exp(-(off - 0.1) / 0.01))
    np.testing.assert_allclose(soft.probabilities, np.stack([0 * rock, 1 - rock, rock], -1), atol=1e-3)
    clear = np.abs(off - 0.1) > 1e-3
    np.testing.assert_array_equal(np.asarray(soft.probabilities).argmax(-1)[clear], np.asarray(sharp.labels)[clear])
    np.testing.assert_array_equal(soft.keep, sharp.keep)


def test_without_a_plane_points_are_kept_without_a_class():
    points = np.random.default_rng(0).uniform(-2, 2, (PIXELS, 3)).astype(np.float32)
    points[:, 1] = 0.0
    valid = np.arange(PIXELS) % 2 == 0
    labels, plane = label_with(PLANE, frame_of(), points, valid, jax.random.key(0))
    assert not bool(plane.found)
    assert np.all(np.asarray(labels.labels) == IGNORE)
    np.testing.assert_array_equal(labels.keep, valid)


def test_no_labeller_has_no_class_and_keeps_what_is_valid():
    labeller = make_no_labeller()
    valid = np.arange(PIXELS) % 3 == 0
    labels, plane = label_with(labeller, frame_of(), np.zeros((PIXELS, 3), np.float32), valid, jax.random.key(0))
    assert labeller.classes == ()
    assert labeller.needs is None
    assert plane == ()
    assert np.all(np.asarray(labels.labels) == IGNORE)
    np.testing.assert_array_equal(labels.keep, valid)


@given(rngs())
def test_files_labels_are_those_of_the_frame_pixel_by_pixel(rng):
    image = rng.choice(np.array([0, 1, 2, IGNORE], np.uint8), (HEIGHT_PX, WIDTH_PX))
    points, valid = np.zeros((PIXELS, 3), np.float32), rng.random(PIXELS) < 0.5
    labels, _ = label_with(HARD, frame_of(labels=jnp.asarray(image)), points, valid, jax.random.key(0))
    assert HARD.needs == "labels"
    np.testing.assert_array_equal(labels.labels, image.reshape(-1))
    np.testing.assert_array_equal(labels.keep, valid)


@given(rngs())
def test_soft_labels_are_those_of_the_frame_pixel_by_pixel(rng):
    image = rng.dirichlet(np.ones(3), (HEIGHT_PX, WIDTH_PX)).astype(np.float32)
    points, valid = np.zeros((PIXELS, 3), np.float32), np.ones(PIXELS, bool)
    frame = frame_of(class_probabilities=jnp.asarray(image))
    labels, _ = label_with(SOFT, frame, points, valid, jax.random.key(0))
    assert SOFT.needs == "class_probabilities"
    assert labels.labels is None
    np.testing.assert_array_equal(labels.probabilities, image.reshape(-1, 3))


@pytest.mark.parametrize("labeller", [PLANE, HARD, SOFT, make_no_labeller()], ids=lambda one: one.name)
def test_every_labeller_gives_exactly_one_kind_of_label(labeller):
    frame = frame_of(
        labels=jnp.zeros((HEIGHT_PX, WIDTH_PX), jnp.uint8),
        class_probabilities=jnp.full((HEIGHT_PX, WIDTH_PX, 3), 1 / 3),
    )
    labels, _ = label_with(labeller, frame, beach(np.random.default_rng(0)), np.ones(PIXELS, bool), jax.random.key(0))
    assert isinstance(labels, PointLabels)
    assert (labels.labels is None) != (labels.probabilities is None)
    assert labels.keep.shape == (PIXELS,)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (dict(on_plane="mud"), r"the class 'mud' is not one of \['background', 'sand', 'rock'\] in plane labeller"),
        (dict(off_plane="mud"), "the class 'mud' is not one of"),
        (dict(threshold_m=0.0), "plane.threshold_m is 0.0: input should be greater than 0"),
        (dict(threshold_m=3.0), "threshold_m 3.0 and max_height_m 2.0 in plane; take 0 < threshold_m < max_height_m"),
        (dict(threshold_m=float("nan")), "plane.threshold_m is nan"),
        (dict(softness_m=-0.1), "plane.softness_m is -0.1: input should be greater than or equal to 0"),
    ],
)
def test_a_wrong_plane_labeller_is_refused_in_one_line(options, says):
    with pytest.raises(JaxmapError, match=says) as caught:
        make_plane_labeller(CLASSES, **options)
    assert "\n" not in str(caught.value)


def test_an_unknown_option_of_the_fit_is_refused_at_once():
    with pytest.raises((JaxmapError, TypeError), match="hypothesis_count"):
        make_plane_labeller(CLASSES, hypothesis_count=3)


@given(rngs(), st.booleans(), st.sampled_from([None, (), ("sand",), ("background", "rock"), CLASSES]))
def test_points_of_classes_that_are_left_out_are_not_fused(rng, soft, names):
    labels, rule = (soft_labels if soft else hard_labels)(rng), FusionRule(left_out_classes=names)
    fused = fusible(labels, CLASSES, rule)
    left_out = [CLASSES.index(name) for name in (("background",) if names is None else names)]
    np.testing.assert_array_equal(fused.keep, reference.kept(labels, left_out))
    hard = fusible(labels, CLASSES, FusionRule("majority", left_out_classes=names))
    assert hard.probabilities is None
    np.testing.assert_array_equal(hard.keep, fused.keep)


def test_background_is_left_out_where_the_ground_has_a_class_of_its_own():
    assert FusionOptions().rule(("rock", "background", "sand")).left_out_classes == ("background",)
    for classes in ((), ("sand", "rock"), ("background", "car", "person"), ("background", "rock")):
        assert FusionOptions().rule(classes).left_out_classes == ()
    assert FusionOptions(left_out_classes=()).rule(CLASSES).left_out_classes == ()
    with pytest.raises(JaxmapError, match="sky is not one of the classes sand rock in fusion.left_out_classes"):
        FusionOptions(left_out_classes=("sky",)).rule(("sand", "rock"))


@pytest.mark.parametrize("labeller", [PLANE, HARD, SOFT, make_no_labeller()], ids=lambda one: one.name)
def test_a_labeller_draws_where_its_labels_depend_on_the_key(labeller):
    labels, points = jnp.zeros((HEIGHT_PX, WIDTH_PX), jnp.uint8), beach(np.random.default_rng(0))
    shares = jnp.zeros((*labels.shape, len(CLASSES)), jnp.float32)
    frame = frame_of(labels=labels) if labeller.needs == "labels" else frame_of(class_probabilities=shares)

    def label(key):
        return label_points(labeller, frame, cloud_of(points, ALL), labeller.params, key)[0]

    traced = jax.make_jaxpr(label)(jax.random.key(0)).jaxpr
    assert any(traced.invars[0] in equation.invars for equation in traced.eqns) == labeller.draws
