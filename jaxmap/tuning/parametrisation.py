"""Legal numbers as free ones: descent moves numbers without bounds, and bijections keep what they stand for legal.

A positive number is the image of any number, a probability too; a class gains most by its own label. Thus no step of
descent, however long, can leave what `make_fusion_params` and the labellers accept.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmap.fusion.params import FusionParams

_EDGE = 0.01
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


def own_label_above() -> Bijection:
    """Matrices whose diagonal is positive and above the rest of its column.

    A class gains by its own label, and by no other label more than by that. Column by column, so that tuning one class
    leaves the others as they are.
    """
    own, gap = positive(1e-3, 20.0), positive(1e-4, 40.0)

    def legal(x: Array) -> Array:
        mine = own.legal(jnp.diagonal(x))[None, :]
        return jnp.where(jnp.eye(len(x), dtype=bool), mine, mine - gap.legal(x))

    def free(matrix: Array) -> Array:
        mine = own.free(jnp.diagonal(matrix))[None, :]
        return jnp.where(jnp.eye(len(matrix), dtype=bool), mine, gap.free(own.legal(mine) - matrix))

    return Bijection(legal, free)


def rings(low: float, high: float) -> Bijection:
    """Kernels (C, K, K) of 1 in the middle and one weight a ring around it, strictly between two bounds.

    Elements equally far from the middle weigh the same: a kernel must not know which way the rover drove.
    """
    inner = between(low, high)

    def ring_of(size: int) -> np.ndarray:
        squares = (np.arange(size) - size // 2) ** 2
        return np.unique(squares[:, None] + squares, return_inverse=True)[1].reshape(size, size)

    def legal(x: Array) -> Array:
        ring = ring_of(x.shape[1])
        # (rings, K, K): the mean over each ring, and back to its elements.
        members = (ring == np.arange(ring.max() + 1)[:, None, None]).astype(np.float32)
        means = jnp.einsum("rij,cij->cr", members / members.sum(axis=(1, 2), keepdims=True), x)
        return jnp.where(ring == 0, 1.0, inner.legal(means)[:, ring])

    return Bijection(legal, inner.free)


_PRIOR, _APART = between(-4.0, 4.0), positive(1e-3, 20.0)
_ABOVE_PRIOR = positive(1e-2, 6.0)

FUSION: dict[str, Bijection] = {
    "class_increments": own_label_above(),
    "class_prior": between(-7.0, 7.0),
    "disparity_sigma_px": positive(1e-3, 50.0),
    "full_evidence_points": positive(0.1, 1e4),
    "class_threshold": between(1e-3, 1.0 - 1e-3),
    "class_kernel": rings(-0.5, 1.0),
}
"""The bijection of each field of `FusionParams` that stands alone; the numbers of occupancy go together."""

Limits = Mapping[str, tuple[float, float]]
"""The least and the greatest of each number of a labeller (`TunableLabels.limits`)."""


def to_free(params: TunedParams, limits: Limits) -> TunedParams:
    """The free numbers of parameters; those at an end of their range come a little inwards."""
    fusion = params.fusion
    prior = _PRIOR.free(fusion.occupancy_prior)
    floor = _PRIOR.legal(prior)
    occupancy = {
        "occupancy_prior": prior,
        "occupancy_hit": _APART.free(fusion.occupancy_hit - jnp.maximum(floor, 0.0)),
        "occupancy_miss": _APART.free(jnp.minimum(floor, 0.0) - fusion.occupancy_miss),
        "occupancy_threshold": _ABOVE_PRIOR.free(_logit(fusion.occupancy_threshold) - floor),
    }
    return _each(params, limits, lambda bijection, value: bijection.free(value), occupancy)


def to_legal(free: TunedParams, limits: Limits) -> TunedParams:
    """The parameters of free numbers; legal whatever these are.

    In log-odds miss < prior < hit, miss < 0 < hit and prior < threshold: a hit raises the occupancy, a miss lowers it,
    and what was only seen through is never taken for a surface.
    """
    fusion = free.fusion
    prior = _PRIOR.legal(fusion.occupancy_prior)
    occupancy = {
        "occupancy_prior": prior,
        "occupancy_hit": jnp.maximum(prior, 0.0) + _APART.legal(fusion.occupancy_hit),
        "occupancy_miss": jnp.minimum(prior, 0.0) - _APART.legal(fusion.occupancy_miss),
        "occupancy_threshold": jax.nn.sigmoid(prior + _ABOVE_PRIOR.legal(fusion.occupancy_threshold)),
    }
    return _each(free, limits, lambda bijection, value: bijection.legal(value), occupancy)


def _each(
    params: TunedParams,
    limits: Limits,
    apply: Callable[[Bijection, Array], Array],
    occupancy: dict[str, Array],
) -> TunedParams:
    fusion = {
        name: apply(bijection, value)
        for name, bijection in FUSION.items()
        if (value := getattr(params.fusion, name)) is not None
    }
    labeller = {name: apply(positive(*limits[name]), value) for name, value in params.labeller.items()}
    return TunedParams(replace(params.fusion, **occupancy, **fusion), labeller)


def _logit(probability: Array) -> Array:
    return jnp.log(probability) - jnp.log1p(-probability)
