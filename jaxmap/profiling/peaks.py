"""What this machine reaches where nothing but memory, or nothing but arithmetic, bounds it."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

_COPIED = 1 << 25
_EDGE = 2048
_REPEATS = 7


class Peaks(NamedTuple):
    """Bytes read and written by a copy, and operations of a float32 product of matrices, a second."""

    bytes_per_s: float
    flops_per_s: float


def measure_peaks() -> Peaks:
    """Changes 128 MiB in place, more than caches hold; multiplies matrices of 2048 x 2048: each the median of seven."""
    # In place, as fresh memory has to be fetched from the system first, which takes longer than to fill it.
    negate = jax.jit(jnp.negative, donate_argnums=0)
    values, matrix = jnp.ones(_COPIED, jnp.float32), jnp.ones((_EDGE, _EDGE), jnp.float32)
    copied_s = _median_s(negate, values, over=True)
    product = jax.jit(lambda one: jnp.dot(one, one, precision=jax.lax.Precision.HIGHEST))
    return Peaks(8 * _COPIED / copied_s, 2 * _EDGE**3 / _median_s(product, matrix, over=False))


def _median_s(function: Callable[[jax.Array], jax.Array], argument: jax.Array, *, over: bool) -> float:
    """How long a function takes; `over`: it goes on with what it gave back."""
    result = function(argument).block_until_ready()
    times_s = []
    for _ in range(_REPEATS):
        started_s = time.perf_counter()
        result = function(result if over else argument).block_until_ready()
        times_s.append(time.perf_counter() - started_s)
    return statistics.median(times_s)
