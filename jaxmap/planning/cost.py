"""What a metre of driving is expected to cost, from hazards, the probability of rock, and ground that was not seen.

GESTALT gives each cell the goodness of its worst hazard, falling linearly from 1 to 0 at what the rover cannot drive
(Goldberg, Maimone and Matthies 2002). Here a metre of goodness g costs 1 / g metres; what may be there adds its cost
times its probability, the expected cost (Berger 1985, "Statistical decision theory and Bayesian analysis"). All is
differentiable almost everywhere, so that a map can be tuned by what its errors cost.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxmap.planning.hazards import AnyArray, Hazards, disc_of, grown, shares
from jaxmap.planning.options import RoverOptions

_LEAST_GOODNESS = 0.05
"""A metre of hardly drivable ground costs twenty."""


class CostMap(NamedTuple):
    """What driving costs, for a rover whose centre is over a cell.

    Attributes:
        cost: metres of level driving for each metre; what cannot be driven costs as much as it does by its numbers.
        goodness: of the worst hazard, 0 to 1; 1 where hazards are not known.
        rock: greatest probability of rock under the rover and its margin.
        unknown: share of the disc, with its margin, that was not seen.
        drivable: where the rover may be.
    """

    cost: Float[AnyArray, "X Y"]
    goodness: Float[AnyArray, "X Y"]
    rock: Float[AnyArray, "X Y"]
    unknown: Float[AnyArray, "X Y"]
    drivable: Bool[AnyArray, "X Y"]


@partial(jax.jit, static_argnames=("cell_m", "rover"))
def cost_map(
    hazards: Hazards,
    rock_probability: Float[Array, "X Y"],
    seen: Bool[Array, "X Y"],
    cell_m: tuple[float, float],
    rover: RoverOptions,
) -> CostMap:
    """The expected cost of driving a metre at each cell.

        cost = 1 / goodness + rock_cost * rock + unknown_cost * unknown,
        goodness = min over hazards of clip((max - value) / (max - free * max), 0, 1),

    where `rock` is the greatest, under the rover, of the mean probabilities over the least rock worth a detour.
    The rover stays away from where goodness is 0 within its margin, where more than `max_unknown` was not seen, and
    from the edge of the map.

    Args:
        hazards: of the ground, measured over the rover's disc.
        rock_probability: of each cell, anything where it was not seen; differentiable.
        seen: whether a surface was seen in the cell.
        cell_m: size of a cell, static.
        rover: its size and its costs, static.
    """
    limits = (
        (hazards.step_m, rover.max_step_m),
        (hazards.slope_deg, rover.max_slope_deg),
        (hazards.roughness_m, rover.max_roughness_m),
    )
    known = jnp.isfinite(hazards.slope_deg)
    goods = [_goodness(jnp.where(known, value, 0.0), most, rover.free) for value, most in limits]
    goodness = jnp.min(jnp.stack(goods), axis=0)

    whole = disc_of(rover.radius_m + rover.margin_m, cell_m)
    filled = grown(seen.astype(goodness.dtype), disc_of(rover.gap_m, cell_m), 0.0)
    unknown = 1.0 - shares(filled, whole)
    there = jnp.where(seen, rock_probability, 0.0)
    rock = grown(shares(there, disc_of(rover.rock_m, cell_m)), whole, 0.0)

    # Hazards are those of the disc; only the margin is left to keep.
    near = grown((known & (goodness <= 0)).astype(goodness.dtype), disc_of(rover.margin_m, cell_m), 1.0)
    drivable = (near <= 0) & (unknown <= rover.max_unknown + 1e-6)
    cost = 1 / jnp.maximum(goodness, _LEAST_GOODNESS) + rover.rock_cost * rock + rover.unknown_cost * unknown
    return CostMap(cost, goodness, rock, unknown, drivable)


def path_cost(cost: Float[Array, "X Y"], cells: Int[Array, "N 2"], cell_m: tuple[float, float]) -> Float[Array, ""]:
    """The cost of driving along cells that follow one another, each step at the mean cost of its two ends.

    Differentiable in `cost`. Of the cheapest path it is the least cost itself, whose gradient is the one along the path
    (Danskin 1967): where the map calls for another path, small changes of the cost do not change which is best.
    """
    at = cost[cells[:, 0], cells[:, 1]]
    steps_m = jnp.linalg.norm(jnp.diff(cells, axis=0) * jnp.array(cell_m), axis=1)
    return (steps_m * (at[1:] + at[:-1]) / 2).sum()


def _goodness(value: Array, most: float, free: float) -> Array:
    return jnp.clip((most - value) / (most - free * most), 0.0, 1.0)
