"""From aggregated costs to disparity: the winner, and what makes it doubtful."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

from jaxmap.matching.costs import inside
from jaxmap.matching.design import MatchDesign, MatchParams

_SPECKLE_SHARE, _LEAST_SPECKLE_PX = 1 / 800, 100


def select(design: MatchDesign, total: Num[Array, "H W D"], params: MatchParams) -> Float[Array, "H W"]:
    """Disparity with the least aggregated cost in px, float32; NaN where it is doubtful."""
    best = jnp.argmin(total, -1).astype(jnp.int32)
    good = _is_unique(total, best, params.uniqueness) & inside(design, total.shape[1])[:, 0]
    disparity_px = design.min_disparity_px + _between_pixels(total, best)
    if design.left_right_max_diff_px >= 0:
        good &= _agrees_from_right(design, total, best)
    disparity_px = jnp.where(good, disparity_px, jnp.nan)
    disparity_px = drop_speckles(design, disparity_px)
    return drop_edges(design, disparity_px)


def _at(total: Num[Array, "H W D"], place: Int[Array, "H W"]) -> Num[Array, "H W"]:
    return jnp.take_along_axis(total, place[..., None], -1)[..., 0]


def _is_unique(total: Num[Array, "H W D"], best: Int[Array, "H W"], share: Any) -> Bool[Array, "H W"]:
    """Whether the winner is cheaper by that share than all but its neighbours."""
    apart = jnp.abs(jnp.arange(total.shape[-1]) - best[..., None]) > 1
    second = jnp.where(apart, total.astype(jnp.float32), jnp.inf).min(-1)
    return second * (1 - share) >= _at(total, best)


def _between_pixels(total: Num[Array, "H W D"], best: Int[Array, "H W"]) -> Float[Array, "H W"]:
    """The minimum of the parabola through the winner and its neighbours."""
    last = total.shape[-1] - 1
    before, after = (_at(total, jnp.clip(best + step, 0, last)).astype(jnp.float32) for step in (-1, 1))
    here = _at(total, best).astype(jnp.float32)
    bend = before + after - 2 * here
    offset = jnp.where(bend > 0, (before - after) / (2 * jnp.maximum(bend, 1)), 0)
    return best + jnp.where((best > 0) & (best < last), offset, 0)


def _agrees_from_right(design: MatchDesign, total: Num[Array, "H W D"], best: Int[Array, "H W"]) -> Bool[Array, "H W"]:
    """Whether the pixel of the right image that was matched prefers about the same disparity."""
    width, count = total.shape[1:]
    disparity = design.min_disparity_px + jnp.arange(count)
    column = jnp.arange(width)[:, None] + disparity
    seen = (column >= 0) & (column < width)
    moved = total[:, jnp.clip(column, 0, width - 1), jnp.arange(count)]
    most = jnp.iinfo(total.dtype).max if jnp.issubdtype(total.dtype, jnp.integer) else jnp.inf
    right = jnp.argmin(jnp.where(seen, moved, most), -1)
    there = jnp.clip(jnp.arange(width) - design.min_disparity_px - best, 0, width - 1)
    other = jnp.take_along_axis(right, there, 1)
    return jnp.abs(other - best) <= design.left_right_max_diff_px


def drop_speckles(design: MatchDesign, disparity_px: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """Without blobs of few pixels."""
    return disparity_px


def drop_edges(design: MatchDesign, disparity_px: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """Without pixels near a step of disparity."""
    if not design.edge_step_px:
        return disparity_px
    window = (design.edge_window_px,) * 2
    unknown = jnp.isnan(disparity_px)
    least = jax.lax.reduce_window(
        jnp.where(unknown, jnp.inf, disparity_px), jnp.inf, jax.lax.min, window, (1, 1), "same"
    )
    most = jax.lax.reduce_window(
        jnp.where(unknown, -jnp.inf, disparity_px), -jnp.inf, jax.lax.max, window, (1, 1), "same"
    )
    return jnp.where(most - least > design.edge_step_px, jnp.nan, disparity_px)
