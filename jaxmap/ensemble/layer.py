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
from jaxtyping import Array, Bool, Float

from jaxmap.errors import JaxmapError
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams
from jaxmap.fusion.query import top_down
from jaxmap.types import VoxelMap

AnyArray = Array | np.ndarray
"""Of JAX or of NumPy."""


class EnsembleLayers(NamedTuple):
    """Two layers of the top-down map that an ensemble gives; NaN where the map saw no surface.

    `probability` is that of the class; `missed` the same where the map does not call the class, 0 where it does.
    """

    probability: Float[AnyArray, "X Y"]
    missed: Float[AnyArray, "X Y"]

    def called(self) -> Bool[np.ndarray, "X Y"]:
        """The columns that the map itself calls by the class: there its own call makes the probability positive."""
        return (np.asarray(self.missed) == 0) & (np.asarray(self.probability) > 0)


@partial(jax.jit, static_argnames="rule")
def ensemble_layers(voxel_map: VoxelMap, params: FusionParams, rule: FusionRule) -> EnsembleLayers:
    """The probability of the class asked about (`FusionRule.target`), and that the map misses it.

    Poses, disparities and the sensor model are known but to their errors `e`. What a map says under given errors is
    its call, `r_e = [p(rock | z, e) > threshold]`; what is asked is how likely that call is whatever they were, the
    expectation `E_e[r_e]`, which the members sample (the Monte Carlo propagation of distributions of JCGM 101:2008;
    bagged classifiers vote so, Breiman 1996):

        probability = (r_0 + sum_m s_m r_m) / (1 + sum_m s_m),    missed = 0 where the map calls rock, else probability,

    where the map itself is one more member (0), of no error, and `s_m` is whether member `m` saw a surface in the
    column: of ground that it did not see it has nothing to say. Without spread all members agree and nothing is missed.

    It is the calls that are averaged, not `p(rock | z, e)`: this goes to its prior where there is hardly any evidence,
    and so would find most missed rocks on the farthest ground. Assumed are errors as drawn, and calls that are right
    but for them: a rock that every frame labels sand with certainty stays missed.

    Args:
        voxel_map: with members.
        params: how the map is read, and its members as well.
        rule: see `params`.
    """
    target = rule.target(voxel_map.classes)
    assert target is not None and voxel_map.members is not None
    index = voxel_map.classes.index(target)
    own = top_down(voxel_map, params, rule)
    called = own.observed & (own.label == index)
    one = slice(index, index + 1)
    kernel = None if params.class_kernel is None else params.class_kernel[one]
    read_one = replace(params, class_prior=params.class_prior[one], class_kernel=kernel)

    def add(sums: tuple[Array, Array], log_odds: Array) -> tuple[tuple[Array, Array], None]:
        member = replace(voxel_map, log_odds=log_odds, classes=(target,), members=None)
        top = top_down(member, read_one, rule)
        return (sums[0] + (top.label == 0), sums[1] + top.observed), None

    start = (called.astype(jnp.float32), jnp.ones(called.shape, jnp.float32))
    (calls, seen), _ = jax.lax.scan(add, start, voxel_map.members)
    probability = jnp.where(own.observed, calls / seen, jnp.nan)
    return EnsembleLayers(probability, jnp.where(called, 0.0, probability))


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
        JaxmapError: a layer holds values that are not probabilities.
    """
    names = layer_names(target) if target is not None else ()
    if not names or not all(name in layers for name in names):
        return None
    for name in names:
        known = layers[name][~np.isnan(layers[name])]
        if known.size and not (known.min() >= 0 and known.max() <= 1):
            raise JaxmapError(f"{name} holds values that are not probabilities", where=where, fix="make the map again")
    return EnsembleLayers(*(layers[name] for name in names))


def layer_names(target: str) -> tuple[str, str]:
    """What the layers of a class are called in a map: `ensemble_probability_rock` and `missed_rock`."""
    # A slash in the name of an array would make a folder.
    name = re.sub(r"[^\w-]+", "_", target)
    return f"ensemble_probability_{name}", f"missed_{name}"
