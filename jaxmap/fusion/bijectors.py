"""Bijectors between constrained and unconstrained numbers: descent moves the latter, and no step can leave the former.

A positive number is the image of any number, a probability too; a class gains most by its own label.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

_EDGE = 0.01
"""How near, as a share of the range, a start may lie to an end of it: at the end itself nothing would move."""


class Bijector(NamedTuple):
    """From any real numbers to constrained ones, and back."""

    constrain: Callable[[Array], Array]
    unconstrain: Callable[[Array], Array]


def between(low: float, high: float) -> Bijector:
    """Numbers strictly between two bounds."""

    def unconstrain(value: Array) -> Array:
        share = jnp.clip((value - low) / (high - low), _EDGE, 1.0 - _EDGE)
        return jnp.log(share) - jnp.log1p(-share)

    return Bijector(lambda x: low + (high - low) * jax.nn.sigmoid(x), unconstrain)


def positive(low: float, high: float) -> Bijector:
    """Positive numbers strictly between two bounds, even steps being even factors."""
    log = between(float(np.log(low)), float(np.log(high)))
    return Bijector(
        lambda x: jnp.exp(log.constrain(x)), lambda value: log.unconstrain(jnp.log(jnp.maximum(value, low)))
    )


def own_label_above() -> Bijector:
    """Matrices whose diagonal is positive and above the rest of its column.

    A class gains by its own label, and by no other label more than by that. Column by column, so that tuning one class
    leaves the others as they are.
    """
    own, gap = positive(1e-3, 20.0), positive(1e-4, 40.0)

    def constrain(x: Array) -> Array:
        mine = own.constrain(jnp.diagonal(x))[None, :]
        return jnp.where(jnp.eye(len(x), dtype=bool), mine, mine - gap.constrain(x))

    def unconstrain(matrix: Array) -> Array:
        mine = own.unconstrain(jnp.diagonal(matrix))[None, :]
        return jnp.where(jnp.eye(len(matrix), dtype=bool), mine, gap.unconstrain(own.constrain(mine) - matrix))

    return Bijector(constrain, unconstrain)


def rings(low: float, high: float) -> Bijector:
    """Kernels (C, K, K) of 1 in the middle and one weight a ring around it, strictly between two bounds.

    Elements equally far from the middle weigh the same: a kernel must not know which way the rover drove.
    """
    weight = between(low, high)

    def ring_of(size: int) -> np.ndarray:
        squares = (np.arange(size) - size // 2) ** 2
        return np.unique(squares[:, None] + squares, return_inverse=True)[1].reshape(size, size)

    def constrain(x: Array) -> Array:
        ring = ring_of(x.shape[1])
        # (rings, K, K): the mean over each ring, and back to its elements.
        members = (ring == np.arange(ring.max() + 1)[:, None, None]).astype(np.float32)
        means = jnp.einsum("rij,cij->cr", members / members.sum(axis=(1, 2), keepdims=True), x)
        return jnp.where(ring == 0, 1.0, weight.constrain(means)[:, ring])

    return Bijector(constrain, weight.unconstrain)
