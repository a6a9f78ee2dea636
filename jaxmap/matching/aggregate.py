"""Semi-global aggregation of matching costs along straight paths (Hirschmueller, PAMI 2008).

Along a path, with q the pixel before p,

    L(p, d) = C(p, d) + M(q, d),   M(q, d) = min(L(q, d), L(q, d - 1) + p1, L(q, d + 1) + p1, min_k L(q, k) + p2)
                                             - min_k L(q, k)

and M is 0 where the path begins. Inside, volumes are planes, one for each disparity: then all that a pixel needs of
other disparities and columns is a matter of whole rows, which processors work off many at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Num

Rows = TypeVar("Rows")
Plane = Num[Array, "D W"]


def aggregate(volume: Num[Array, "H W D"], p1: Any, p2: Any, paths: int = 8) -> Num[Array, "H W D"]:
    """Sums the costs of the cheapest paths that end at each pixel and disparity.

    Args:
        volume: matching costs, uint8 (exact) or float32.
        p1: penalty of a disparity step of one, in the units and of the type of the volume.
        p2: penalty of a greater step; where the volume is uint8, at most 127, with it at most 255, and so with `p1`.
        paths: 4 (rows and columns) or 8 (and diagonals).

    Returns:
        uint16 or float32.
    """
    planes = jnp.moveaxis(volume, -1, 0)
    total = aggregate_planes(planes, planes.swapaxes(1, 2), p1, p2, paths, lambda row: row)
    return total.swapaxes(1, 2)


def aggregate_planes(
    planes: Num[Array, "D H W"],
    turned: Num[Array, "D W H"],
    p1: Any,
    p2: Any,
    paths: int,
    finish: Callable[[Plane], Rows],
) -> Rows:
    """The same for planes, row by row: what `finish` makes of the sums of each row, stacked.

    Only sums of the paths that come from the sides and from above are ever stored.

    Args:
        planes: costs.
        turned: the same, each plane as (W, H).
        p1: as in `aggregate`.
        p2: likewise.
        paths: likewise.
        finish: takes the sums (D, W) of a row.
    """
    p1, p2 = jnp.asarray(p1, planes.dtype), jnp.asarray(p2, planes.dtype)
    wide = jnp.uint16 if planes.dtype == jnp.uint8 else planes.dtype
    moves = (0, 1, -1) if paths == 8 else (0,)

    from_left = _sweep(turned, None, p1, p2, (0,), planes.dtype)
    from_sides = _sweep(turned, from_left, p1, p2, (0,), planes.dtype, backwards=True).swapaxes(1, 2)
    so_far = _sweep(planes, from_sides, p1, p2, moves, wide)

    def row(ends: tuple[Plane, ...], y: Array) -> tuple[tuple[Plane, ...], Rows]:
        cost, others = (lax.dynamic_index_in_dim(volume, y, 1, keepdims=False) for volume in (planes, so_far))
        before = _before(ends, moves, p1, p2)
        total = others + paths * cost.astype(wide) + _summed(before, wide)
        return tuple(cost + one for one in before), finish(total)

    height = planes.shape[1]
    return lax.scan(row, _begin(planes, moves), jnp.arange(height), reverse=True)[1]


def _sweep(
    planes: Num[Array, "D H W"],
    others: Num[Array, "D H W"] | None,
    p1: Array,
    p2: Array,
    moves: tuple[int, ...],
    dtype: Any,
    backwards: bool = False,
) -> Num[Array, "D H W"]:
    """Walks down the rows and adds up M of the paths that come from the row before, to those of others."""
    height = planes.shape[1]

    def row(i: Array, state: tuple[tuple[Plane, ...], Array]) -> tuple[tuple[Plane, ...], Array]:
        ends, sums = state
        y = height - 1 - i if backwards else i
        before = _before(ends, moves, p1, p2)
        added = _summed(before, dtype)
        if others is not None:
            added += lax.dynamic_index_in_dim(others, y, 1, keepdims=False)
        cost = lax.dynamic_index_in_dim(planes, y, 1, keepdims=False)
        return tuple(cost + one for one in before), lax.dynamic_update_index_in_dim(sums, added, y, 1)

    return lax.fori_loop(0, height, row, (_begin(planes, moves), jnp.zeros(planes.shape, dtype)))[1]


def _begin(planes: Num[Array, "D H W"], moves: tuple[int, ...]) -> tuple[Plane, ...]:
    """Ends of paths before the first row: equal costs, of which M is 0."""
    return tuple(jnp.zeros((planes.shape[0], planes.shape[2]), planes.dtype) for _ in moves)


def _before(ends: tuple[Plane, ...], moves: tuple[int, ...], p1: Array, p2: Array) -> list[Plane]:
    """M of each path, moved to the columns that it goes to."""
    return [_moved(_least_rise(end, p1, p2), move) for end, move in zip(ends, moves, strict=True)]


def _least_rise(end: Plane, p1: Array, p2: Array) -> Plane:
    """M: what it costs to come from the pixel before, above its least cost; `p2` at most."""
    stay = jnp.minimum(end - least(end), p2)
    edge = jnp.full((1, end.shape[1]), p2)
    lower, higher = jnp.concatenate([edge, stay[:-1]]), jnp.concatenate([stay[1:], edge])
    return jnp.minimum(stay, jnp.minimum(lower, higher) + p1)


def least(costs: Plane) -> Num[Array, "W"]:
    """The least cost of each column.

    Of small integers, XLA finds the greatest several times faster on a CPU.
    """
    return ~(~costs).max(0) if jnp.issubdtype(costs.dtype, jnp.integer) else costs.min(0)


def _moved(costs: Plane, columns: int) -> Plane:
    """Moved along the row, with zeros where paths begin."""
    width = costs.shape[1]
    margin = (max(columns, 0), max(-columns, 0))
    return jnp.pad(costs, ((0, 0), margin))[:, margin[1] : margin[1] + width] if columns else costs


def _summed(parts: list[Plane], dtype: Any) -> Plane:
    return sum((part.astype(dtype) for part in parts[1:]), parts[0].astype(dtype))
