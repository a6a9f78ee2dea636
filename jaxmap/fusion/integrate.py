"""Scatter-add of points into dense voxel tensors, and of frames into the map."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams
from jaxmap.fusion.sensor_model import frame_evidence, total_weight
from jaxmap.geometry.grid import flat_voxel_index
from jaxmap.types import GridSpec, PointLabels, VoxelMap


def integrate(
    voxel_map: VoxelMap,
    points_world: Float[Array, "N 3"],
    labels: PointLabels,
    weights: Float[Array, "N"],
    params: FusionParams,
    rule: FusionRule,
    window: GridSpec | None = None,
    free: Bool[Array, "X Y Z"] | None = None,
) -> tuple[VoxelMap, Float[Array, "X Y Z"]]:
    """Adds one frame to the map.

    Points that are not kept, not finite, outside the grid, or whose weight is not finite are left
    out exactly.

    Args:
        voxel_map: the map so far.
        points_world: metres.
        labels: the class of each point, and which points to keep.
        weights: how much each point counts.
        params: the increments of the sensor model.
        rule: how the points of a frame add up.
        window: the part of the grid that holds all the points; the whole grid if not given. The
            rest of the map is not touched, so its size costs nothing.
        free: voxels of the window that were seen through (`carve`).

    Returns:
        The new map, and the weight of the points in each voxel of the window.
    """
    window = voxel_map.grid if window is None else window
    counts = count_points(window, points_world, labels, weights, len(voxel_map.classes))
    return add_evidence(voxel_map, frame_evidence(counts, free, params, rule), window), total_weight(counts)


def add_evidence(voxel_map: VoxelMap, evidence: Float[Array, "C1 X Y Z"], window: GridSpec) -> VoxelMap:
    """Adds what a frame says of the voxels of a window to the map, and counts the frame."""
    with jax.named_scope("add_evidence"):
        corner = (jnp.zeros((), jnp.int32), *(window.first - voxel_map.grid.first))
        here = jax.lax.dynamic_slice(voxel_map.log_odds, corner, evidence.shape)
        log_odds = jax.lax.dynamic_update_slice(voxel_map.log_odds, here + evidence, corner)
    return replace(voxel_map, log_odds=log_odds, frames_fused=voxel_map.frames_fused + 1)


def count_points(
    grid: GridSpec,
    points_world: Float[Array, "N 3"],
    labels: PointLabels,
    weights: Float[Array, "N"],
    class_count: int,
) -> Float[Array, "C1 X Y Z"]:
    """Weighted number of points per label and voxel, by scatter-add.

    Returns:
        One row per class and a last row for the points without a class; the rows sum to the
        weight of the points in each voxel.
    """
    with jax.named_scope("count_points"):
        keep = labels.keep & jnp.isfinite(weights)
        if labels.probabilities is not None:
            keep &= jnp.isfinite(labels.probabilities).all(axis=-1)
        voxel = flat_voxel_index(grid, points_world, keep)
        rows, voxels = class_count + 1, int(np.prod(grid.shape))
        counts = jnp.zeros((rows, voxels), weights.dtype)
        if labels.probabilities is not None:
            # Unrolled over channels: one flat scatter each is thrice as fast as scattering rows.
            known = labels.probabilities
            shares = [known[:, c] for c in range(class_count)] + [1.0 - known.sum(axis=-1)]
            counts = jnp.stack([counts[r].at[voxel].add(shares[r] * weights, mode="drop") for r in range(rows)])
        else:
            assert labels.labels is not None
            # The class folded into the flat index: one scatter whatever the number of classes.
            label = labels.labels.astype(jnp.int32)
            row = jnp.where((label >= 0) & (label < class_count), label, class_count)
            index = jnp.where(voxel < voxels, row * voxels + voxel, rows * voxels)
            counts = counts.reshape(-1).at[index].add(weights, mode="drop")
        return counts.reshape(rows, *grid.shape)
