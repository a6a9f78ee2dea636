"""Maps larger than memory: a dense block around the rover in memory, and the tiles of the whole map on disk.

Tiles that the block leaves are written beside the map and read again when it comes back. They become part of the map
all at once, in a commit with the log of the run: a process that dies at any moment leaves the map of the last commit.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import read_json
from jaxmap.host.files import atomic_path, sync, write_error
from jaxmap.mapping.arrays import LOG_ODDS, SURFACE, TILE, array_folder, open_group
from jaxmap.mapping.attributes import MapAttributes, to_json
from jaxmap.mapping.tile_arrays import (
    Tile,
    TileArrays,
    TileValues,
    chunk_attributes,
    surface_part,
    tile_part,
    values_of,
)
from jaxmap.types import LAYER, GridSpec, VoxelMap, layer_count, to_device


def whole_tiles(grid: GridSpec) -> GridSpec:
    """The grid, grown to whole tiles of the lattice: tiles of any two maps on one lattice coincide."""
    first = np.asarray(grid.first) // TILE * TILE
    end = -(-(np.asarray(grid.first) + grid.shape) // TILE) * TILE
    x, y, z = (end - first).tolist()
    return replace(grid, first=to_device(first, np.int32), shape=(x, y, z))


def channels_of(class_count: int, *, surface: bool) -> float:
    """Numbers that a map holds for each of its voxels; heights are fewer than their layers have voxels."""
    # Two layers in place of one: blocks may be as low as a tile.
    return 1 + class_count + (4 * 2 / LAYER if surface else 0)


def block_shape(
    grid: GridSpec, window_shape: tuple[int, int, int], channels: float, limit_bytes: float
) -> tuple[int, int, int] | None:
    """Voxels along each axis of the block that is kept in memory: whole tiles that hold a window wherever it lies.

    It is as large as the limit allows, that the rover seldom leaves it; while it moves three of it are in memory.

    Returns:
        None where not even the smallest one fits.
    """
    most = [size // edge for size, edge in zip(grid.shape, TILE, strict=True)]
    edges = [min(-(-(w - 1) // edge) + 1, limit) for w, edge, limit in zip(window_shape, TILE, most, strict=True)]

    def fits(tiles: list[int]) -> bool:
        return 3 * 4 * channels * math.prod(tiles) * math.prod(TILE) <= limit_bytes

    if not fits(edges):
        return None
    # In height first, as the rover does not leave it there; then evenly along x and y.
    growing = [2, 0, 1]
    while growing:
        axis = growing.pop(0)
        larger = [edge + (index == axis) for index, edge in enumerate(edges)]
        if larger[axis] <= most[axis] and fits(larger):
            edges = larger
            growing = [2, *growing] if axis == 2 else [*growing, axis]
    x, y, z = (edge * size for edge, size in zip(edges, TILE, strict=True))
    return x, y, z


class TileStore:
    """The tiles of a map on disk: those of the last commit, and those that are waiting for the next one.

    Attributes:
        path: of the map.
        grid: of the whole map, in whole tiles.
        classes: of the map.
        surface: whether it keeps heights.
    """

    def __init__(self, path: Path, grid: GridSpec, classes: tuple[str, ...], *, surface: bool = False) -> None:
        """Opens the map at `path`, or begins an empty one; a commit that was cut off is carried out.

        Raises:
            JaxmapError: something else is at `path`, it is damaged or of another form, or the disk refuses.
        """
        self.path, self.grid, self.classes, self.surface = path, grid, classes, surface
        self._waiting = path.with_name(f".{path.name}.next")
        self._record = self._waiting / "commit.json"
        try:
            if self._record.exists():
                self._apply(read_json(self._record))
            shutil.rmtree(self._waiting, ignore_errors=True)
            if not path.exists():
                self._begin(path, to_json(grid, classes, 0, MapAttributes(progress={"complete": False})))
            self._begin(self._waiting, {})
        except OSError as error:
            raise write_error(error, path) from error
        self._committed = TileArrays(open_group(path, path)[0], path)
        there, needed = (self._committed.arrays[LOG_ODDS].shape, (1 + len(classes), *grid.shape))
        if there != needed or len(self._committed.arrays) != 1 + surface:
            kept = [
                f"{shape} with{'' if heights else 'out'} heights"
                for shape, heights in ((there, len(self._committed.arrays) > 1), (needed, surface))
            ]
            raise JaxmapError(
                f"it has the shape {kept[0]}, the run needs {kept[1]}", where=path, fix="map it anew with --overwrite"
            )
        self._next = TileArrays.open(self._waiting, path, "r+")
        self._there = self._committed.stored()
        self._removed: set[tuple[str, Tile]] = set()

    def tiles(self) -> set[Tile]:
        """The tiles that are there, waiting ones among them."""
        return set().union(*self._there.values())

    def read(self, tile: Tile) -> TileValues | None:
        """What was last written of a tile; None where that is nothing.

        Raises:
            JaxmapError: it is damaged.
        """
        if not any(tile in tiles for tiles in self._there.values()):
            return None
        return TileValues(**{name: self._source(name, tile).read(name, tile) for name in self._there})

    def empty(self) -> TileValues:
        """A tile of zeros."""
        surface = np.zeros((4, *TILE[:2], 1), np.float32) if self.surface else None
        return TileValues(np.zeros((1 + len(self.classes), *TILE), np.float32), surface)

    def _source(self, name: str, tile: Tile) -> TileArrays:
        """Where an array has what was last written of a tile; what was removed is empty in both."""
        waits = (name, tile) in self._removed or self._next.file(name, tile).exists()
        return self._next if waits else self._committed

    def write(self, tile: Tile, values: TileValues) -> None:
        """Writes a tile, to be part of the map with the next commit; one of nothing but zeros is removed.

        Raises:
            JaxmapError: the disk refuses, or a number is not finite.
        """
        try:
            self._next.write(tile, values)
        except OSError as error:
            raise write_error(error, self.path) from error
        for name, tiles in self._there.items():
            if getattr(values, name).any():
                self._removed.discard((name, tile))
                tiles.add(tile)
            else:
                tiles.discard(tile)
                if self._committed.file(name, tile).exists():
                    self._removed.add((name, tile))

    def commit(self, frames_fused: int, attributes: MapAttributes) -> None:
        """Makes the waiting tiles part of the map, with the attributes, all at once.

        Raises:
            JaxmapError: the disk refuses; the map is that of the commit before.
        """
        # Layers that were added to a map before it grew are its own no more.
        stored = {"layers": []} | to_json(self.grid, self.classes, frames_fused, attributes)
        stored |= chunk_attributes({name: len(tiles) for name, tiles in self._there.items()})
        record = {"attributes": stored, "removed": sorted(self._removed)}
        try:
            for parent, _, names in os.walk(self._waiting):
                for name in names:
                    sync(Path(parent, name))
                sync(Path(parent))
            with atomic_path(self._record) as temporary:
                temporary.write_text(json.dumps(record), "utf-8")
            self._apply(record)
            self._record.unlink()
            # The folders that the tiles have left would be gone through at each commit to come.
            for array in self._next.arrays.values():
                shutil.rmtree(array_folder(array) / "c", ignore_errors=True)
        except OSError as error:
            raise write_error(error, self.path) from error
        self._removed.clear()

    def close(self) -> None:
        """Drops what is waiting."""
        shutil.rmtree(self._waiting, ignore_errors=True)

    def _begin(self, folder: Path, stored: dict[str, Any]) -> None:
        """Makes an empty group of the form of the map, whole or not at all."""
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = folder.with_name(f".{folder.name}.new-{os.getpid()}")
        shutil.rmtree(temporary, ignore_errors=True)
        empty = chunk_attributes({LOG_ODDS: 0, **({SURFACE: 0} if self.surface else {})})
        channels = 1 + len(self.classes)
        TileArrays.create(temporary, self.grid, channels, surface=self.surface, stored=stored | empty, where=folder)
        os.rename(temporary, folder)

    def _apply(self, record: dict[str, Any]) -> None:
        """Carries a commit out; whatever part of it was done before is not done again."""
        import zarr

        waiting, committed = (TileArrays.open(one, self.path, "r+") for one in (self._waiting, self.path))
        changed = {self.path}
        for name, tiles in waiting.stored().items():
            for tile in tiles:
                target = committed.file(name, tile)
                target.parent.mkdir(parents=True, exist_ok=True)
                os.replace(waiting.file(name, tile), target)
                changed.update(target.parents[: len(tile) + 2])
        for name, tile in record["removed"]:
            target = committed.file(name, tile)
            target.unlink(missing_ok=True)
            changed.add(target.parent)
        zarr.open_group(self.path, mode="r+", zarr_format=3).update_attributes(record["attributes"])
        sync(self.path / "zarr.json")
        for folder in changed:
            sync(folder)


class MovingBlock:
    """The block of a large map that is in memory, which moves with the views."""

    def __init__(self, store: TileStore, shape: tuple[int, int, int]) -> None:
        """A block of a shape in whole tiles (`block_shape`); nothing is read yet."""
        self.store = store
        self._shape = shape
        self._touched: set[Tile] = set()

    def begin(self, frames_fused: int) -> VoxelMap:
        """A block at the corner of the grid."""
        return self._load(np.asarray(self.store.grid.first), frames_fused)

    def cover(self, voxel_map: VoxelMap, boxes: Int[np.ndarray, "*n 2 3"]) -> VoxelMap:
        """The block, moved where that is needed, so that it holds the voxels of views, which count as changed.

        Args:
            voxel_map: the block so far; it must not be used again.
            boxes: of `geometry.bounds.view_boxes`: one, or those of frames that are fused at once.

        Raises:
            JaxmapError: no block of its size holds them all.
        """
        views = boxes.reshape(-1, 2, 3)
        views = views[(views[:, 1] > views[:, 0]).all(axis=1)]
        if not len(views):
            return voxel_map
        box = np.stack([views[:, 0].min(axis=0), views[:, 1].max(axis=0)])
        first = np.asarray(voxel_map.grid.first)
        if (box[0] < first).any() or (box[1] > first + self._shape).any():
            self._check_holds(box, len(views))
            self.write_changes(voxel_map)
            count = int(voxel_map.frames_fused)
            # Freed before the next one is made: a block is most of the memory.
            voxel_map.log_odds.delete()
            if voxel_map.surface is not None:
                voxel_map.surface.delete()
            voxel_map = self._load(self._around(box), count)
        for view in views:
            self._touched |= set(tiles_of(self.store.grid, view))
        return voxel_map

    def _check_holds(self, box: Int[np.ndarray, "2 3"], views: int) -> None:
        """Refuses views that lie too far apart, of which some would be left out."""
        tiles = -(-box[1] // TILE) - box[0] // TILE
        if (tiles * TILE > self._shape).any():
            raise JaxmapError(
                f"the views of {views} frames fill {' x '.join(map(str, box[1] - box[0]))} voxels, the part of the map "
                f"in memory has {' x '.join(map(str, self._shape))}",
                where=self.store.path,
                fix="raise --grid.max-memory-gib, or fuse fewer frames at once (--devices 1)",
            )

    def write_changes(self, voxel_map: VoxelMap) -> None:
        """Writes the tiles of the block that have changed, to be committed."""
        values, first = np.asarray(voxel_map.log_odds), np.asarray(voxel_map.grid.first)
        surface = None if voxel_map.surface is None else np.asarray(voxel_map.surface)
        offset = (first - np.asarray(self.store.grid.first)) // TILE
        for tile in sorted(self._touched):
            self.store.write(tile, values_of(values, surface, np.asarray(tile) - offset))
        self._touched.clear()

    def _around(self, box: Int[np.ndarray, "2 3"]) -> Int[np.ndarray, "3"]:
        """Where a block begins that has a view in its middle, as far as the grid allows."""
        low = np.asarray(self.store.grid.first)
        centred = (box.mean(axis=0) - np.asarray(self._shape) / 2 - low) / TILE
        # Rounding must not lose a voxel of the view.
        tiles = np.clip(np.round(centred), np.ceil((box[1] - low - self._shape) / TILE), (box[0] - low) // TILE)
        most = (np.asarray(self.store.grid.shape) - self._shape) // TILE
        return low + (np.clip(tiles, 0, most) * TILE).astype(np.int64)

    def _load(self, first: Int[np.ndarray, "3"], frames_fused: int) -> VoxelMap:
        grid = replace(self.store.grid, first=to_device(first, np.int32), shape=self._shape)
        values = np.zeros((1 + len(self.store.classes), *self._shape), np.float32)
        surface = None
        if self.store.surface:
            surface = np.zeros((4, *self._shape[:2], layer_count(self._shape[2])), np.float32)
        offset = (first - np.asarray(self.store.grid.first)) // TILE
        for tile in tiles_of(self.store.grid, np.stack([first, first + self._shape])):
            if (stored := self.store.read(tile)) is not None:
                values[tile_part(np.asarray(tile) - offset)] = stored.log_odds
                if surface is not None:
                    surface[surface_part(np.asarray(tile) - offset)] = stored.surface
        # One copy; `jnp.array` would make two.
        log_odds, surface = jax.device_put((values, surface), may_alias=False)
        count = to_device(frames_fused, np.int32)
        return VoxelMap(log_odds, count, grid, self.store.classes, surface=surface)


def tiles_of(grid: GridSpec, box: Int[np.ndarray, "2 3"]) -> Iterator[Tile]:
    """The tiles of a grid that a box of voxels, given on the lattice, touches."""
    low, high = (box - np.asarray(grid.first)).clip(0, grid.shape)
    if (high > low).all():
        x, y, z = (range(int(a) // edge, -(-int(b) // edge)) for a, b, edge in zip(low, high, TILE, strict=True))
        yield from product(x, y, z)
