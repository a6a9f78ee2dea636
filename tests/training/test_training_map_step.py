"""The step of map supervision: its gradient is that of its loss, in the memory of one frame."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optax
import pytest
import scenes
from hypothesis import given, settings
from small_scenes import small_camera
from strategies import rngs
from tiny_training import ARCHITECTURE as TINY
from tiny_training import network_is_tiny  # noqa: F401

from jaxmap.evaluation.cells import column_shares, make_cells
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.labels import IGNORE, ROVER_CLASSES
from jaxmap.models.network import initial_weights
from jaxmap.training.options import AugmentationOptions, OptimiserOptions, TrainingOptions
from jaxmap.training.step import parted
from jaxmap.tuning.frame_crops import FrameBatch
from jaxmap.tuning.map_loss import MapTruth
from jaxmap.tuning.map_step import SHOWN, MapSupervision, MapTrainer, anchor_loss, make_map_trainer
from jaxmap.tuning.options import MapLossOptions
from jaxmap.types import make_grid

EVERY_PX = 2
SAND, ROCK = ROVER_CLASSES.index("sand"), ROVER_CLASSES.index("rock")
KEY = jax.random.key(5)
CAMERA = small_camera(EVERY_PX)
GRID = make_grid([-2.0, 0.0, -0.4], [2.0, 5.2, 1.2], 0.2)
OPTIONS = TrainingOptions(
    batch_size=2,
    augmentation=AugmentationOptions(crop_px=(48, 64), scale=(0.75, 1.25)),
    optimiser=OptimiserOptions(learning_rate=5e-3, warmup_steps=1),
)


def boxes_from_above() -> np.ndarray:
    """Cells of 0.2 m that are mostly box."""
    x = -2.0 + (np.arange(20) + 0.5) * 0.2
    y = (np.arange(26) + 0.5) * 0.2
    rock = np.zeros((20, 26), bool)
    for lower, upper in scenes.BOXES_M:
        rock |= ((x > lower[0]) & (x < upper[0]))[:, None] & ((y > lower[1]) & (y < upper[1]))[None]
    return rock


def make_supervision() -> MapSupervision:
    rock, shares = boxes_from_above(), column_shares(GRID, make_cells(GRID, 0.2))
    known = jnp.ones(rock.shape, bool)
    truths = {
        SAND: MapTruth(shares, jnp.asarray(~rock, jnp.float32), known),
        ROCK: MapTruth(shares, jnp.asarray(rock, jnp.float32), known),
    }
    losses = {SAND: MapLossOptions(), ROCK: MapLossOptions(class_weight=4.0)}
    fusion = make_fusion_params(ROVER_CLASSES)
    return MapSupervision(CAMERA, GRID, (0.3, 4.5), fusion, FusionRule(), truths, losses)


def make_batch(indices: tuple[int, ...]) -> FrameBatch:
    seen = [scenes.scene_frame(index) for index in indices]
    part = (slice(None, None, EVERY_PX), slice(None, None, EVERY_PX))
    poses = [jaxlie.SE3.from_matrix(jnp.asarray(one.T_world_camera, jnp.float32)).wxyz_xyz for one in seen]
    anchors = [np.where(one.labels[part] == scenes.BACKGROUND, scenes.BACKGROUND, SHOWN) for one in seen]
    # Each class has its colour: what two small convolutions can learn.
    colours = np.array([[60, 200, 60], [60, 80, 200], [200, 80, 40]])
    images = [colours[one.labels[part]] * one.left[part][..., None] / 255 for one in seen]
    return FrameBatch(
        np.stack(images).astype(np.uint8),
        np.stack([one.disparity_px[part] / EVERY_PX for one in seen]).astype(np.float32),
        np.stack(poses),
        np.stack(anchors).astype(np.uint8),
        np.array([[0, index] for index in indices], np.int32),
    )  # type: ignore[arg-type]


TINY_ROVER = replace(TINY, classes=ROVER_CLASSES)


@pytest.fixture(scope="module")
def trainer(network_is_tiny) -> MapTrainer:
    return make_map_trainer(TINY_ROVER, OPTIONS, make_supervision(), steps=10)


@pytest.fixture(scope="module")
def weights(network_is_tiny):
    return initial_weights(TINY_ROVER, jax.random.key(0))


@pytest.mark.slow
def test_the_pull_back_is_the_gradient_of_the_loss(trainer, weights):
    batch = make_batch((0, 2))
    moved, fixed = parted(weights, OPTIONS)

    @jax.jit
    def plain(moved):
        return jax.value_and_grad(lambda moved: trainer.loss({**fixed, **moved}, batch, KEY), has_aux=True)(moved)

    (loss, accuracy), expected = plain(moved)
    pulled = jax.jit(trainer.pull_back)(weights, batch, KEY)
    np.testing.assert_allclose(pulled.loss, loss, rtol=1e-5)
    assert pulled.accuracy == accuracy
    assert pulled.gradient.keys() == expected.keys()
    for name, gradient in expected.items():
        scale = float(np.abs(gradient).max())
        np.testing.assert_allclose(pulled.gradient[name], gradient, rtol=1e-3, atol=1e-4 * scale + 1e-8, err_msg=name)
    assert all(np.asarray(pulled.gradient[name]).any() for name in expected if name.startswith("classifier."))

    # A short way down, the loss has fallen by as much as the gradient says; but not where classes are nearly equal.
    moved = {name: 20 * weight if name.startswith("classifier.") else weight for name, weight in moved.items()}
    (loss, _), gradient = plain(moved)
    length = float(optax.global_norm(gradient))
    (after, _), _ = plain({name: weight - 1e-4 / length * gradient[name] for name, weight in moved.items()})
    assert 0.7 < float(loss - after) / (1e-4 * length) < 1.3


@pytest.mark.slow
def test_a_batch_of_more_frames_takes_no_more_memory(trainer, weights):
    taken = {}
    for count in (2, 8):
        lowered = jax.jit(trainer.pull_back).lower(weights, make_batch(tuple(range(count))), KEY)
        taken[count] = lowered.compile().memory_analysis().temp_size_in_bytes
    assert taken[8] < 1.1 * taken[2]


SHOWN_CLASSES = np.array([False, True, True, False])
anchored = jax.jit(jax.value_and_grad(lambda logits, anchors: anchor_loss(logits, anchors, SHOWN_CLASSES)))


@given(rng=rngs())
@settings(max_examples=20, deadline=None)
def test_the_anchor_equals_the_twin(rng):
    logits = rng.normal(0, 3, (5, 6, 4))
    anchors = rng.choice(np.array([0, 3, SHOWN, IGNORE], np.uint8), (5, 6))
    shares = np.exp(logits) / np.exp(logits).sum(axis=-1, keepdims=True)
    values = []
    for share, anchor in zip(shares.reshape(-1, 4), anchors.reshape(-1), strict=True):
        if anchor != IGNORE:
            values.append(-np.log(share[1] + share[2] if anchor == SHOWN else share[anchor]))
    ours, _ = anchored(jnp.asarray(logits, jnp.float32), jnp.asarray(anchors))
    np.testing.assert_allclose(ours, np.mean(values) if values else 0.0, rtol=1e-4, atol=1e-6)


def test_where_nothing_is_held_the_anchor_is_nothing():
    value, gradient = anchored(jnp.ones((5, 6, 4)), jnp.full((5, 6), IGNORE, jnp.uint8))
    assert value == 0 and not np.asarray(gradient).any()
