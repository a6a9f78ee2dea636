"""The compiled training step: augmentation, loss and gradient of one batch, then the optimiser."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, ArrayLike, Bool, Float, Float16, Int, PRNGKeyArray, UInt8

from jaxmap.labels import IGNORE
from jaxmap.models.architecture import Architecture
from jaxmap.models.network import Weights, training_form
from jaxmap.training.augment import Crop, augment
from jaxmap.training.losses import correct, total_loss
from jaxmap.training.options import OptimiserOptions, TrainingOptions

_STATISTICS = (".norm.mean", ".norm.var")


class Batch(NamedTuple):
    """Images as they were read, and what augmentation needs to make the examples.

    Attributes:
        images: RGB, padded below and to the right to one size.
        labels: of the same pixels; `IGNORE` in the padding.
        sizes_px: height and width of each image without it.
        draws: folded into the key of each example: (epoch, or 0 where examples are fixed; example).
        originals: whether the whole image is the example, not a crop of it.
        relief: of the images, at `RELIEF_STRIDE`; None where the network sees none.
    """

    images: UInt8[Array, "B H W 3"]
    labels: UInt8[Array, "B H W"]
    sizes_px: Int[Array, "B 2"]
    draws: Int[Array, "B 2"]
    originals: Bool[Array, "B"]
    relief: Float16[Array, "B h w R"] | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """What a training run carries from step to step.

    Attributes:
        weights: of the network, running statistics included.
        average: exponential moving average of the weights; empty where none is kept.
        optimiser: state of the optimiser.
        step: steps taken.
    """

    weights: Weights
    average: Weights
    optimiser: Any
    step: Int[Array, ""]


class StepMetrics(NamedTuple):
    """Metrics of one step; where loss, gradient or new weights were not finite, the state was left unchanged."""

    loss: Float[Array, ""]
    accuracy: Float[Array, ""]
    gradient_norm: Float[Array, ""]
    learning_rate: Float[Array, ""]
    finite: Bool[Array, ""]


class Trainer(NamedTuple):
    """The pure functions of training.

    Attributes:
        init: `(weights) -> TrainState`.
        step: `(state, batch, key) -> (state, StepMetrics)`, compiled once; the state passed in is donated. The
            key is the same for all steps: draws and the number of the step are folded into it.
        loss: `(weights, crops, key) -> (loss, (logits, statistics))`, of a batch of crops; not compiled.
    """

    init: Callable[[Weights], TrainState]
    step: Callable[[TrainState, Batch, PRNGKeyArray], tuple[TrainState, StepMetrics]]
    loss: Callable[..., tuple[Array, tuple[Array, Weights]]]


def make_trainer(
    architecture: Architecture,
    options: TrainingOptions,
    *,
    steps: int,
    class_weights: Float[Array, "C"],
    batch_norms: tuple[str, ...] = (),
    negated: int | None = None,
) -> Trainer:
    """Builds the functions of a training run.

    Args:
        architecture: the network.
        options: the recipe.
        steps: of the whole run, for the schedule.
        class_weights: of the cross-entropy.
        batch_norms: prefixes of the blocks whose batch norms train; the others are frozen.
        negated: the class that pixels labelled `ANY_OTHER` are not of.
    """
    network = training_form(architecture, batch_norms)
    updater = make_updater(options, steps)
    fill = tuple(255 * value for value in architecture.mean)

    def loss(weights: Weights, crops: Crop, key: Array) -> tuple[Array, tuple[Array, Weights]]:
        logits, statistics = network(weights, crops.image, key, crops.relief)
        return total_loss(logits, crops.labels, class_weights, options.loss, negated), (logits, statistics)

    def crops_of(batch: Batch, key: Array) -> Crop:
        def one(of: Batch) -> Crop:
            drawn = jax.random.fold_in(jax.random.fold_in(key, of.draws[0]), of.draws[1])
            size_px, original = of.sizes_px, of.originals
            return augment(drawn, of.images, of.labels, size_px, original, options.augmentation, fill, of.relief)

        return jax.vmap(one)(batch)

    def step(state: TrainState, batch: Batch, key: PRNGKeyArray) -> tuple[TrainState, StepMetrics]:
        augment_key, dropout_key = jax.random.split(key)
        with jax.named_scope("augment"):
            crops = jax.lax.optimization_barrier(crops_of(batch, augment_key))
        trained, fixed = parted(state.weights, options)

        def of_trained(trained: Weights) -> tuple[Array, tuple[Array, Weights]]:
            return loss({**fixed, **trained}, crops, jax.random.fold_in(dropout_key, state.step))

        (value, (logits, statistics)), gradient = jax.value_and_grad(of_trained, has_aux=True)(trained)
        known = crops.labels != IGNORE
        right = known & correct(logits.argmax(axis=-1), crops.labels, negated)
        accuracy = right.sum() / jnp.maximum(known.sum(), 1)
        return updater.update(state, value, accuracy, gradient, statistics)

    return Trainer(updater.init, jax.jit(step, donate_argnums=0), loss)


class Updater(NamedTuple):
    """The optimiser of a run, whatever the loss.

    Attributes:
        init: `(weights) -> TrainState`.
        update: `(state, loss, accuracy, gradient, statistics) -> (state, StepMetrics)`, with the gradient of the
            trained weights (`parted`) and the running statistics that the step has changed.
    """

    init: Callable[[Weights], TrainState]
    update: Callable[[TrainState, Array, Array, Weights, Weights], tuple[TrainState, StepMetrics]]


def make_updater(options: TrainingOptions, steps: int) -> Updater:
    """Builds the optimiser of a run of so many steps, with its moving average and its test of finiteness."""
    optimiser = make_optimiser(options.optimiser, steps)
    rate = poly_rate(options.optimiser, steps)
    decay = options.optimiser.average

    def init(weights: Weights) -> TrainState:
        # Copies: the state is donated, and the caller's weights are not.
        weights = jax.tree.map(jnp.array, weights)
        trained, _ = parted(weights, options)
        average = jax.tree.map(jnp.array, weights) if decay else {}
        return TrainState(weights, average, optimiser.init(trained), jnp.zeros((), jnp.int32))

    def update(
        state: TrainState, value: Array, accuracy: Array, gradient: Weights, statistics: Weights
    ) -> tuple[TrainState, StepMetrics]:
        with jax.named_scope("optimiser"):
            trained, fixed = parted(state.weights, options)
            updates, optimiser_state = optimiser.update(gradient, state.optimiser, trained)
            trained = cast(Weights, optax.apply_updates(trained, updates))
            weights = {**fixed, **trained, **statistics}
            # The decay is smaller at first, so that the random weights of the start are soon forgotten.
            kept = jnp.minimum(decay, (1 + state.step) / (10 + state.step))
            average = {name: kept * mean + (1 - kept) * weights[name] for name, mean in state.average.items()}
            norm = optax.global_norm(gradient)
            finite = jnp.isfinite(value) & jnp.isfinite(norm)
            for weight in weights.values():
                finite &= jnp.isfinite(weight).all()
            new = TrainState(weights, average, optimiser_state, state.step + 1)
            new = jax.tree.map(lambda after, before: jnp.where(finite, after, before), new, state)
        return new, StepMetrics(value, accuracy, norm, jnp.asarray(rate(state.step)), finite)

    return Updater(init, update)


def parted(weights: Weights, options: TrainingOptions) -> tuple[Weights, Weights]:
    """The weights that the optimiser updates, and the others."""
    names = trained_names(weights, options.optimiser)
    trained = {name: weight for name, weight in weights.items() if name in names}
    return trained, {name: weight for name, weight in weights.items() if name not in names}


def poly_rate(options: OptimiserOptions, steps: int) -> optax.Schedule:
    """Learning rate by step: linear warm-up times the poly schedule of DeepLab (Chen et al. 2017)."""

    def rate(step: ArrayLike) -> Float[Array, ""]:
        left = jnp.clip(1 - jnp.asarray(step) / max(steps, 1), 0, 1)
        warmup = jnp.clip((jnp.asarray(step) + 1) / max(options.warmup_steps, 1), 0, 1)
        return jnp.asarray(options.learning_rate * left**options.power * warmup, jnp.float32)

    return rate


def is_statistic(name: str) -> bool:
    """Whether a weight is a running statistic of batch norm, which has no gradient."""
    return name.endswith(_STATISTICS)


def trained_names(names: Iterable[str], options: OptimiserOptions) -> frozenset[str]:
    """The names of the weights that the optimiser updates."""
    frozen = ("backbone.",) if options.backbone_rate == 0 else ()
    if options.frozen_units:
        # What lies before the first trained weight needs no way back: neither its time nor its memory.
        frozen = (*frozen, "backbone.stem.", *(f"backbone.units.{unit}." for unit in range(options.frozen_units)))
    return frozenset(name for name in names if not is_statistic(name) and not name.startswith(frozen))


def make_optimiser(options: OptimiserOptions, steps: int) -> optax.GradientTransformation:
    """The chain of gradient transformations over weights by dotted path; only kernels decay."""
    rate, factor = poly_rate(options, steps), options.backbone_rate

    def kernels(weights: Mapping[str, Array]) -> dict[str, bool]:
        return {name: name.endswith(".kernel") for name in weights}

    def scale_backbone(updates: Mapping[str, Array], _: object = None) -> dict[str, Array]:
        return {name: update * factor if name.startswith("backbone.") else update for name, update in updates.items()}

    clip = optax.clip_by_global_norm(options.clip_norm) if options.clip_norm else optax.identity()
    if options.kind == "adamw":
        descent = optax.adamw(rate, weight_decay=options.weight_decay, mask=kernels)
    else:
        decay = optax.add_decayed_weights(options.weight_decay, mask=kernels)
        descent = optax.chain(decay, optax.sgd(rate, options.momentum))
    scale = optax.stateless(scale_backbone) if factor != 1 else optax.identity()  # type: ignore[arg-type]
    return optax.chain(clip, descent, scale)
