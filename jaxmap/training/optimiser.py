"""The optimiser: which weights move, how fast, and on which schedule."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import jax.numpy as jnp
import optax
from jaxtyping import Array, ArrayLike, Float

from jaxmap.training.options import OptimiserOptions

_STATISTICS = (".norm.mean", ".norm.var")


def poly_rate(options: OptimiserOptions, steps: int) -> optax.Schedule:
    """Learning rate by step: a linear rise, times the poly schedule of DeepLab (Chen et al. 2017)."""

    def rate(step: ArrayLike) -> Float[Array, ""]:
        left = jnp.clip(1 - jnp.asarray(step) / max(steps, 1), 0, 1)
        risen = jnp.clip((jnp.asarray(step) + 1) / max(options.warmup_steps, 1), 0, 1)
        return jnp.asarray(options.learning_rate * left**options.power * risen, jnp.float32)

    return rate


def is_statistic(name: str) -> bool:
    """Whether a weight is a running statistic of batch norm, which no gradient moves."""
    return name.endswith(_STATISTICS)


def trained_names(names: Iterable[str], options: OptimiserOptions) -> frozenset[str]:
    """The weights that the optimiser moves."""
    frozen = ("backbone.",) if options.backbone_rate == 0 else ()
    return frozenset(name for name in names if not is_statistic(name) and not name.startswith(frozen))


def make_optimiser(options: OptimiserOptions, steps: int) -> optax.GradientTransformation:
    """The chain of gradient transformations over weights by dotted path."""
    rate = poly_rate(options, steps)
    if options.kind == "adamw":
        moves = optax.adamw(rate, weight_decay=options.weight_decay, mask=_kernels)
    else:
        moves = optax.chain(
            optax.add_decayed_weights(options.weight_decay, mask=_kernels), optax.sgd(rate, options.momentum)
        )
    clip = optax.clip_by_global_norm(options.clip_norm) if options.clip_norm else optax.identity()
    return optax.chain(clip, moves, _scale_backbone(options.backbone_rate))


def _kernels(weights: Mapping[str, Array]) -> dict[str, bool]:
    return {name: name.endswith(".kernel") for name in weights}


def _scale_backbone(factor: float) -> optax.GradientTransformation:
    def scale(updates: Mapping[str, Array], _: object = None) -> dict[str, Array]:
        return {name: update * factor if name.startswith("backbone.") else update for name, update in updates.items()}

    return optax.stateless(scale) if factor != 1 else optax.identity()  # type: ignore[arg-type]
