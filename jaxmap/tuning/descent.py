"""Gradient descent with a held-out loss: the best parameters are kept at every step, and it stops when they stay.

`descend` takes every step of Adam: for smooth, cheap losses. `go_down` takes only steps under which the loss
falls: for one that has small jumps of its own, which no gradient knows of.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import PyTree

from jaxmap.errors import JaxmapError
from jaxmap.tuning.options import DescentOptions


class Losses(NamedTuple):
    """The loss of the ground that is tuned on, and of what is held out."""

    tuned: float
    held_out: float


class Step(NamedTuple):
    """Where the descent stands: the step, its losses, the parameters, and whether they are the best so far.

    `taken` is false where the descent goes back from there.
    """

    number: int
    losses: Losses
    free: PyTree
    best: bool
    taken: bool = True


def descend(
    loss: Callable[..., tuple[jax.Array, jax.Array]],
    start: PyTree,
    options: DescentOptions,
    *,
    data: tuple[PyTree, ...] = (),
    moves: PyTree | None = None,
    on_step: Callable[[Step], None] = lambda step: None,
) -> Step:
    """Descends from `start`, and returns the step of the least held-out loss; the first one is the start itself.

    Args:
        loss: `(free, *data)` to the loss that is descended and the held-out one; differentiable in the free numbers.
        start: free numbers.
        options: see there.
        data: what the loss is of, handed to it at every step: closed over, it would be compiled in as constants.
        moves: a tree like `start` of 1 for numbers that move and 0 for those that stay; all move by default.
        on_step: is called at every step.

    Raises:
        JaxmapError: a loss or a gradient is not finite, or the loss has grown a hundredfold; the steps before were
            handed to `on_step`.
    """
    slope = jax.jit(jax.value_and_grad(loss, has_aux=True))
    schedule = optax.cosine_decay_schedule(options.learning_rate, options.steps)
    optimiser = optax.chain(optax.clip_by_global_norm(options.max_norm), optax.adam(schedule))

    @jax.jit
    def advance(free: PyTree, state: PyTree, gradient: PyTree) -> tuple[PyTree, PyTree, jax.Array]:
        if moves is not None:
            gradient = jax.tree.map(jnp.multiply, gradient, moves)
        updates, state = optimiser.update(gradient, state, free)
        finite = jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient)]).all()
        return optax.apply_updates(free, updates), state, finite

    free, state = start, optimiser.init(start)
    best, first = None, math.inf
    for number in range(options.steps + 1):
        (tuned, held_out), gradient = slope(free, *data)
        moved, state, finite = advance(free, state, gradient)
        losses = Losses(float(tuned), float(held_out))
        if number == 0:
            first = abs(losses.tuned) + 1.0
        if not (math.isfinite(losses.tuned + losses.held_out) and finite) or losses.tuned > 100.0 * first:
            raise JaxmapError(
                f"the loss diverges: {losses.tuned:g}, held out {losses.held_out:g}, after {number} steps"
                + ("; the best parameters before are kept" if best is not None else ""),
                where="tuning",
                fix="take a lower --learning-rate",
            )
        better = best is None or losses.held_out < best.losses.held_out
        step = Step(number, losses, free, better)
        best = step if better else best
        on_step(step)
        assert best is not None
        if number - best.number >= options.patience:
            break
        free = moved
    assert best is not None
    return best


class Slope(NamedTuple):
    """A loss and its gradient, apart: `losses` of free numbers, and what `pull` makes their gradient of."""

    losses: Callable[[PyTree], tuple[tuple[jax.Array, jax.Array], PyTree]]
    pull: Callable[[PyTree, PyTree], PyTree]


LEAST_SHARE = 1 / 64
"""`go_down` ends where no step of this share of the learning rate leads down."""


def go_down(
    slope: Slope,
    start: PyTree,
    options: DescentOptions,
    *,
    moves: PyTree | None = None,
    on_step: Callable[[Step], None] = lambda step: None,
) -> Step:
    """Descends along the gradient, each number scaled by its root mean square, wherever the loss falls.

    The first step is `learning_rate` for every number. A step that leads up is taken back and halved; after one that
    leads down the next is twice as long. A loss that is not finite leads up.

    Args:
        slope: the loss and its gradient.
        start: free numbers.
        options: `steps` are losses, taken back or not; `patience` counts those without a better held-out loss.
        moves: as of `descend`.
        on_step: is called after every loss.

    Returns:
        The step of the least held-out loss among those taken; the first one is the start itself.

    Raises:
        JaxmapError: the loss or its gradient at the start, or a gradient later, is not finite.
    """
    scale = optax.scale_by_rms(decay=0.9, eps=1e-12, bias_correction=True)

    @jax.jit
    def direction(gradient: PyTree, state: PyTree) -> tuple[PyTree, PyTree, jax.Array]:
        if moves is not None:
            gradient = jax.tree.map(jnp.multiply, gradient, moves)
        finite = jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient)]).all()
        return *scale.update(gradient, state), finite

    def evaluated(number: int, free: PyTree, above: float) -> tuple[Step, PyTree]:
        (tuned, held_out), kept = slope.losses(free)
        losses = Losses(float(tuned), float(held_out))
        taken = math.isfinite(losses.tuned + losses.held_out) and losses.tuned < above
        better = taken and (best is None or losses.held_out < best.losses.held_out)
        return Step(number, losses, free, better, taken), kept

    def downhill(at: Step, kept: PyTree, state: PyTree) -> tuple[PyTree, PyTree]:
        way, state, finite = direction(slope.pull(at.free, kept), state)
        if not finite:
            raise _not_finite("the gradient", at)
        return way, state

    best: Step | None = None
    here, kept = evaluated(0, start, math.inf)
    if not here.taken:
        raise _not_finite("the loss", here)
    best = here
    on_step(here)
    way, state = downhill(here, kept, scale.init(start))
    rate = options.learning_rate
    for number in range(1, options.steps + 1):
        there = jax.tree.map(lambda x, d, rate=rate: x - rate * d, here.free, way)
        tried, kept = evaluated(number, there, here.losses.tuned)
        on_step(tried)
        best = tried if tried.best else best
        rate *= 2.0 if tried.taken else 0.5
        if number - best.number >= options.patience or rate < options.learning_rate * LEAST_SHARE:
            break
        if tried.taken and number < options.steps:
            here = tried
            way, state = downhill(here, kept, state)
    return best


def _not_finite(what: str, at: Step) -> JaxmapError:
    return JaxmapError(
        f"{what} is not finite: loss {at.losses.tuned:g}, held out {at.losses.held_out:g}, after {at.number} steps",
        where="tuning",
        fix="start from other numbers, or tune on other frames",
    )
