"""The inverse sensor model: what the points of one frame say about each voxel.

All evidence is additive over frames. The filter is `l_j = l_{j-1} + logit p(m|z_j) - logit p(m)`
(paper eq. 3 with the standard sign; both signs agree at the paper's prior of 0.5). The increments of classes
are what an observation adds, the prior already taken away.
"""

from __future__ import annotations

import functools
import operator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams
from jaxmap.geometry.cloud import PointCloud
from jaxmap.types import GridSpec

_UNROLLED_CLASSES = 8


def range_weight(grid: GridSpec, sigma_m: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """How much a point counts: `1 / (1 + (sigma_Z / voxel)^2)`, from 1 near by to 0 far off.

    The voxel is the grid's mean edge; `sigma_Z` is the depth noise.
    """
    ratio = sigma_m / grid.voxel_size_m.mean()
    return 1.0 / (1.0 + ratio * ratio)


def point_weights(grid: GridSpec, cloud: PointCloud, rule: FusionRule) -> Float[Array, "N"]:
    """How much each point of a cloud counts under a rule: its range weight, or 1."""
    if rule.range_weighting:
        return range_weight(grid, cloud.sigma_m.reshape(-1))
    return jnp.ones(cloud.depth_m.size, cloud.depth_m.dtype)


def frame_evidence(
    counts: Float[Array, "C1 X Y Z"],
    free: Bool[Array, "X Y Z"] | None,
    params: FusionParams,
    rule: FusionRule,
) -> Float[Array, "C1 X Y Z"]:
    """Log-odds increments of one frame.

    Args:
        counts: weighted points per voxel: one row per class, then the row of points without a class
            (`integrate.count_points`).
        free: voxels that were seen through; one that holds a point is not free all the same.
        params: the increments.
        rule: `per_frame` says how the points of one frame in one voxel count.

    Returns:
        Channel 0 for occupancy, then one channel per class; exact zeros where nothing was seen.
    """
    # Kept apart: fused into the update of the map, XLA would compute carving anew for every channel.
    counts, free = jax.lax.optimization_barrier((counts, free))
    with jax.named_scope("frame_evidence"):
        points = total_weight(counts)
        if rule.per_frame == "sum":
            amount, shares = points, counts[:-1]
        elif rule.per_frame == "once":
            amount, shares = (points > 0).astype(points.dtype), (counts[:-1] > 0).astype(points.dtype)
        elif rule.per_frame == "majority":
            amount, shares = (points > 0).astype(points.dtype), majority(counts)
        else:
            full = jnp.maximum(points, params.full_evidence_points)
            amount, shares = points / full, counts[:-1] / full
        occupancy = amount * (params.occupancy_hit - params.occupancy_prior)
        if free is not None:
            miss = params.occupancy_miss - params.occupancy_prior
            occupancy = occupancy + jnp.where(free & (points == 0), miss, 0.0)
        return jnp.concatenate([occupancy[None], _mix_classes(params.class_increments, shares)])


def majority(counts: Float[Array, "C1 X Y Z"]) -> Float[Array, "C X Y Z"]:
    """1 for the class that weighs most in a voxel, 0 for all others.

    To have no class is a label like any other: where it weighs most, or the greatest are equal, no class has a 1. So
    the order of the classes is of no account.
    """
    rows = list(counts)
    # Reduced over the leading axis like `total_weight`.
    greatest = functools.reduce(jnp.maximum, rows)
    ties = functools.reduce(operator.add, [(row == greatest).astype(counts.dtype) for row in rows])
    return ((counts[:-1] == greatest) & (ties == 1)).astype(counts.dtype)


def total_weight(counts: Float[Array, "C1 X Y Z"]) -> Float[Array, "X Y Z"]:
    """Weight of all points in each voxel, whatever their label."""
    # A reduction over the leading axis keeps XLA from vectorising what it is fused with: 10 x slower.
    return functools.reduce(operator.add, list(counts))


def _mix_classes(increments: Float[Array, "C C"], shares: Float[Array, "C X Y Z"]) -> Float[Array, "C X Y Z"]:
    """`out[j] = sum_i increments[i, j] shares[i]`."""
    count = shares.shape[0]
    if not 0 < count <= _UNROLLED_CLASSES:
        return jnp.tensordot(increments, shares, axes=[[0], [0]])
    # Written out it fuses with the update of the map; as a dot it is a pass of its own, ten times slower.
    return jnp.stack([sum(increments[i, j] * shares[i] for i in range(count)) for j in range(count)])
