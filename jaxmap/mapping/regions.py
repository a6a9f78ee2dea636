"""A large map in regions that are fused apart: how it is split, and what each tile is made of.

A frame's evidence of a voxel is the same through whatever part of the map it is fused, and frames are fused in their
order: so any split gives the same bits.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from jaxmap.errors import FrameError, JaxmapError
from jaxmap.mapping.arrays import TILE
from jaxmap.mapping.sequence import PreparedFrame
from jaxmap.mapping.step import Mapper, MapperParams, StepReport
from jaxmap.mapping.tile_arrays import Tile
from jaxmap.mapping.tiles import block_shape, tiles_of
from jaxmap.types import GridSpec, VoxelMap, make_voxel_map, to_device

Shape = tuple[int, int, int]


class Region(NamedTuple):
    """A part of the map that one worker fuses.

    Attributes:
        first: the voxel of the lattice where its dense tensor begins.
        tiles: those that it owns, counted along the lattice: what it writes.
        frames: the indices of the frames that touch them, in order.
    """

    first: Shape
    tiles: tuple[Tile, ...]
    frames: tuple[int, ...]


def lattice_tiles(grid: GridSpec, box: Int[np.ndarray, "2 3"]) -> Iterator[Tile]:
    """The tiles of a grid of whole tiles that a box touches, counted along the lattice, whatever the grid."""
    corner = corner_tile(grid)
    for tile in tiles_of(grid, box):
        x, y, z = (int(a + b) for a, b in zip(tile, corner, strict=True))
        yield x, y, z


def frames_of_tiles(grid: GridSpec, boxes: Int[np.ndarray, "N 2 3"]) -> dict[Tile, list[int]]:
    """The frames that may touch each tile, in order.

    Args:
        grid: of whole tiles.
        boxes: of the views (`geometry.bounds.view_boxes`).
    """
    touching: dict[Tile, list[int]] = {}
    for index, box in enumerate(boxes):
        for tile in lattice_tiles(grid, box):
            touching.setdefault(tile, []).append(index)
    return touching


def tile_sources(
    touching: Mapping[Tile, Sequence[int]],
    names: Sequence[str],
    T_world_camera: Float[np.ndarray, "N 4 4"],
    numbers: Sequence[int] | None,
) -> dict[Tile, str]:
    """Of each tile, a fingerprint of the frames that it is made of: their names, order and poses.

    Args:
        touching: of `frames_of_tiles`; frames that cannot be used are left out.
        names: of the frames.
        T_world_camera: their poses, as the step sees them.
        numbers: how many frames were fused before each, where labels depend on that.
    """
    poses = np.ascontiguousarray(T_world_camera, np.float32)
    told = [
        hashlib.sha256(repr((name, None if numbers is None else numbers[index])).encode() + poses[index].tobytes())
        for index, name in enumerate(names)
    ]
    digests = [one.digest() for one in told]
    return {
        tile: hashlib.sha256(b"".join(digests[index] for index in indices)).hexdigest()[:32]
        for tile, indices in touching.items()
    }


def regions_of(grid: GridSpec, shape: Shape, touching: Mapping[Tile, Sequence[int]]) -> list[Region]:
    """The regions that hold some tiles of a map; each tile is in one of them.

    Args:
        grid: of the whole map, in whole tiles.
        shape: of the dense tensor of a region, the same for all, so that the step is compiled once.
        touching: the tiles, with the frames that touch them.
    """
    edges = np.array(shape) // TILE
    last = corner_tile(grid) + np.array(grid.shape) // TILE - edges
    regions = []
    for tiles in _boxes(sorted(touching), edges.tolist()):
        # Where the tiles begin, or earlier, to lie within the grid.
        x, y, z = (np.minimum(np.min(tiles, axis=0), last) * TILE).tolist()
        frames = sorted({index for tile in tiles for index in touching[tile]})
        regions.append(Region((x, y, z), tuple(tiles), tuple(frames)))
    return regions


def _boxes(tiles: list[Tile], edges: Sequence[int], axis: int = 0) -> Iterator[list[Tile]]:
    """Groups of tiles, each within a box of these edges: strips along x, which are cut along y, and those along z.

    Each begins at its first tile: a winding path, or a few tiles of it, takes fewer boxes than those of a fixed raster.
    """
    if axis == len(edges):
        yield tiles
        return
    tiles = sorted(tiles, key=lambda tile: (tile[axis], tile))
    while tiles:
        strip = [tile for tile in tiles if tile[axis] < tiles[0][axis] + edges[axis]]
        yield from _boxes(strip, edges, axis + 1)
        tiles = tiles[len(strip) :]


def region_shape(
    grid: GridSpec,
    window_shape: Shape,
    channels: float,
    limit_bytes: float,
    touching: Mapping[Tile, Sequence[int]],
    workers: int,
) -> Shape | None:
    """The shape of regions with which so many workers are done soonest.

    In large regions fewer frames are fused more than once, and small ones are shared out more evenly.

    Args:
        grid: of the whole map, in whole tiles.
        window_shape: of the step: no region is smaller.
        channels: of the map (`tiles.channels_of`).
        limit_bytes: for one worker.
        touching: the tiles, with the frames that touch them.
        workers: how many.

    Returns:
        None where not even the smallest region fits.
    """
    best, best_cost = None, math.inf
    # A region need not hold a window wherever it lies: what is beyond its edge is fused in the next one.
    x, y, z = (max(1, window - edge + 1) for window, edge in zip(window_shape, TILE, strict=True))
    block = block_shape(grid, (x, y, z), channels, limit_bytes)
    while block is not None:
        # As many regions as with these, but of even size.
        counts = -(-np.array(grid.shape) // block)
        tiles = np.maximum(-(-np.array(grid.shape) // TILE // counts), -(-np.array(window_shape) // TILE))
        a, b, c = (tiles * TILE).tolist()
        costs = [len(region.frames) for region in regions_of(grid, (a, b, c), touching)]
        cost = max(sum(costs) / workers, max(costs, default=0))
        if cost < best_cost:
            best, best_cost = (a, b, c), cost
        smaller = 2.1 * 4 * channels * math.prod(block)
        block = block_shape(grid, (x, y, z), channels, smaller) if workers > 1 else None
    return best


def fuse_region(
    mapper: Mapper,
    classes: tuple[str, ...],
    grid: GridSpec,
    frames: Iterable[PreparedFrame],
    numbers: Mapping[int, int],
    params: MapperParams,
    key: PRNGKeyArray,
    on_frame: Callable[[PreparedFrame, StepReport], None] = lambda prepared, report: None,
) -> tuple[VoxelMap, dict[int, JaxmapError]]:
    """Fuses frames into a dense map of a region.

    Args:
        mapper: of `make_mapper` for a grid of this shape.
        classes: of the map.
        grid: of the region.
        frames: in the order of the run.
        numbers: of each frame, by its index, how many of the run are fused before it.
        params: the numbers of the step.
        key: that of the run.
        on_frame: is called after each.

    Returns:
        The map, and the frames that could not be read, by index: where there are any, the map is not whole.
    """
    voxel_map = make_voxel_map(grid, classes, surface=mapper.design.rule.surface)
    faults: dict[int, JaxmapError] = {}
    for prepared in frames:
        if prepared.frame is None:
            faults[prepared.index] = prepared.fault or FrameError("it cannot be read")
        elif not faults:
            # The step folds the number of fused frames into its key.
            voxel_map = replace(voxel_map, frames_fused=to_device(numbers[prepared.index], np.int32))
            voxel_map, report = mapper.step(voxel_map, prepared.frame, params, key)
            on_frame(prepared, report)
            voxel_map.log_odds.block_until_ready()
    return voxel_map, faults


def corner_tile(grid: GridSpec) -> Int[np.ndarray, "3"]:
    """The first tile of a grid of whole tiles, counted along the lattice."""
    return np.asarray(grid.first).astype(np.int64) // TILE
