"""The numbers of a matcher as unconstrained ones: descent moves those, and no step leaves what the settings accept."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from jaxmap.fusion.bijectors import between, positive
from jaxmap.matching.design import MOST_P2, MatchParams

FreeMatch = dict[str, PyTree]
"""`step_penalty jump_penalty uniqueness`, and `cost_network`: an empty tree, or how far its weights have moved."""

_STEP, _ABOVE = positive(0.004, 0.5), between(0.0, 1.0)
_UNIQUENESS = between(0.0, 0.6)
_WEIGHT_SHARE = 0.02
"""Of the spread of a layer's weights: how far they move for a step of one."""


def free_match(params: MatchParams) -> FreeMatch:
    """The unconstrained numbers; those at an end of their range come a little inwards. Weights have not moved yet."""
    return {
        "step_penalty": _STEP.unconstrain(params.p1),
        "jump_penalty": _ABOVE.unconstrain((params.p2 - params.p1) / (MOST_P2 - params.p1)),
        "uniqueness": _UNIQUENESS.unconstrain(params.uniqueness),
        "cost_network": jax.tree.map(jnp.zeros_like, params.cost),
    }


def matched_by(free: FreeMatch, start: MatchParams) -> MatchParams:
    """The matcher's parameters of unconstrained numbers: `p1 < p2`, and what is not tuned as at the start.

    The temperature is not: it is how the hard minimum is softened, and a map is matched without it.
    """
    p1 = _STEP.constrain(free["step_penalty"])

    def moved(weight: Any, by: Any) -> Any:
        return weight + _WEIGHT_SHARE * jnp.std(weight) * by

    return replace(
        start,
        p1=p1,
        p2=p1 + (MOST_P2 - p1) * _ABOVE.constrain(free["jump_penalty"]),
        uniqueness=_UNIQUENESS.constrain(free["uniqueness"]),
        cost=jax.tree.map(moved, start.cost, free["cost_network"]),
    )
