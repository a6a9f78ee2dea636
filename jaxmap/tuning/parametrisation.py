"""Legal numbers as free ones: descent moves numbers without bounds, and bijections keep what they stand for legal.

A positive number is the image of any number, a probability too; a row of class increments keeps its own class above
all others. Thus no step of descent, however long, can leave what `make_fusion_params` and the labellers accept.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmap.fusion.params import FusionParams

_EDGE = 1e-4
"""How near, as a share of the range, a start may lie to an end of it: at the end itself nothing would move."""


class Bijection(NamedTuple):
    """From any real numbers to legal ones, and back."""

    legal: Callable[[Array], Array]
    free: Callable[[Array], Array]


class TunedParams(NamedTuple):
    """All that is tuned: the fusion and the numbers of the labeller."""

    fusion: FusionParams
    labeller: dict[str, Array]


def between(low: float, high: float) -> Bijection:
    """Numbers strictly between two bounds."""

    def free(value: Array) -> Array:
        share = jnp.clip((value - low) / (high - low), _EDGE, 1.0 - _EDGE)
        return jnp.log(share) - jnp.log1p(-share)

    return Bijection(lambda x: low + (high - low) * jax.nn.sigmoid(x), free)


def positive(low: float, high: float) -> Bijection:
    """Positive numbers strictly between two bounds, even steps being even factors."""
    inner = between(float(np.log(low)), float(np.log(high)))
    return Bijection(lambda x: jnp.exp(inner.legal(x)), lambda value: inner.free(jnp.log(jnp.maximum(value, low))))


def negative(low: float, high: float) -> Bijection:
    """Minus `positive`."""
    inner = positive(low, high)
    return Bijection(lambda x: -inner.legal(x), lambda value: inner.free(-value))


def own_class_above() -> Bijection:
    """Matrices whose diagonal is positive and above the rest of its row.

    A label speaks for its own class, and for no other class more than for that.
    """
    own, gap = positive(1e-3, 20.0), positive(1e-4, 40.0)

    def legal(x: Array) -> Array:
        mine = own.legal(jnp.diagonal(x))
        return jnp.where(jnp.eye(len(x), dtype=bool), mine[:, None], mine[:, None] - gap.legal(x))

    def free(matrix: Array) -> Array:
        mine = own.legal(own.free(jnp.diagonal(matrix)))
        return jnp.where(
            jnp.eye(len(matrix), dtype=bool),
            own.free(jnp.diagonal(matrix))[:, None],
            gap.free(mine[:, None] - matrix),
        )

    return Bijection(legal, free)


AS_IT_IS = Bijection(lambda x: x, lambda value: value)

FUSION: dict[str, Bijection] = {
    "occupancy_hit": positive(1e-3, 20.0),
    "occupancy_miss": negative(1e-3, 20.0),
    "occupancy_prior": between(-7.0, 7.0),
    "class_increments": own_class_above(),
    "class_prior": between(-7.0, 7.0),
    "disparity_sigma_px": positive(1e-3, 50.0),
    "full_evidence_points": positive(0.1, 1e4),
    "occupancy_threshold": between(1e-3, 1.0 - 1e-3),
    "class_threshold": between(1e-3, 1.0 - 1e-3),
}
"""The bijection of each field of `FusionParams`; priors are log-odds there."""

Limits = Mapping[str, tuple[float, float]]
"""The least and the greatest of each number of a labeller (`TunableLabels.limits`)."""


def to_free(params: TunedParams, limits: Limits) -> TunedParams:
    """The free numbers of parameters; those at an end of their range come a little inwards."""
    return _each(params, limits, lambda bijection, value: bijection.free(value))


def to_legal(free: TunedParams, limits: Limits) -> TunedParams:
    """The parameters of free numbers; legal whatever these are."""
    return _each(free, limits, lambda bijection, value: bijection.legal(value))


def _each(params: TunedParams, limits: Limits, apply: Callable[[Bijection, Array], Array]) -> TunedParams:
    fusion = {
        field.name: apply(FUSION.get(field.name, AS_IT_IS), value)
        for field in fields(FusionParams)
        if (value := getattr(params.fusion, field.name)) is not None
    }
    labeller = {name: apply(positive(*limits[name]), value) for name, value in params.labeller.items()}
    return TunedParams(replace(params.fusion, **fusion), labeller)
