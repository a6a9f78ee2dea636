"""What one frame adds to a map: its labelled points counted in voxels and columns, and the space that it saw through.

`add_sighting` is the sum itself. On CPUs a kernel in C++ does it in one pass (`kernel`), where it could be built; what
it computes is said here, in JAX: by `evidence_of`, added to the map.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxmap.fusion.carve import carve
from jaxmap.fusion.integrate import add_evidence, count_points
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams
from jaxmap.fusion.sensor_model import frame_evidence, point_weights, total_weight
from jaxmap.fusion.surface import add_heights, gather_heights, height_sigma
from jaxmap.geometry.cloud import project
from jaxmap.types import GridSpec, PointLabels, StereoCamera, VoxelMap


class Sighting(NamedTuple):
    """A frame as fusion takes it, apart from any voxels.

    Attributes:
        camera: the rectified camera.
        T_world_camera: its pose.
        disparity_px: NaN where unknown.
        labels: of the points of the pixels, and which of them count.
    """

    camera: StereoCamera
    T_world_camera: jaxlie.SE3
    disparity_px: Float[Array, "H W"]
    labels: PointLabels


class Counted(NamedTuple):
    """What a frame did.

    Attributes:
        hits: voxels of the window that hold points.
        freed: others that it saw through.
        valid: pixels that have a depth.
        in_range: those between the depths that are mapped.
        kept: those whose points count.
    """

    hits: Int[Array, ""]
    freed: Int[Array, ""]
    valid: Int[Array, ""]
    in_range: Int[Array, ""]
    kept: Int[Array, ""]


class Evidence(NamedTuple):
    """What a frame says of the voxels of a window, and of its columns where heights are kept."""

    log_odds: Float[Array, "C1 X Y Z"]
    heights: Float[Array, "4 X Y L"] | None
    counted: Counted


def evidence_of(
    sighting: Sighting,
    grid: GridSpec,
    window: GridSpec,
    params: FusionParams,
    rule: FusionRule,
    depth_range_m: tuple[float, float],
) -> Evidence:
    """What a frame says of the voxels of a window that holds all that it can see.

    Args:
        sighting: the frame.
        grid: that of the map.
        window: of it.
        params: the sensor model, whose matrix gives the number of classes.
        rule: how the points of a frame add up, whether it carves, and whether heights are kept.
        depth_range_m: voxels nearer or farther are not seen through.
    """
    camera, pose, disparity_px, labels = sighting
    cloud = project(camera, pose, disparity_px, depth_range_m, params.disparity_sigma_px)
    labels = labels._replace(keep=labels.keep & cloud.valid.reshape(-1))
    free = carve(camera, pose, cloud.depth_m, cloud.valid, window, params, depth_range_m) if rule.carve else None
    weights = point_weights(grid, cloud, rule)
    counts = count_points(window, cloud.points_world, labels, weights, params.class_increments.shape[0])
    heights = None
    if rule.surface:
        sigma_m = height_sigma(cloud, pose.translation()[2])
        heights = gather_heights(grid, window, cloud.points_world, sigma_m, labels.keep)
    hits, freed = _count_voxels(total_weight(counts) > 0, free)
    counted = Counted(hits, freed, cloud.valid.sum(), cloud.in_range.sum(), labels.keep.sum())
    return Evidence(frame_evidence(counts, free, params, rule), heights, counted)


def add_evidence_of(voxel_map: VoxelMap, evidence: Evidence, window: GridSpec) -> VoxelMap:
    """The map with what a frame says of a window of it."""
    fused = add_evidence(voxel_map, evidence.log_odds, window)
    if voxel_map.surface is None or evidence.heights is None:
        return fused
    return replace(fused, surface=add_heights(voxel_map, evidence.heights, window))


def add_plainly(
    voxel_map: VoxelMap,
    sighting: Sighting,
    window: GridSpec,
    params: FusionParams,
    rule: FusionRule,
    depth_range_m: tuple[float, float],
) -> tuple[VoxelMap, Counted]:
    """`kernel.add_sighting` in JAX alone, which it equals to within rounding."""
    evidence = evidence_of(sighting, voxel_map.grid, window, params, rule, depth_range_m)
    return add_evidence_of(voxel_map, evidence, window), evidence.counted


def _count_voxels(
    hits: Bool[Array, "X Y Z"], free: Bool[Array, "X Y Z"] | None
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    freed = jnp.zeros_like(hits) if free is None else free & ~hits
    # Both in one sum, the second above 16 bits, and first along the short axis: thrice as fast as two sums.
    both = (hits.astype(jnp.int32) + (freed.astype(jnp.int32) << 16)).sum(axis=2)
    return (both & 0xFFFF).sum(), (both >> 16).sum()
