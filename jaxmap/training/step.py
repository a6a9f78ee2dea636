"""The compiled training step: one batch of images into the weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8

from jaxmap.labels import IGNORE
from jaxmap.models.architecture import Architecture
from jaxmap.models.deeplab import Weights, training_form
from jaxmap.training.augment import augment
from jaxmap.training.losses import total_loss
from jaxmap.training.optimiser import make_optimiser, poly_rate, trained_names
from jaxmap.training.options import TrainingOptions


class Batch(NamedTuple):
    """Images as they were read, and what is to be made of each.

    Attributes:
        images: RGB, padded below and to the right to one size.
        labels: of the same pixels; `IGNORE` in the padding.
        sizes_px: height and width of each image without it.
        draws: what the randomness of each example is drawn from: (epoch, or 0 where examples are fixed; example).
        originals: whether the image itself is the example, not a crop of it.
    """

    images: UInt8[Array, "B H W 3"]
    labels: UInt8[Array, "B H W"]
    sizes_px: Int[Array, "B 2"]
    draws: Int[Array, "B 2"]
    originals: Bool[Array, "B"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """All that a training run carries from step to step.

    Attributes:
        weights: of the network, running statistics included.
        average: running mean of the weights; empty where none is kept.
        optimiser: state of the optimiser.
        step: steps taken.
    """

    weights: Weights
    average: Weights
    optimiser: Any
    step: Int[Array, ""]


class StepInfo(NamedTuple):
    """What one step did; where `finite` is false, loss, gradient or new weights were not, and nothing was changed."""

    loss: Float[Array, ""]
    accuracy: Float[Array, ""]
    gradient_norm: Float[Array, ""]
    learning_rate: Float[Array, ""]
    finite: Bool[Array, ""]


class Trainer(NamedTuple):
    """The pure functions of training.

    Attributes:
        init: `(weights) -> TrainState`.
        step: `(state, batch, key) -> (state, StepInfo)`, compiled once; the state passed in is donated. The
            key is the run's: what is random depends on the batch's draws and the number of the step.
        loss: `(weights, images, labels, key) -> (loss, (logits, statistics))`, to be differentiated or looked at.
    """

    init: Callable[[Weights], TrainState]
    step: Callable[[TrainState, Batch, PRNGKeyArray], tuple[TrainState, StepInfo]]
    loss: Callable[..., tuple[Array, tuple[Array, Weights]]]


def make_trainer(
    architecture: Architecture,
    options: TrainingOptions,
    *,
    steps: int,
    class_weights: Float[Array, "C"],
    batch_norms: tuple[str, ...] = (),
) -> Trainer:
    """Builds the functions of a training run.

    Args:
        architecture: the network.
        options: the recipe.
        steps: of the whole run, for the schedule.
        class_weights: of the cross-entropy.
        batch_norms: prefixes of the blocks whose batch norms take their statistics from the batch and
            learn from it; the others keep theirs.
    """
    network = training_form(architecture, batch_norms)
    updater = make_updater(options, steps)
    fill = tuple(255 * value for value in architecture.mean)

    def loss(weights: Weights, images: Array, labels: Array, key: Array) -> tuple[Array, tuple[Array, Weights]]:
        logits, statistics = network(weights, images, key)
        return total_loss(logits, labels, class_weights, options.loss), (logits, statistics)

    def examples(batch: Batch, key: Array) -> tuple[Array, Array]:
        def one(image: Array, labels: Array, size_px: Array, draw: Array, original: Array) -> tuple[Array, Array]:
            drawn = jax.random.fold_in(jax.random.fold_in(key, draw[0]), draw[1])
            return augment(drawn, image, labels, size_px, original, options.augmentation, fill)

        return jax.vmap(one)(*batch)

    def step(state: TrainState, batch: Batch, key: PRNGKeyArray) -> tuple[TrainState, StepInfo]:
        view_key, dropout_key = jax.random.split(key)
        with jax.named_scope("augment"):
            images, labels = jax.lax.optimization_barrier(examples(batch, view_key))
        moved, fixed = parted(state.weights, options)

        def of_moved(moved: Weights) -> tuple[Array, tuple[Array, Weights]]:
            return loss({**fixed, **moved}, images, labels, jax.random.fold_in(dropout_key, state.step))

        (value, (logits, statistics)), gradient = jax.value_and_grad(of_moved, has_aux=True)(moved)
        known = labels != IGNORE
        right = known & (logits.argmax(axis=-1) == labels)
        accuracy = right.sum() / jnp.maximum(known.sum(), 1)
        return updater.update(state, value, accuracy, gradient, statistics)

    return Trainer(updater.init, jax.jit(step, donate_argnums=0), loss)


class Updater(NamedTuple):
    """How gradients become new weights, whatever the loss was of.

    Attributes:
        init: `(weights) -> TrainState`.
        update: `(state, loss, accuracy, gradient, statistics) -> (state, StepInfo)`, with the gradient of the weights
            that move (`parted`) and the running statistics that the step has changed.
    """

    init: Callable[[Weights], TrainState]
    update: Callable[[TrainState, Array, Array, Weights, Weights], tuple[TrainState, StepInfo]]


def make_updater(options: TrainingOptions, steps: int) -> Updater:
    """Builds the optimiser of a run of so many steps, and what goes with it."""
    optimiser = make_optimiser(options.optimiser, steps)
    rate = poly_rate(options.optimiser, steps)
    decay = options.optimiser.average

    def init(weights: Weights) -> TrainState:
        # Copies: the state is donated, and the caller's weights are not.
        weights = jax.tree.map(jnp.array, weights)
        moved, _ = parted(weights, options)
        average = jax.tree.map(jnp.array, weights) if decay else {}
        return TrainState(weights, average, optimiser.init(moved), jnp.zeros((), jnp.int32))

    def update(
        state: TrainState, value: Array, accuracy: Array, gradient: Weights, statistics: Weights
    ) -> tuple[TrainState, StepInfo]:
        with jax.named_scope("optimiser"):
            moved, fixed = parted(state.weights, options)
            updates, optimiser_state = optimiser.update(gradient, state.optimiser, moved)
            moved = cast(Weights, optax.apply_updates(moved, updates))
            weights = {**fixed, **moved, **statistics}
            # Young averages must not hold on to the first, random weights.
            held = jnp.minimum(decay, (1 + state.step) / (10 + state.step))
            average = {name: held * mean + (1 - held) * weights[name] for name, mean in state.average.items()}
            norm = optax.global_norm(gradient)
            finite = jnp.isfinite(value) & jnp.isfinite(norm)
            for weight in weights.values():
                finite &= jnp.isfinite(weight).all()
            new = TrainState(weights, average, optimiser_state, state.step + 1)
            new = jax.tree.map(lambda after, before: jnp.where(finite, after, before), new, state)
        return new, StepInfo(value, accuracy, norm, jnp.asarray(rate(state.step)), finite)

    return Updater(init, update)


def parted(weights: Weights, options: TrainingOptions) -> tuple[Weights, Weights]:
    """The weights that the optimiser moves, and the others."""
    names = trained_names(weights, options.optimiser)
    moved = {name: weight for name, weight in weights.items() if name in names}
    return moved, {name: weight for name, weight in weights.items() if name not in names}
