"""What is tuned: descent moves unconstrained numbers, and no step can leave what the settings accept."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple, get_type_hints

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmap.fusion.bijectors import Bijector, between, positive
from jaxmap.fusion.params import FusionParams
from jaxmap.labellers.base import Numbers

_PRIOR, _APART = between(-4.0, 4.0), positive(1e-3, 20.0)
_ABOVE_PRIOR = positive(1e-2, 6.0)

Bijectors = Mapping[str, Bijector]


class TunedParams(NamedTuple):
    """All that is tuned: the fusion and the numbers of the labeller."""

    fusion: FusionParams
    labeller: Numbers


def fusion_bijectors() -> dict[str, Bijector]:
    """The bijector of each field of `FusionParams` that stands alone; the numbers of occupancy go together."""
    hints = get_type_hints(FusionParams, include_extras=True)
    return {name: hint.__metadata__[0] for name, hint in hints.items() if hasattr(hint, "__metadata__")}


def unconstrained(params: TunedParams, labeller: Bijectors) -> TunedParams:
    """The unconstrained numbers of parameters; those at an end of their range come a little inwards.

    Args:
        params: constrained.
        labeller: the bijectors of its numbers.
    """
    fusion = params.fusion
    prior = _PRIOR.unconstrain(fusion.occupancy_prior)
    floor = _PRIOR.constrain(prior)
    occupancy = {
        "occupancy_prior": prior,
        "occupancy_hit": _APART.unconstrain(fusion.occupancy_hit - jnp.maximum(floor, 0.0)),
        "occupancy_miss": _APART.unconstrain(jnp.minimum(floor, 0.0) - fusion.occupancy_miss),
        "occupancy_threshold": _ABOVE_PRIOR.unconstrain(_logit(fusion.occupancy_threshold) - floor),
    }
    return _each(params, labeller, lambda bijector, value: bijector.unconstrain(value), occupancy)


def constrained(free: TunedParams, labeller: Bijectors) -> TunedParams:
    """The parameters of unconstrained numbers, whatever these are.

    In log-odds miss < prior < hit, miss < 0 < hit and prior < threshold: a hit raises the occupancy, a miss lowers it,
    and what was only seen through is never taken for a surface.
    """
    fusion = free.fusion
    prior = _PRIOR.constrain(fusion.occupancy_prior)
    occupancy = {
        "occupancy_prior": prior,
        "occupancy_hit": jnp.maximum(prior, 0.0) + _APART.constrain(fusion.occupancy_hit),
        "occupancy_miss": jnp.minimum(prior, 0.0) - _APART.constrain(fusion.occupancy_miss),
        "occupancy_threshold": jax.nn.sigmoid(prior + _ABOVE_PRIOR.constrain(fusion.occupancy_threshold)),
    }
    return _each(free, labeller, lambda bijector, value: bijector.constrain(value), occupancy)


def _each(
    params: TunedParams, bijectors: Bijectors, apply: Callable[[Bijector, Array], Array], occupancy: dict[str, Array]
) -> TunedParams:
    fusion = {
        name: apply(bijector, value)
        for name, bijector in fusion_bijectors().items()
        if (value := getattr(params.fusion, name)) is not None
    }
    labeller = {name: apply(bijectors[name], value) for name, value in params.labeller.items()}
    return TunedParams(replace(params.fusion, **occupancy, **fusion), labeller)


def _logit(probability: Array) -> Array:
    return jnp.log(probability) - jnp.log1p(-probability)
