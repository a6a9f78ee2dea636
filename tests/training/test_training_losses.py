"""The losses against their slow twins, against optax, and the laws they keep."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import reference_losses
from compiling import compiled_quickly
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.errors import UsageError
from jaxmap.labels import ANY_OTHER, IGNORE
from jaxmap.training.losses import class_weights, correct, total_loss
from jaxmap.training.options import PixelLossOptions

quickly = pytest.fixture(scope="module", autouse=True)(compiled_quickly)

PIXELS, CLASSES, NEGATED = 24, 3, 2
EQUAL = np.ones(CLASSES, np.float32)
UNEQUAL = np.array([0.5, 0.7, 1.8], np.float32)

OPTIONS = {
    "cross_entropy": PixelLossOptions(),
    "smoothed": PixelLossOptions(label_smoothing=0.2),
    "soft_iou": PixelLossOptions(cross_entropy=0, soft_iou=1),
    "lovasz": PixelLossOptions(cross_entropy=0, lovasz=1),
    "all": PixelLossOptions(cross_entropy=0.5, soft_iou=2, lovasz=0.25, label_smoothing=0.1),
}
TERMS = {name: partial(total_loss, options=options, negated=NEGATED) for name, options in OPTIONS.items()}
LOSSES = {name: jax.jit(term) for name, term in TERMS.items()}
GRADIENTS = {name: jax.jit(jax.grad(term)) for name, term in TERMS.items()}

TWINS = {
    "cross_entropy": lambda logits, labels: reference_losses.cross_entropy(logits, labels, UNEQUAL, 0.0, NEGATED),
    "smoothed": lambda logits, labels: reference_losses.cross_entropy(logits, labels, UNEQUAL, 0.2, NEGATED),
    "soft_iou": partial(reference_losses.soft_iou_loss, negated=NEGATED),
    "lovasz": partial(reference_losses.lovasz_loss, negated=NEGATED),
    "all": lambda logits, labels: (
        0.5 * reference_losses.cross_entropy(logits, labels, UNEQUAL, 0.1, NEGATED)
        + 2 * reference_losses.soft_iou_loss(logits, labels, NEGATED)
        + 0.25 * reference_losses.lovasz_loss(logits, labels, NEGATED)
    ),
}

OPTAX = jax.jit(optax.softmax_cross_entropy)

names = st.sampled_from(sorted(OPTIONS))
seeds = st.integers(0, 2**31 - 1)


def drawn(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Logits, and labels of which a third are ignored and some classes may be missing."""
    draw = np.random.default_rng(seed)
    present = draw.permutation(CLASSES)[: draw.integers(1, CLASSES + 1)]
    labels = draw.choice([*present, IGNORE], PIXELS).astype(np.uint8)
    return (3 * draw.standard_normal((PIXELS, CLASSES))).astype(np.float32), labels


def certain(labels: np.ndarray) -> np.ndarray:
    """Logits that leave no doubt about these labels."""
    return (100 * np.eye(CLASSES)[np.where(labels == IGNORE, 0, labels)]).astype(np.float32)


def negating(labels: np.ndarray, seed: int) -> np.ndarray:
    """The labels, with "any other class" at half of the pixels that are not of the negated one."""
    swapped = np.random.default_rng(seed).random(PIXELS) < 0.5
    return np.where(swapped & (labels != NEGATED) & (labels != IGNORE), np.uint8(ANY_OTHER), labels)


@given(names, seeds, st.booleans())
def test_a_loss_is_its_slow_twin(name, seed, partly):
    logits, labels = drawn(seed)
    labels = negating(labels, seed) if partly else labels
    loss = LOSSES[name](logits, labels, UNEQUAL)
    assert loss == pytest.approx(TWINS[name](logits.astype(np.float64), labels), abs=2e-5, rel=2e-5)


def test_the_shape_of_the_image_does_not_matter():
    logits, labels = drawn(1)
    flat = LOSSES["all"](logits, labels, UNEQUAL)
    square = LOSSES["all"](logits.reshape(2, 3, 4, CLASSES), labels.reshape(2, 3, 4), UNEQUAL)
    assert square == pytest.approx(float(flat), rel=1e-6)


@given(seeds)
def test_cross_entropy_is_that_of_optax(seed):
    logits, labels = drawn(seed)
    known = labels != IGNORE
    if not known.any():
        return
    truth = np.eye(CLASSES, dtype=np.float32)[np.where(known, labels, 0)]
    for name, target in (("cross_entropy", truth), ("smoothed", 0.8 * truth + 0.2 / CLASSES)):
        expected = np.asarray(OPTAX(logits, target))[known].mean()
        assert LOSSES[name](logits, labels, EQUAL) == pytest.approx(float(expected), rel=1e-5, abs=1e-6)


@given(st.sampled_from(["cross_entropy", "soft_iou", "lovasz"]), seeds)
def test_nothing_is_lost_where_all_is_right(name, seed):
    _, labels = drawn(seed)
    assert LOSSES[name](certain(labels), labels, UNEQUAL) == pytest.approx(0, abs=1e-6)


@given(seeds)
def test_hard_predictions_lose_what_they_lack_in_iou(seed):
    """Both losses of the overlap extend one minus IoU from labels to probabilities."""
    draw = np.random.default_rng(seed)
    predicted = draw.integers(0, CLASSES, PIXELS)
    _, labels = drawn(seed)
    known = labels != IGNORE
    ious = []
    for index in np.unique(labels[known]):
        ours, truth = predicted[known] == index, labels[known] == index
        ious.append((ours & truth).sum() / (ours | truth).sum())
    expected = 1 - np.mean(ious) if ious else 0.0
    for name in ("lovasz", "soft_iou"):
        assert LOSSES[name](certain(predicted), labels, EQUAL) == pytest.approx(expected, abs=1e-5), name


@given(names, seeds)
def test_ignored_pixels_count_nothing(name, seed):
    logits, labels = drawn(seed)
    changed = logits.copy()
    ignored = labels == IGNORE
    changed[ignored] = 50 * np.random.default_rng(seed).standard_normal((ignored.sum(), CLASSES))
    assert LOSSES[name](changed, labels, UNEQUAL) == pytest.approx(
        float(LOSSES[name](logits, labels, UNEQUAL)), rel=1e-5, abs=1e-6
    )
    assert (np.asarray(GRADIENTS[name](logits, labels, UNEQUAL))[ignored] == 0).all()


@pytest.mark.parametrize("name", OPTIONS)
def test_where_nothing_is_labelled_nothing_is_lost(name):
    logits, _ = drawn(0)
    labels = np.full(PIXELS, IGNORE, np.uint8)
    assert LOSSES[name](logits, labels, UNEQUAL) == 0
    assert (np.asarray(GRADIENTS[name](logits, labels, UNEQUAL)) == 0).all()


@pytest.mark.parametrize("name", OPTIONS)
def test_losses_of_wild_logits_and_their_gradients_are_finite(name):
    logits, labels = drawn(2)
    labels[::4] = ANY_OTHER
    for factor in (0, 1e4, -1e4):
        assert np.isfinite(LOSSES[name](factor * logits, labels, UNEQUAL))
        assert np.isfinite(GRADIENTS[name](factor * logits, labels, UNEQUAL)).all()


def test_gradients_equal_finite_differences():
    """Of all losses at once, in float64."""
    with jax.enable_x64(True):
        look = jax.jit(jax.value_and_grad(TERMS["all"]))
        weights, step = jnp.asarray(UNEQUAL, jnp.float64), 1e-6
        for seed in range(5):
            logits, labels = drawn(seed)
            logits, labels = logits.astype(np.float64), negating(labels, seed)
            direction = np.random.default_rng(seed).standard_normal(logits.shape)
            slope = (np.asarray(look(logits, labels, weights)[1]) * direction).sum()
            ahead, behind = (float(look(logits + sign * step * direction, labels, weights)[0]) for sign in (1, -1))
            np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=1e-5, atol=1e-8)
            assert abs(slope) > 1e-4


@given(seeds)
def test_the_weight_of_a_class_is_the_weight_of_its_pixels(seed):
    """Twice the weight counts as much as every pixel of the class twice."""
    logits, labels = drawn(seed)
    double = np.array([2, 1, 1], np.float32)
    again = labels == 0
    expected = reference_losses.cross_entropy(
        np.concatenate([logits, logits[again]]).astype(np.float64),
        np.concatenate([labels, labels[again]]),
        EQUAL,
        0.0,
        NEGATED,
    )
    assert LOSSES["cross_entropy"](logits, labels, double) == pytest.approx(expected, rel=1e-5, abs=1e-6)


def test_any_other_class_is_as_good_as_the_true_one():
    """Only the negated class loses, the one with what is known most of all; the others share the gain."""
    labels = np.full(PIXELS, ANY_OTHER, np.uint8)
    for index in range(CLASSES):
        loss = LOSSES["cross_entropy"](certain(np.full(PIXELS, index, np.uint8)), labels, UNEQUAL)
        assert loss == pytest.approx(100 - np.log(2) if index == NEGATED else 0, abs=1e-3)
    slopes = np.asarray(GRADIENTS["cross_entropy"](np.zeros((PIXELS, CLASSES), np.float32), labels, UNEQUAL))
    np.testing.assert_allclose(slopes * PIXELS, np.tile([-1 / 6, -1 / 6, 1 / 3], (PIXELS, 1)), rtol=1e-5)
    agrees = np.asarray(correct(jnp.arange(CLASSES), labels[:CLASSES], NEGATED))
    np.testing.assert_array_equal(agrees, np.arange(CLASSES) != NEGATED)


def test_weights_of_classes():
    pixels = np.array([900, 100, 0])
    np.testing.assert_array_equal(class_weights(PixelLossOptions(), pixels), [1, 1, 1])
    balanced = class_weights(PixelLossOptions(class_weights="balanced"), pixels[:2])
    assert balanced.mean() == pytest.approx(1) and balanced[1] / balanced[0] == pytest.approx(3)
    assert np.isfinite(class_weights(PixelLossOptions(class_weights="balanced"), pixels)).all()
    own = class_weights(PixelLossOptions(class_weights=(1.0, 2.0, 3.0)), pixels)
    np.testing.assert_allclose(own, [0.5, 1, 1.5])
    with pytest.raises(UsageError, match="2 class weights for 3 classes"):
        class_weights(PixelLossOptions(class_weights=(1.0, 2.0)), pixels)
