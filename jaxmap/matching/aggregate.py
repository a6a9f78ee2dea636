"""Semi-global aggregation of matching costs along straight paths (Hirschmueller, PAMI 2008)."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Num


def aggregate(
    volume: Num[Array, "H W D"], p1: Any, p2: Any, paths: int = 8, soft_temperature: Any = None
) -> Num[Array, "H W D"]:
    """Sums the costs of the cheapest paths that end at each pixel and disparity.

    Along a path, `L(p, d) = C(p, d) + min(L(q, d), L(q, d +- 1) + p1, min L(q, .) + p2) - min L(q, .)`, where q comes
    before p.

    Args:
        volume: matching costs, uint8 (exact) or float32.
        p1: penalty of a disparity step of one, in the units and of the type of the volume.
        p2: penalty of a greater step; volume and `p2`, and `p1` and `p2`, together at most 255 where it is uint8.
        paths: 4 (rows and columns) or 8 (and diagonals).
        soft_temperature: softens the minima, in the volume's units; None for hard ones.

    Returns:
        uint16 or float32.
    """
    total = _vertical(volume, p1, p2, paths) + _vertical(volume[::-1], p1, p2, paths)[::-1]
    turned = volume.swapaxes(0, 1)
    across = _vertical(turned, p1, p2, 4) + _vertical(turned[::-1], p1, p2, 4)[::-1]
    return total + across.swapaxes(0, 1)


def _vertical(volume: Num[Array, "H W D"], p1: Any, p2: Any, paths: int) -> Num[Array, "H W D"]:
    """The paths that come from the row above: straight, and the two diagonals where there are 8."""
    wide = jnp.uint16 if volume.dtype == jnp.uint8 else volume.dtype
    shifts = (0, 1, -1) if paths == 8 else (0,)

    def row(
        before: tuple[Num[Array, "W D"], ...], cost: Num[Array, "W D"]
    ) -> tuple[tuple[Num[Array, "W D"], ...], Num[Array, "W D"]]:
        ends = tuple(
            cost + _cheapest_step(_shift(one, shift), p1, p2) for one, shift in zip(before, shifts, strict=True)
        )
        return ends, sum((end.astype(wide) for end in ends), jnp.zeros(cost.shape, wide))

    start = (jnp.zeros(volume.shape[1:], volume.dtype),) * len(shifts)
    return jax.lax.scan(row, start, volume)[1]


def _shift(costs: Num[Array, "W D"], columns: int) -> Num[Array, "W D"]:
    """Moved along the row; a path that enters from the side begins with zeros."""
    if columns == 0:
        return costs
    return jnp.pad(costs, ((1, 0), (0, 0)))[:-1] if columns > 0 else jnp.pad(costs, ((0, 1), (0, 0)))[1:]


def _cheapest_step(before: Num[Array, "W D"], p1: Any, p2: Any) -> Num[Array, "W D"]:
    """What it costs to come from the pixel before, above its least cost; `p2` at most."""
    p1, p2 = jnp.asarray(p1, before.dtype), jnp.asarray(p2, before.dtype)
    stay = jnp.minimum(before - before.min(-1, keepdims=True), p2)
    padded = jnp.pad(stay, ((0, 0), (1, 1)), constant_values=p2)
    return jnp.minimum(stay, jnp.minimum(padded[:, :-2], padded[:, 2:]) + p1)
