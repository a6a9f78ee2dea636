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
"""Of the image: islands of false matches in the sky are seldom larger, and what stands on the ground is no island."""


class Winners(NamedTuple):
    """What is kept of the aggregated costs of pixels, in the order of disparities from the smallest searched.

    Attributes:
        place: the cheapest disparity.
        cost: what it costs.
        second: the least cost of a disparity that is not its neighbour.
        lower: the cost of the disparity before it; its own where there is none.
        higher: likewise of the one after it.
    """

    place: Int[Array, "*H W"]
    cost: Num[Array, "*H W"]
    second: Num[Array, "*H W"]
    lower: Num[Array, "*H W"]
    higher: Num[Array, "*H W"]


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
    return Winners(place, cost, second, lower, higher)


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
        good &= agrees(place, winner.cost, match_column, design.left_right_max_diff_px)
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


def agrees(
    place: Int[Array, "H W"], cost: Num[Array, "H W"], match_column: Int[Array, "H W"], most_apart: float
) -> Bool[Array, "H W"]:
    """Whether the match, a pixel of the right image, has about the same disparity.

    Its disparity is that of the cheapest of all winners that lead to it, as OpenCV has it.
    """
    row, width = jnp.arange(place.shape[0])[:, None], place.shape[1]
    # Negative columns would be counted from the end.
    match_column = jnp.where(match_column < 0, width, match_column)
    least_cost = jnp.full(place.shape, _most(cost), cost.dtype).at[row, match_column].min(cost, mode="drop")
    is_cheapest = cost == least_cost[row, match_column]
    far = jnp.iinfo(place.dtype).max
    other = jnp.full(place.shape, far, place.dtype)
    other = other.at[row, match_column].min(jnp.where(is_cheapest, place, far), mode="drop")
    return jnp.abs(other[row, match_column] - place) <= most_apart


def drop_speckles(design: MatchDesign, disparity_px: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """Without blobs of few pixels: they are mostly false, and what stands on the ground is no blob."""
    most = most_speckle_px(design, disparity_px.size)
    return drop_blobs(disparity_px, design.speckle_range_px, most) if most else disparity_px


def most_speckle_px(design: MatchDesign, image_px: int) -> int:
    """The most pixels of a blob that is dropped; 0 for none."""
    return usual_speckle_px(image_px) if design.speckle_window_px is None else design.speckle_window_px


def usual_speckle_px(image_px: int) -> int:
    """The same where nothing says otherwise, in images of so many pixels."""
    return max(round(image_px * _SPECKLE_SHARE), _LEAST_SPECKLE_PX)


def drop_edges(design: MatchDesign, disparity_px: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """Without pixels near a step of disparity: there, rocks are smeared over the ground behind."""
    if not design.edge_step_px:
        return disparity_px
    unknown = jnp.isnan(disparity_px)
    near = jnp.where(unknown, jnp.inf, disparity_px)
    far = jnp.where(unknown, -jnp.inf, disparity_px)
    for window in ((design.edge_window_px, 1), (1, design.edge_window_px)):
        near = jax.lax.reduce_window(near, jnp.inf, jax.lax.min, window, (1, 1), "same")
        far = jax.lax.reduce_window(far, -jnp.inf, jax.lax.max, window, (1, 1), "same")
    return jnp.where(far - near > design.edge_step_px, jnp.nan, disparity_px)
