"""Semi-global matching with soft minima: gradients reach penalties, temperature, cost network and images.

The recurrence along a path is Hirschmueller's (PAMI 2008) with every minimum made soft, as GA-Net does (Zhang,
Prisacariu, Yang and Torr, CVPR 2019; it takes sums and maxima of scores), and the penalties are learnt through it as in
SGM-Nets (Seki and Pollefeys, CVPR 2017). With a soft minimum of costs it is the forward pass of a hidden Markov model
whose states are disparities. As the temperature goes to 0, all becomes what the hard mode computes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from jaxmap.matching.costs import cost_volume
from jaxmap.matching.design import MatchDesign, MatchParams
from jaxmap.matching.select import select

AROUND_PX = 2
"""Disparities so far from the winner share in the soft-argmin."""

_FAR = 1e4
"""A cost that loses every comparison, and is finite all the same: gradients of infinities are not."""
_FLAT = 0.01
"""Where costs are flat around the winner, their bend is taken for this share of the temperature at least."""


class SoftMatch(NamedTuple):
    """The disparity in px, NaN where there is none, and how surely it is the right one, between 0 and 1.

    The confidence is differentiable too. It passes 0.5 where the hard mode calls a match unique.
    """

    disparity_px: Float[Array, "H W"]
    confidence: Float[Array, "H W"]


def soft_match(
    design: MatchDesign, left: Num[Array, "H W"], right: Num[Array, "H W"], params: MatchParams
) -> SoftMatch:
    """Disparity of the left image.

    Args:
        design: a soft one.
        left: rectified, grey, 0 to 255; float where its gradient is asked for.
        right: likewise, of the same size.
        params: the numbers.
    """
    volume = cost_volume(design, left, right, params)
    mean = aggregate_soft(volume, params.p1, params.p2, params.temperature, design.paths)
    return select_soft(design, mean, params)


def aggregate_soft(
    volume: Float[Array, "H W D"], p1: Any, p2: Any, temperature: Any, paths: int = 8
) -> Float[Array, "H W D"]:
    """Mean over the paths of the costs of what leads to each pixel and disparity, in the units of the volume.

    For its gradient the costs at each pixel are kept once for each path, and all else is computed again.

    Args:
        volume: matching costs.
        p1: penalty of a disparity step of one.
        p2: penalty of a greater step.
        temperature: softens the minima, in the same units.
        paths: 4 (rows and columns) or 8 (and diagonals).
    """
    with jax.named_scope("aggregate_soft"):
        volume = volume.astype(jnp.result_type(volume, temperature))
        down = _sweep(volume, p1, p2, temperature, (0, 1, -1) if paths == 8 else (0,))
        along = _sweep(volume.swapaxes(0, 1), p1, p2, temperature, (0,))
        return (down + along.swapaxes(0, 1)) / paths


def _sweep(
    volume: Float[Array, "H W D"], p1: Any, p2: Any, temperature: Any, shifts: tuple[int, ...]
) -> Float[Array, "H W D"]:
    """The sum over the paths that come from the row before, and from the row after, with these shifts along the row."""

    @jax.checkpoint
    def row(before: Float[Array, "s 2 W D"], costs: Float[Array, "2 W D"]) -> tuple[Array, Array]:
        came = jnp.stack([_shifted(one, shift) for one, shift in zip(before, shifts, strict=True)])
        ends = costs + _soft_step(came, p1, p2, temperature)
        return ends, ends.sum(0)

    both = jnp.stack([volume, volume[::-1]], 1)
    start = jnp.zeros((len(shifts), *both.shape[1:]), volume.dtype)
    ends = jax.lax.scan(row, start, both)[1]
    return ends[:, 0] + ends[::-1, 1]


def _shifted(costs: Float[Array, "2 W D"], columns: int) -> Float[Array, "2 W D"]:
    """Moved along the row; a path that enters from the side begins with zeros."""
    before, after = max(columns, 0), max(-columns, 0)
    return jnp.pad(costs, ((0, 0), (before, after), (0, 0)))[:, after : after + costs.shape[1]]


def _soft_step(before: Float[Array, "*s D"], p1: Any, p2: Any, temperature: Any) -> Float[Array, "*s D"]:
    """What it costs to come from the pixel before, above its least cost."""
    stay = before - soft_minimum(before, temperature)[..., None]
    padded = jnp.pad(stay, [(0, 0)] * (stay.ndim - 1) + [(1, 1)], constant_values=_FAR)
    ways = [stay, padded[..., :-2] + p1, padded[..., 2:] + p1, jnp.broadcast_to(p2, stay.shape).astype(stay.dtype)]
    return soft_minimum(jnp.stack(ways), temperature, axis=0)


def soft_minimum(costs: Float[Array, "..."], temperature: Any, axis: int = -1) -> Float[Array, "..."]:
    """`-T log sum exp(-cost / T)` along an axis: below the minimum by `T log k` at most, for k costs."""
    return -temperature * jax.nn.logsumexp(-costs / temperature, axis=axis)


def select_soft(design: MatchDesign, mean: Float[Array, "H W D"], params: MatchParams) -> SoftMatch:
    """The soft-argmin of aggregated costs around their winner, and its confidence.

    Each disparity near the winner stands for the minimum of the parabola through it and its neighbours, at most half a
    pixel away; they are weighed by a softmax of their costs. Which disparity wins, and which pixels the checks of the
    hard mode leave out, is decided as there: decisions have no gradient.

    Args:
        design: the disparities and the checks.
        mean: aggregated costs, in units of the cost.
        params: uniqueness and temperature.
    """
    with jax.named_scope("select_soft"):
        place = jnp.arange(mean.shape[-1])
        best = jax.lax.stop_gradient(jnp.argmin(mean, -1))[..., None]
        apart = jnp.abs(place - best)
        weight = jax.nn.softmax(-mean / params.temperature, axis=-1, where=apart <= AROUND_PX)
        disparity_px = design.min_disparity_px + (weight * (place + _offset(mean, params.temperature))).sum(-1)
        confidence = _confidence(mean, apart <= 1, params)
        return SoftMatch(jnp.where(_passes(design, mean, params), disparity_px, jnp.nan), confidence)


def _offset(mean: Float[Array, "H W D"], temperature: Any) -> Float[Array, "H W D"]:
    """From each disparity to the minimum of the parabola through it and its neighbours, at most half a pixel."""
    before, after, here = mean[..., :-2], mean[..., 2:], mean[..., 1:-1]
    bend = jnp.maximum(before + after - 2 * here, 0) + _FLAT * temperature
    return jnp.pad(jnp.clip((before - after) / (2 * bend), -0.5, 0.5), ((0, 0), (0, 0), (1, 1)))


def _confidence(mean: Float[Array, "H W D"], near: Bool[Array, "H W D"], params: MatchParams) -> Float[Array, "H W"]:
    """How far the best match apart from the winner is above what uniqueness asks for."""
    best = mean.min(-1)
    second = soft_minimum(jnp.where(near, _FAR, mean), params.temperature)
    margin = second * (1 - params.uniqueness) - best
    return jax.nn.sigmoid(margin / params.temperature)


def _passes(design: MatchDesign, mean: Float[Array, "H W D"], params: MatchParams) -> Bool[Array, "H W"]:
    """The pixels that the checks of the hard mode keep, uniqueness apart, which is the confidence here."""
    fixed = jax.lax.stop_gradient((mean, params))
    return jnp.isfinite(select(design, fixed[0], replace(fixed[1], uniqueness=jnp.zeros_like(params.uniqueness))))
