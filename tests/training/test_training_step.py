"""The compiled step: what it learns, what it leaves alone, and when it changes nothing at all."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from tiny_training import ARCHITECTURE, network_is_tiny, tiny_network  # noqa: F401
from training_data import CLASSES, scene

import jaxmap
from jaxmap.models.network import Weights, initial_weights, pure_network
from jaxmap.training.augment import augment
from jaxmap.training.options import AugmentationOptions, OptimiserOptions, PixelLossOptions, TrainingOptions
from jaxmap.training.step import Batch, StepMetrics, Trainer, TrainState, make_trainer

SIZE_PX = (32, 32)
ALL_NORMS = ("backbone", "aspp", "decoder")
LEARNING = TrainingOptions(
    batch_size=2,
    augmentation=AugmentationOptions(crop_px=SIZE_PX, scale=(0.75, 1.5)),
    optimiser=OptimiserOptions(learning_rate=0.005, warmup_steps=0, average=0.5),
)
FROZEN = replace(
    LEARNING,
    loss=PixelLossOptions(cross_entropy=0.5, soft_iou=1, lovasz=1),
    optimiser=OptimiserOptions(kind="sgd", learning_rate=0.1, backbone_rate=0, warmup_steps=0, clip_norm=1.0),
)
DROPPING = replace(ARCHITECTURE, dropout=0.5)


@dataclass
class Compiled:
    """A trainer, and the weights it begins with."""

    trainer: Trainer
    weights: Weights

    def init(self, **changes: object) -> TrainState:
        return replace(self.trainer.init(self.weights), **changes)  # type: ignore[arg-type]

    def step(self, state: TrainState, batch: Batch, key: int = 0) -> tuple[TrainState, StepMetrics]:
        """One step, its arguments placed as in a run."""
        sharding = NamedSharding(Mesh(jax.local_devices(), ("data",)), PartitionSpec())
        return self.trainer.step(*jax.device_put((state, batch, jax.random.key(key)), sharding))

    def run(self, steps: int, batch: Batch, key: int = 0) -> tuple[TrainState, list[StepMetrics]]:
        state, infos = self.init(), []
        for _ in range(steps):
            state, info = self.step(state, batch, key)
            infos.append(info)
        return state, infos


def batch_of(original: bool = True, epoch: int = 0) -> Batch:
    """Two scenes, whole or cropped."""
    images, labels = (np.stack(arrays) for arrays in zip(*(scene(SIZE_PX, seed) for seed in (0, 1)), strict=True))
    draws = np.array([[epoch, 0], [epoch, 1]], np.int32)
    return Batch(images, labels, np.full((2, 2), SIZE_PX, np.int32), draws, np.full(2, original))


def host(state: TrainState) -> dict[str, np.ndarray]:
    """A state as arrays of its own, by path: the state itself is given away with the next step."""
    return {jax.tree_util.keystr(path): np.array(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(state)}


@pytest.fixture(scope="module")
def learning(network_is_tiny) -> Compiled:
    trainer = make_trainer(ARCHITECTURE, LEARNING, steps=100, class_weights=jnp.ones(2), batch_norms=ALL_NORMS)
    return Compiled(trainer, initial_weights(ARCHITECTURE, jax.random.key(1)))


@pytest.fixture(scope="module")
def frozen(network_is_tiny) -> Compiled:
    trainer = make_trainer(DROPPING, FROZEN, steps=100, class_weights=jnp.array([0.5, 1.5]))
    return Compiled(trainer, initial_weights(DROPPING, jax.random.key(2)))


@pytest.mark.slow
def test_two_images_are_learnt_by_heart(learning):
    state, infos = learning.run(50, batch_of())
    losses = [float(info.loss) for info in infos]
    # It begins below 1: new classifiers are small.
    assert np.mean(losses[-5:]) < 0.3 * np.mean(losses[:3]), losses
    assert infos[-1].accuracy > 0.95 and all(info.finite for info in infos)
    assert int(state.step) == 50
    # In evaluation, with the statistics learnt on the way, the network has learnt them as well.
    network = pure_network(ARCHITECTURE, state.weights)
    predicted = np.asarray(jax.jit(network.apply)(network.weights, batch_of().images)).argmax(axis=-1)
    assert (predicted == batch_of().labels).mean() > 0.85


def test_the_step_compiles_once(learning):
    state = learning.init()
    for epoch in range(3):
        state, _ = learning.step(state, batch_of(epoch % 2 == 0, epoch), key=epoch)
    assert learning.trainer.step._cache_size() == 1


def test_the_same_key_is_the_same_state_and_another_is_not(learning):
    one, same, other = (host(learning.run(2, batch_of(False), key)[0]) for key in (0, 0, 1))
    assert all(np.array_equal(one[name], same[name]) for name in one)
    assert not all(np.array_equal(one[name], other[name]) for name in one)


def test_an_epoch_later_other_crops_are_drawn(learning):
    one, other = (learning.run(1, batch_of(False, epoch))[1][0] for epoch in (0, 1))
    assert one.loss != other.loss


def test_the_weights_given_are_not_given_away(learning):
    before = {name: np.array(value) for name, value in learning.weights.items()}
    learning.run(2, batch_of())
    for name, value in learning.weights.items():
        np.testing.assert_array_equal(value, before[name])


@pytest.mark.parametrize("poison", [np.nan, np.inf])
def test_a_loss_that_is_not_finite_changes_nothing_and_says_so(learning, poison):
    state, _ = learning.run(2, batch_of())
    weights = {**state.weights, "classifier.bias": jnp.array([poison, 0.0])}
    spoilt = replace(state, weights=weights)
    before = host(spoilt)
    after, info = learning.step(spoilt, batch_of())
    assert not info.finite
    for name, value in host(after).items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)


def test_weights_that_would_not_be_finite_are_not_taken(learning):
    """Statistics can run over where loss and gradient are still finite."""
    state, _ = learning.run(1, batch_of())
    name = "aspp.project.norm.mean"
    spoilt = replace(state, weights={**state.weights, name: jnp.full_like(state.weights[name], jnp.inf)})
    after, info = learning.step(spoilt, batch_of())
    assert np.isfinite(info.loss) and np.isfinite(info.gradient_norm)
    assert not info.finite and int(after.step) == 1


def test_learning_norms_follow_the_batch(learning):
    """As in torch: a tenth of the new statistics, nine of the old; normalised by those of the batch."""
    state, _ = learning.run(1, batch_of())
    images = (batch_of().images / 255 - np.array(ARCHITECTURE.mean)) / np.array(ARCHITECTURE.std)
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1), (0, 0)))
    kernel = np.asarray(learning.weights["backbone.stem.kernel"], np.float64)
    outputs = np.zeros((2, 16, 16, 8))
    for row, column in np.ndindex(3, 3):
        outputs += padded[:, row : row + 32 : 2, column : column + 32 : 2] @ kernel[row, column]
    mean, variance = outputs.mean(axis=(0, 1, 2)), outputs.var(axis=(0, 1, 2))
    np.testing.assert_allclose(state.weights["backbone.stem.norm.mean"], 0.1 * mean, atol=1e-4)
    np.testing.assert_allclose(state.weights["backbone.stem.norm.var"], 0.9 + 0.1 * variance, rtol=1e-3)
    assert not np.array_equal(state.weights["backbone.stem.norm.scale"], learning.weights["backbone.stem.norm.scale"])


def test_the_average_runs_behind_the_weights(learning):
    state = learning.init()
    expected = {name: np.array(value) for name, value in learning.weights.items()}
    for step in range(12):
        state, _ = learning.step(state, batch_of())
        held = min(0.5, (1 + step) / (10 + step))
        expected = {name: held * mean + (1 - held) * np.asarray(state.weights[name]) for name, mean in expected.items()}
    assert held == 0.5
    for name, mean in expected.items():
        np.testing.assert_allclose(state.average[name], mean, atol=1e-5, err_msg=name)


@pytest.mark.slow
def test_what_is_frozen_stays_to_the_last_bit(frozen):
    state, infos = frozen.run(5, batch_of(False))
    moved = {name for name, value in state.weights.items() if not np.array_equal(value, frozen.weights[name])}
    assert all(info.finite for info in infos) and infos[0].gradient_norm > 0
    assert not {name for name in moved if name.startswith("backbone.") or name.endswith((".norm.mean", ".norm.var"))}
    assert {"aspp.project.kernel", "aspp.project.norm.scale", "classifier.kernel", "classifier.bias"} <= moved
    assert state.average == {}
    assert not any("backbone" in name for name in host(state) if ".optimiser" in name), "no moments for what is fixed"


@pytest.mark.slow
def test_dropout_differs_from_step_to_step(frozen):
    """With the rate at its end nothing moves, and only what is dropped changes the loss."""
    state, one = frozen.step(frozen.init(step=jnp.array(1000, jnp.int32)), batch_of())
    assert one.learning_rate == 0
    _, other = frozen.step(state, batch_of())
    assert one.loss != other.loss
    again = frozen.init(step=jnp.array(1000, jnp.int32))
    assert frozen.step(again, batch_of())[1].loss == one.loss


@pytest.mark.slow
def test_the_loss_of_a_step_is_that_of_its_examples(learning):
    batch = batch_of(False)
    augment_key, dropout_key = jax.random.split(jax.random.key(5))
    fill = tuple(255 * value for value in ARCHITECTURE.mean)
    draw = jax.jit(partial(augment, options=LEARNING.augmentation, fill=fill))
    keys = [jax.random.fold_in(jax.random.fold_in(augment_key, 0), place) for place in range(2)]
    drawn = [draw(key, *(array[place] for array in batch[:3]), jnp.array(False)) for place, key in enumerate(keys)]
    crops = jax.tree.map(lambda *arrays: jnp.stack(arrays), *drawn)
    labels = np.asarray(crops.labels)
    loss, (logits, _) = jax.jit(learning.trainer.loss)(learning.weights, crops, dropout_key)
    _, info = learning.step(learning.init(), batch, key=5)
    assert float(info.loss) == pytest.approx(float(loss), rel=1e-3)
    right = (np.asarray(logits).argmax(axis=-1) == labels)[labels != 255]
    assert float(info.accuracy) == pytest.approx(right.mean(), abs=0.01)


TWO_STEPS = """
import sys
from test_training_step import *

with tiny_network():
    trainer = make_trainer(ARCHITECTURE, LEARNING, steps=100, class_weights=jnp.ones(2), batch_norms=ALL_NORMS)
    mesh = Mesh(jax.local_devices(), ("data",))
    replicated, split = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec("data"))
    state = jax.device_put(trainer.init(initial_weights(ARCHITECTURE, jax.random.key(1))), replicated)
    key = jax.device_put(jax.random.key(0), replicated)
    for epoch in range(2):
        state, info = trainer.step(state, jax.device_put(batch_of(False, epoch), split), key)
assert len(state.weights["classifier.bias"].sharding.device_set) == jax.local_device_count()
np.savez(sys.argv[1], devices=jax.local_device_count(), traces=trainer.step._cache_size(), **state.weights)
"""


@pytest.mark.slow
def test_two_devices_come_to_the_weights_of_one(tmp_path):
    folders = [str(Path(jaxmap.__file__).parents[1]), str(Path(__file__).parent), str(Path(__file__).parents[1])]
    results = []
    for devices in (1, 2):
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(folders)}
        environment["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={devices}"
        path = tmp_path / f"{devices}.npz"
        subprocess.run([sys.executable, "-c", TWO_STEPS, str(path)], env=environment, check=True)
        results.append(dict(np.load(path)))
        assert results[-1].pop("devices") == devices and results[-1].pop("traces") == 1
    for name, value in results[0].items():
        np.testing.assert_allclose(results[1][name], value, atol=1e-4, err_msg=name)


@pytest.mark.slow
def test_mobilenet_learns_too():
    """The real backbone, in the least network around it, without the stand-in."""
    from jaxmap.models.backbones import BUILDERS, InvertedResidualNet
    from jaxmap.models.network import weight_shapes

    backbones: dict = BUILDERS
    stand_in, backbones["mobilenet_v2"] = backbones["mobilenet_v2"], InvertedResidualNet
    weight_shapes.cache_clear()
    try:
        record = replace(ARCHITECTURE, decoder=True, top_conv=False)
        trainer = make_trainer(record, LEARNING, steps=100, class_weights=jnp.ones(2), batch_norms=ALL_NORMS)
        _, infos = Compiled(trainer, initial_weights(record, jax.random.key(1))).run(40, batch_of())
    finally:
        backbones["mobilenet_v2"] = stand_in
        weight_shapes.cache_clear()
    assert np.mean([info.loss for info in infos[-5:]]) < 0.5 * np.mean([info.loss for info in infos[:3]])


def test_the_classes_of_the_scene_are_those_of_the_network():
    assert set(np.unique(batch_of().labels)) == set(range(len(CLASSES)))
