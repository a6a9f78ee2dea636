"""The same clouds from the same poses into two maps: by jaxmap's projective carving, and by OctoMap's ray casting."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int8

from jaxmap.errors import JaxmapError
from jaxmap.fusion.params import FusionParams
from jaxmap.fusion.query import observed, occupied
from jaxmap.geometry.camera import disparity_to_points, transform_points
from jaxmap.geometry.grid import exact_corner
from jaxmap.mapping.step import Mapper, MapperParams
from jaxmap.types import Frame, GridSpec, StereoCamera, VoxelMap

UNKNOWN, FREE, OCCUPIED = 0, 1, 2
CLASS_NAMES = ("unknown", "free", "occupied")

MISS, NOTHING, HIT = -1, 0, 1
"""What one frame says of a voxel."""

_NEVER_CLAMPED = 1e-15
"""Probability 34 units of log-odds from even: farther than the frames of any comparison add up to."""

Classes = Int8[np.ndarray, "X Y Z"]


class Cloud(NamedTuple):
    """The points of one frame, in metres of the world, and where they were seen from."""

    points_world: Float[np.ndarray, "N 3"]
    origin_world: Float[np.ndarray, "3"]


class Seen(NamedTuple):
    """One frame, all its disparities in it, and what each map makes of them (`MISS`, `NOTHING` or `HIT` a voxel)."""

    frame: Frame
    ours: Classes
    theirs: Classes


class TwoMaps(NamedTuple):
    """All frames in two maps, as `UNKNOWN`, `FREE` or `OCCUPIED`; and what was seen frame by frame."""

    ours: Classes
    theirs: Classes
    frames: list[Seen]


def in_range_only(frame: Frame, camera: StereoCamera, depth_range_m: tuple[float, float]) -> Frame:
    """The frame without the disparities that are not mapped, so that both maps are given one cloud.

    Otherwise ours would also see through what lies before farther points: OctoMap knows a greatest range, but no depth.
    """
    points, valid = disparity_to_points(camera, frame.disparity_px)
    depth_m = points[..., 2]
    kept = valid & (depth_m >= depth_range_m[0]) & (depth_m <= depth_range_m[1])
    return replace(frame, disparity_px=jnp.where(kept, frame.disparity_px, jnp.nan))


def cloud_of(frame: Frame, camera: StereoCamera) -> Cloud:
    """The points of a frame, as the compiled step has them."""
    points, valid = disparity_to_points(camera, frame.disparity_px)
    world = np.asarray(transform_points(frame.T_world_camera, points), np.float64)
    return Cloud(world[np.asarray(valid)], np.asarray(frame.T_world_camera.translation(), np.float64))


def map_both(
    frames: Iterable[Frame],
    mapper: Mapper,
    params: MapperParams,
    grid: GridSpec,
    depth_range_m: tuple[float, float],
) -> TwoMaps:
    """Maps frames twice. The mapper's rule must be `once`, with carving and without range weighting.

    Raises:
        JaxmapError: the voxels are no cubes, or do not lie on whole multiples of their edge.
    """
    whole, key = make_octree(grid, params.fusion), jax.random.key(0)
    ours, seen = mapper.init(), []
    for frame in frames:
        near = in_range_only(frame, params.camera, depth_range_m)
        cloud = cloud_of(near, params.camera)
        ours, _ = mapper.step(ours, near, params, key)
        insert(whole, cloud)
        # Evidence adds up, so a frame's share of a map is the map of that frame alone.
        mine, _ = mapper.step(mapper.init(), near, params, key)
        alone = make_octree(grid, params.fusion)
        insert(alone, cloud)
        theirs = octree_classes(alone, grid)
        seen.append(Seen(frame, np.sign(np.asarray(mine.log_odds[0])).astype(np.int8), _VERDICTS[theirs]))
    return TwoMaps(map_classes(ours, params.fusion), octree_classes(whole, grid), seen)


_VERDICTS = np.array([NOTHING, MISS, HIT], np.int8)
"""By the class of a voxel that only one frame has touched."""


def map_classes(voxel_map: VoxelMap, params: FusionParams) -> Classes:
    """The class of each voxel of our map."""
    seen, solid = (np.asarray(which) for which in (observed(voxel_map), occupied(voxel_map, params)))
    return np.where(solid, OCCUPIED, np.where(seen, FREE, UNKNOWN)).astype(np.int8)


def make_octree(grid: GridSpec, params: FusionParams) -> Any:
    """An empty OctoMap whose hits and misses add the same log-odds, without bounds.

    Raises:
        JaxmapError: the voxels are no cubes, or do not lie on whole multiples of their edge.
    """
    import octomap

    origin_m, size_m = exact_corner(grid)
    offset = origin_m / size_m
    if np.ptp(size_m) > 0 or np.abs(offset - np.rint(offset)).max() > 1e-3:
        raise JaxmapError(
            f"voxels of {size_m.tolist()} m from {origin_m.tolist()}",
            where="grid",
            fix="OctoMap's voxels are cubes on whole multiples of their edge",
        )
    tree = octomap.OcTree(float(size_m[0]))
    prior = float(params.occupancy_prior)
    tree.setProbHit(_probability(float(params.occupancy_hit) - prior))
    tree.setProbMiss(_probability(float(params.occupancy_miss) - prior))
    tree.setOccupancyThres(0.5)
    tree.setClampingThresMin(_NEVER_CLAMPED)
    tree.setClampingThresMax(1 - _NEVER_CLAMPED)
    return tree


def insert(tree: Any, cloud: Cloud) -> None:
    """Casts a ray to every point; a voxel counts once a frame, and as hit where it is hit and passed."""
    tree.insertPointCloud(cloud.points_world, cloud.origin_world, discretize=False)


def octree_classes(tree: Any, grid: GridSpec) -> Classes:
    """The class of each voxel of an OctoMap, on our grid."""
    classes = np.full(grid.shape, UNKNOWN, np.int8)
    origin_m, size_m = exact_corner(grid)
    # Centres of all leaves; those that pruning has merged are taken apart again.
    for centres, name in zip(tree.extractPointCloud(), (OCCUPIED, FREE), strict=True):
        index = np.floor((np.asarray(centres, np.float64).reshape(-1, 3) - origin_m) / size_m).astype(int)
        inside = ((index >= 0) & (index < grid.shape)).all(axis=1)
        classes[tuple(index[inside].T)] = name
    return classes


def _probability(log_odds: float) -> float:
    return float(1 / (1 + np.exp(-log_odds)))
