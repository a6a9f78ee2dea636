"""The top-down map as a smooth function of the evidence: the twin of `fusion.query.top_down` for gradients.

Decisions become logistic functions, so that the score of a map has a gradient everywhere; as the widths of `Softness`
go to zero, the soft map approaches the one that is scored.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmap.fusion.neighbours import spread_evidence
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams
from jaxmap.tuning.options import Softness
from jaxmap.types import VoxelMap

_FAR_BELOW = -1e4
"""Log-odds that lose every comparison, and are finite all the same: gradients of infinities are not."""


class ColumnReductions(NamedTuple):
    """How the voxels of a list make columns: reductions from one number a voxel to an image of columns (X, Y)."""

    total: Callable[[Float[Array, "*v"]], Float[Array, "X Y"]]
    greatest: Callable[[Float[Array, "*v"]], Float[Array, "X Y"]]


class SoftColumns(NamedTuple):
    """One class in the top-down map.

    `seen` is how surely a surface was observed in the column, `probability` that of the class given this, `called` how
    surely the column is labelled with the class.
    """

    seen: Float[Array, "X Y"]
    probability: Float[Array, "X Y"]
    called: Float[Array, "X Y"]


def columns_of_grid() -> ColumnReductions:
    """The columns of a dense tensor (X, Y, Z)."""
    return ColumnReductions(lambda values: values.sum(axis=-1), lambda values: values.max(axis=-1))


def columns_of_list(column: Int[Array, "V"], shape: tuple[int, int]) -> ColumnReductions:
    """The columns of a list of voxels.

    Args:
        column: flat index, row-major, of each voxel's column.
        shape: of the image of columns.
    """
    count = int(np.prod(shape))

    def greatest(values: Array) -> Array:
        return jnp.full(count, _FAR_BELOW, values.dtype).at[column].max(values).reshape(shape)

    return ColumnReductions(
        lambda values: jnp.zeros(count, values.dtype).at[column].add(values).reshape(shape), greatest
    )


def soft_columns(
    log_odds: Float[Array, "K *v"],
    observed: Bool[Array, "*v"] | Float[Array, "*v"],
    columns: ColumnReductions,
    params: FusionParams,
    rule: FusionRule,
    classes: tuple[str, ...],
    target: int,
    softness: Softness,
) -> SoftColumns:
    """One class of the top-down map that voxels make.

    Args:
        log_odds: evidence of voxels, occupancy first; of a grid, or of a list.
        observed: voxels that any frame touched, or how much they were, between 0 and 1; the others hold zeros.
        columns: how they make columns.
        params: how evidence is read.
        rule: `column` and the priority of classes.
        classes: of the map.
        target: index of the class asked for.
        softness: widths of the decisions.
    """
    margin = (log_odds[0] + params.occupancy_prior - _logit(params.occupancy_threshold)) / softness.occupied
    solid = observed * jax.nn.sigmoid(margin)
    # 1 - prod(1 - solid), whose gradient stays finite where a voxel is certain.
    seen = -jnp.expm1(-columns.total(observed * jax.nn.softplus(margin)))

    def read(index: int) -> Array:
        evidence = log_odds[1 + index]
        if rule.column == "sum":
            column = columns.total(solid * evidence)
        else:
            # The weight as log-odds: a voxel that is hardly there cannot be the greatest.
            weighed = evidence + jax.nn.log_sigmoid(margin)
            column = columns.greatest(jnp.where(observed > 0, weighed, _FAR_BELOW))
            column = jnp.where(column > 0.5 * _FAR_BELOW, column, 0.0)
        if params.class_kernel is not None:
            column = spread_evidence(column[None], params.class_kernel[index][None])[0]
        return column + params.class_prior[index]

    own = read(target)
    priority = rule.priority(classes)
    if target in priority:
        lead = own - _logit(params.class_threshold)
    else:
        # As in `_decide`: a class without evidence of its own is no rival, and wins nothing.
        bar = params.class_prior[target]
        for index in (index for index in range(len(classes)) if index != target and index not in priority):
            rival = read(index)
            bar = jnp.where(rival > params.class_prior[index], jnp.maximum(bar, rival), bar)
        lead = own - bar
    return SoftColumns(seen, jax.nn.sigmoid(own), jax.nn.sigmoid(lead / softness.called))


def soft_columns_of_map(
    voxel_map: VoxelMap, params: FusionParams, rule: FusionRule, target: int, softness: Softness
) -> SoftColumns:
    """`soft_columns` of a dense map."""
    observed = (voxel_map.log_odds != 0).any(axis=0)
    return soft_columns(
        voxel_map.log_odds, observed, columns_of_grid(), params, rule, voxel_map.classes, target, softness
    )


def _logit(probability: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.log(probability) - jnp.log1p(-probability)
