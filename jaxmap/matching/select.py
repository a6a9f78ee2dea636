"""From aggregated costs to disparity: the winner, and what makes it doubtful."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Num

from jaxmap.matching.aggregate import least
from jaxmap.matching.blobs import drop_blobs
from jaxmap.matching.design import MatchDesign, MatchParams

_SPECKLE_SHARE, _LEAST_SPECKLE_PX = 1 / 800, 100


class Winners(NamedTuple):
    """What is kept of the aggregated costs of pixels, in the order of disparities from the smallest searched.

    Attributes:
        place: the cheapest disparity.
        cost: what it costs.
        second: the least cost of a disparity that is not its neighbour.
        lower: the cost of the disparity before it; its own where there is none.
        higher: likewise of the one after it.
        other: the cheapest disparity of the right image, whose column u stands at u + `min_disparity_px` + D - 1.
    """

    place: Int[Array, "*H W"]
    cost: Num[Array, "*H W"]
    second: Num[Array, "*H W"]
    lower: Num[Array, "*H W"]
    higher: Num[Array, "*H W"]
    other: Int[Array, "*H W_D"]


def select(design: MatchDesign, total: Num[Array, "H W D"], params: MatchParams) -> Float[Array, "H W"]:
    """Disparity with the least aggregated cost in px, float32; NaN where it is doubtful."""
    return decide(design, jax.vmap(winners)(total.swapaxes(1, 2)), params)


def winners(total: Num[Array, "D W"]) -> Winners:
    """The winners of a row of pixels."""
    count, _width = total.shape
    cost = least(total)
    place = _place(total, cost)
    apart = jnp.abs(jnp.arange(count, dtype=place.dtype)[:, None] - place) > 1
    second = least(jnp.where(apart, total, _most(total)))
    lower, higher = (jnp.take_along_axis(total, jnp.clip(place + step, 0, count - 1)[None], 0)[0] for step in (-1, 1))
    from_right = _from_right(total)
    return Winners(place, cost, second, lower, higher, _place(from_right, least(from_right)))


def _from_right(total: Num[Array, "D W"]) -> Num[Array, "D W_D"]:
    """The same by the column that was matched: row d is moved d places to the left."""
    count, width = total.shape
    most = _most(total)
    wide = jnp.pad(total, ((0, 0), (count - 1, count)), constant_values=most)
    # Read with rows that are longer by one, each row begins one place later.
    longer = jnp.pad(wide.reshape(-1), (0, count), constant_values=most).reshape(count, width + 2 * count)
    return longer[:, : width + count - 1]


def _place(total: Num[Array, "D W"], cost: Num[Array, "W"]) -> Int[Array, "W"]:
    """The first disparity of that cost."""
    count = total.shape[0]
    return least(jnp.where(total == cost, jnp.arange(count, dtype=jnp.int16)[:, None], jnp.int16(count - 1)))


def _most(total: Num[Array, "D W"]) -> Any:
    return jnp.iinfo(total.dtype).max if jnp.issubdtype(total.dtype, jnp.integer) else jnp.inf


def decide(design: MatchDesign, winner: Winners, params: MatchParams) -> Float[Array, "H W"]:
    """The disparity in px of winners that nothing makes doubtful, NaN of the others."""
    width = winner.place.shape[1]
    place = winner.place.astype(jnp.int32)
    match_column = jnp.arange(width) - design.min_disparity_px - place
    good = (match_column >= 0) & (match_column < width)
    good &= winner.second.astype(jnp.float32) * (1 - params.uniqueness) > winner.cost.astype(jnp.float32)
    if design.left_right_max_diff_px >= 0:
        good &= _agrees(design, place, winner.other)
    disparity_px = jnp.where(good, design.min_disparity_px + between_pixels(design, winner), jnp.nan)
    disparity_px = drop_speckles(design, disparity_px)
    return drop_edges(design, disparity_px)


def between_pixels(design: MatchDesign, winner: Winners) -> Float[Array, "H W"]:
    """The minimum of the parabola through the winner and its neighbours, in places."""
    lower, here, higher = (cost.astype(jnp.float32) for cost in (winner.lower, winner.cost, winner.higher))
    bend = lower + higher - 2 * here
    offset = jnp.where(bend > 0, (lower - higher) / (2 * jnp.where(bend > 0, bend, 1)), 0)
    has_both = (winner.place > 0) & (winner.place < design.num_disparities - 1)
    return winner.place + jnp.where(has_both, offset, 0)


def _agrees(design: MatchDesign, place: Int[Array, "H W"], other: Int[Array, "H W"]) -> Bool[Array, "H W"]:
    """Whether the pixel of the right image that was matched prefers about the same disparity."""
    matched = jnp.arange(place.shape[1]) - place + design.num_disparities - 1
    return jnp.abs(jnp.take_along_axis(other, matched, 1) - place) <= design.left_right_max_diff_px


def drop_speckles(design: MatchDesign, disparity_px: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """Without blobs of few pixels: they are mostly false, and what stands on the ground is no blob."""
    most = design.speckle_window_px
    if most is None:
        most = max(round(disparity_px.size * _SPECKLE_SHARE), _LEAST_SPECKLE_PX)
    return drop_blobs(disparity_px, design.speckle_range_px, most) if most else disparity_px


def drop_edges(design: MatchDesign, disparity_px: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """Without pixels near a step of disparity: there, rocks are smeared over the ground behind."""
    if not design.edge_step_px:
        return disparity_px
    window, unknown = (design.edge_window_px,) * 2, jnp.isnan(disparity_px)
    near = jnp.where(unknown, jnp.inf, disparity_px)
    far = jnp.where(unknown, -jnp.inf, disparity_px)
    for axis in (0, 1):
        window = tuple(design.edge_window_px if axis == one else 1 for one in (0, 1))
        near = jax.lax.reduce_window(near, jnp.inf, jax.lax.min, window, (1, 1), "same")
        far = jax.lax.reduce_window(far, -jnp.inf, jax.lax.max, window, (1, 1), "same")
    return jnp.where(far - near > design.edge_step_px, jnp.nan, disparity_px)
