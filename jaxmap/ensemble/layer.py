"""Reading an ensemble: how likely a column that the map does not call rock is rock all the same."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmap.errors import JaxmapError
from jaxmap.fusion.params import FusionParams, FusionRule
from jaxmap.fusion.query import top_down
from jaxmap.types import VoxelMap

AnyArray = Array | np.ndarray
"""Of JAX or of NumPy."""


class EnsembleLayers(NamedTuple):
    """What an ensemble says of each column, seen from above; NaN where the map saw no surface.

    `probability` is that of the class; `missed` the same where the map does not call the class, 0 where it does.
    """

    probability: Float[AnyArray, "X Y"]
    missed: Float[AnyArray, "X Y"]


@partial(jax.jit, static_argnames="rule")
def ensemble_layers(voxel_map: VoxelMap, params: FusionParams, rule: FusionRule) -> EnsembleLayers:
    """The probability of the class asked about (`FusionRule.target`), and that the map misses it.

    Poses, disparities and the sensor model are not known but to their errors `e`; what is asked is the probability
    whatever these were, `p(rock | z) = E_e[p(rock | z, e)]`, the law of total probability (Bayesian model averaging,
    Hoeting et al. 1999, eq. 1). With the members drawn from the errors, and the map itself as one more, of no error,

        probability = (p_0 + sum_m s_m p_m) / (1 + sum_m s_m),    missed = 0 where the map calls rock, else probability,

    where `p_m` is what member `m` gives the column from above (`query.top_down`) and `s_m` whether it saw a surface
    there: of ground that it did not see it has nothing to say. Assumed are errors as drawn, independent of what the
    labels get wrong: rock that every frame labels sand is not found by this.

    Args:
        voxel_map: with members.
        params: how the map is read, and its members as well.
        rule: see `params`.
    """
    target = rule.target(voxel_map.classes)
    assert target is not None and voxel_map.members is not None
    index = voxel_map.classes.index(target)
    own = top_down(voxel_map, params, rule)
    read_one = replace(params, class_prior=params.class_prior[index : index + 1])

    def add(sums: tuple[Array, Array], log_odds: Array) -> tuple[tuple[Array, Array], None]:
        member = replace(voxel_map, log_odds=log_odds, classes=(target,), members=None)
        top = top_down(member, read_one, rule)
        return (sums[0] + jnp.where(top.observed, top.probability[0], 0.0), sums[1] + top.observed), None

    start = (own.probability[index], jnp.ones(own.observed.shape, jnp.float32))
    (total, count), _ = jax.lax.scan(add, start, voxel_map.members)
    probability = jnp.where(own.observed, total / count, jnp.nan)
    return EnsembleLayers(probability, jnp.where(own.observed & (own.label == index), 0.0, probability))


def named_layers(voxel_map: VoxelMap, params: FusionParams, rule: FusionRule) -> dict[str, Float[np.ndarray, "X Y"]]:
    """`ensemble_layers` under the names they are stored by; none of a map without members."""
    target = rule.target(voxel_map.classes)
    if target is None or voxel_map.members is None:
        return {}
    return dict(zip(layer_names(target), map(np.asarray, ensemble_layers(voxel_map, params, rule)), strict=True))


def stored_layers(
    layers: Mapping[str, Float[np.ndarray, "X Y"]], target: str | None, where: object
) -> EnsembleLayers | None:
    """The layers of a class among those of a map (`MapAttributes.layers`); None where it has none.

    Raises:
        JaxmapError: they hold what is no probability.
    """
    names = layer_names(target) if target is not None else ()
    if not names or not all(name in layers for name in names):
        return None
    for name in names:
        known = layers[name][~np.isnan(layers[name])]
        if known.size and not (known.min() >= 0 and known.max() <= 1):
            raise JaxmapError(f"{name} holds what is no probability", where=where, fix="make the map again")
    return EnsembleLayers(*(layers[name] for name in names))


def layer_names(target: str) -> tuple[str, str]:
    """What the layers of a class are called in a map: `ensemble_probability_rock` and `missed_rock`."""
    # A slash in the name of an array would make a folder.
    name = re.sub(r"[^\w-]+", "_", target)
    return f"ensemble_probability_{name}", f"missed_{name}"
