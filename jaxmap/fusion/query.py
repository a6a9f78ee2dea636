"""Reading a map: probabilities, one label per voxel, and the top-down map."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from jaxmap.fusion.neighbours import spread_evidence
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams
from jaxmap.geometry.grid import voxel_centres
from jaxmap.labels import IGNORE
from jaxmap.types import VoxelMap


class TopDown(NamedTuple):
    """The top-down map, one cell per column of voxels; x is the first axis, y the second.

    `probability` is that of each class, given that something is there; `height_m` is the centre of
    the highest occupied voxel (world z), NaN where there is none; `observed` says that a surface
    was seen in the column; `label` is a class index, or `IGNORE`.
    """

    probability: Float[Array, "C X Y"]
    label: UInt8[Array, "X Y"]
    height_m: Float[Array, "X Y"]
    observed: Bool[Array, "X Y"]


def occupancy_probability(voxel_map: VoxelMap, params: FusionParams) -> Float[Array, "X Y Z"]:
    """Probability that a voxel is occupied; the prior where nothing was seen."""
    return jax.nn.sigmoid(voxel_map.log_odds[0] + params.occupancy_prior)


def class_probabilities(voxel_map: VoxelMap, params: FusionParams) -> Float[Array, "C X Y Z"]:
    """Probability of each class, each a binary filter of its own (paper eq. 3), given occupancy."""
    return jax.nn.sigmoid(voxel_map.log_odds[1:] + params.class_prior[:, None, None, None])


def observed(voxel_map: VoxelMap) -> Bool[Array, "X Y Z"]:
    """Whether a voxel was hit or seen through: untouched voxels hold exact zeros."""
    return (voxel_map.log_odds != 0).any(axis=0)


def occupied(voxel_map: VoxelMap, params: FusionParams) -> Bool[Array, "X Y Z"]:
    """Whether a voxel was observed and is occupied with more than the threshold's probability."""
    return observed(voxel_map) & (occupancy_probability(voxel_map, params) > params.occupancy_threshold)


@partial(jax.jit, static_argnames="rule")
def voxel_labels(voxel_map: VoxelMap, params: FusionParams, rule: FusionRule) -> UInt8[Array, "X Y Z"]:
    """One label per voxel: a class index, or `IGNORE` where it is free, unknown or without class.

    The priority classes win in their order as soon as their probability passes the threshold (the
    paper: a cell is rock when p > 0.70); otherwise the likeliest of the others that has evidence. Evidence is that of
    the voxel, and through `class_kernel` that of occupied neighbours at its height.
    """
    solid, evidence = occupied(voxel_map, params), voxel_map.log_odds[1:]
    if params.class_kernel is not None:
        evidence = spread_evidence(jnp.where(solid, evidence, 0.0), params.class_kernel)
    log_odds = evidence + params.class_prior[:, None, None, None]
    return _decide(log_odds, solid, params, rule, voxel_map.classes)


@partial(jax.jit, static_argnames="rule")
def top_down(voxel_map: VoxelMap, params: FusionParams, rule: FusionRule) -> TopDown:
    """The top-down map.

    The class evidence of a column is the sum over its occupied voxels, or the greatest of them
    (`rule.column`), spread over neighbouring columns where there is a `class_kernel`; labels follow the rule of
    `voxel_labels`.
    """
    solid = occupied(voxel_map, params)
    evidence = voxel_map.log_odds[1:]
    if rule.column == "sum":
        column = jnp.where(solid, evidence, 0.0).sum(axis=-1)
    else:
        column = jnp.where(solid, evidence, -jnp.inf).max(axis=-1)
    seen = solid.any(axis=-1)
    column = jnp.where(seen, column, 0.0)
    if params.class_kernel is not None:
        column = jnp.where(seen, spread_evidence(column, params.class_kernel), 0.0)
    log_odds = column + params.class_prior[:, None, None]
    heights_m = jnp.where(solid, voxel_centres(voxel_map.grid)[..., 2], -jnp.inf).max(axis=-1)
    return TopDown(
        probability=jax.nn.sigmoid(log_odds),
        label=_decide(log_odds, seen, params, rule, voxel_map.classes),
        height_m=jnp.where(seen, heights_m, jnp.nan),
        observed=seen,
    )


def _decide(
    log_odds: Float[Array, "C *s"],
    known: Bool[Array, "*s"],
    params: FusionParams,
    rule: FusionRule,
    classes: tuple[str, ...],
) -> UInt8[Array, "*s"]:
    """One label for each cell, from its class log-odds (priors included)."""
    label = jnp.full(known.shape, IGNORE, jnp.uint8)
    priority = rule.priority(classes)
    others = jnp.array([index for index in range(len(classes)) if index not in priority], jnp.uint8)
    if others.size:
        evident = log_odds[others] > params.class_prior[others].reshape(-1, *[1] * known.ndim)
        rivals = jnp.where(evident, log_odds[others], -jnp.inf)
        label = jnp.where(evident.any(axis=0), others[rivals.argmax(axis=0)], label)
    for index in reversed(priority):
        label = jnp.where(jax.nn.sigmoid(log_odds[index]) > params.class_threshold, jnp.uint8(index), label)
    return jnp.where(known, label, jnp.uint8(IGNORE))
