"""Which voxels a run maps: the bounds of its views, as fine as the settings say or as the memory allows."""

from __future__ import annotations

import numpy as np

from jaxmap.config import GridConfig, MapConfig, Triple
from jaxmap.datasets import StereoSequence
from jaxmap.errors import UsageError
from jaxmap.geometry.bounds import grid_around_views, map_bytes
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.types import GridSpec, make_grid

DEFAULT_VOXELS_M: tuple[Triple, ...] = ((0.05, 0.05, 0.2), (0.1, 0.1, 0.2), (0.2, 0.2, 0.2))
"""The voxels of a map whose settings name none, the finest that fits."""


def choose_grid(
    config: MapConfig, sequence: StereoSequence, front_end: StereoFrontEnd, max_depth_m: float, class_count: int
) -> GridSpec:
    """The grid that the settings ask for; voxels of no given size are as fine as the memory allows.

    Args:
        config: the settings.
        sequence: whose views it must hold.
        front_end: of the sequence.
        max_depth_m: how far its views reach.
        class_count: how many classes the map has.

    Raises:
        JaxmapError: the bounds do not make a box, or no camera sees it.
    """
    if config.grid.voxel_size_m is not None:
        return _grid_of(config.grid, config.grid.voxel_size_m, sequence, front_end, max_depth_m)
    limit_bytes = config.grid.max_memory_gib * 2**30
    *finer, coarsest_m = DEFAULT_VOXELS_M
    for size_m in finer:
        grid = _grid_of(config.grid, size_m, sequence, front_end, max_depth_m)
        if map_bytes(grid, class_count, config.ensemble.members) <= limit_bytes:
            return grid
    return _grid_of(config.grid, coarsest_m, sequence, front_end, max_depth_m)


def _grid_of(
    settings: GridConfig,
    voxel_size_m: float | Triple,
    sequence: StereoSequence,
    front_end: StereoFrontEnd,
    max_depth_m: float,
) -> GridSpec:
    views = grid_around_views(
        front_end.camera,
        sequence.T_world_camera @ front_end.T_raw_rectified,
        max_depth_m,
        voxel_size_m,
        (settings.below_camera_m, settings.above_camera_m),
    )
    if (settings.lower_m is None) != (settings.upper_m is None):
        raise UsageError("one of grid.lower_m and grid.upper_m is missing", fix="give both, or neither")
    if settings.lower_m is None or settings.upper_m is None:
        return views
    grid = make_grid(settings.lower_m, settings.upper_m, voxel_size_m)
    lower, upper = _extent(views)
    if (np.array(settings.lower_m) >= upper).any() or (np.array(settings.upper_m) <= lower).any():
        raise UsageError(
            f"no camera sees the box from {list(settings.lower_m)} to {list(settings.upper_m)}: "
            f"the views reach from {lower.round(1).tolist()} to {upper.round(1).tolist()}",
            where="grid bounds",
            fix="give bounds relative to the site origin",
        )
    return grid


def _extent(grid: GridSpec) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of a grid, float64."""
    lower = np.asarray(grid.origin_m, np.float64)
    return lower, lower + np.asarray(grid.voxel_size_m, np.float64) * grid.shape


def told_grid(grid: GridSpec, depth_range_m: tuple[float, float], class_count: int, members: int) -> str:
    """One line on what is mapped, and the memory it takes."""
    size = " x ".join(f"{edge:g}" for edge in np.asarray(grid.voxel_size_m, np.float64).round(6))
    return (
        f"depth {depth_range_m[0]:g} to {depth_range_m[1]:g} m; grid {' x '.join(map(str, grid.shape))} voxels of "
        f"{size} m, {1 + class_count} channels{f' and {members} members of 2' if members else ''}: "
        f"{map_bytes(grid, class_count, members) / 2**20:.0f} MiB"
    )
