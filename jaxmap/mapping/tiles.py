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
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32, Int

from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import read_json
from jaxmap.host.files import atomic_path, sync, write_error
from jaxmap.mapping.arrays import (
    AXES,
    LOG_ODDS,
    TILE,
    array_folder,
    check_finite,
    create_array,
    open_group,
    read_part,
    stored_chunks,
)
from jaxmap.mapping.attributes import MapAttributes, to_json
from jaxmap.types import GridSpec, VoxelMap, to_device

if TYPE_CHECKING:
    import zarr

Tile = tuple[int, int, int]
"""The place of a tile in the grid, counted in tiles."""


def whole_tiles(grid: GridSpec) -> GridSpec:
    """The grid, grown to whole tiles of the lattice: tiles of any two maps on one lattice coincide."""
    first = np.asarray(grid.first) // TILE * TILE
    end = -(-(np.asarray(grid.first) + grid.shape) // TILE) * TILE
    x, y, z = (end - first).tolist()
    return replace(grid, first=to_device(first, np.int32), shape=(x, y, z))


def block_shape(
    grid: GridSpec, window_shape: tuple[int, int, int], channels: int, limit_bytes: float
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
    """

    def __init__(self, path: Path, grid: GridSpec, classes: tuple[str, ...]) -> None:
        """Opens the map at `path`, or begins an empty one; a commit that was cut off is carried out.

        Raises:
            JaxmapError: something else is at `path`, it is damaged or of another form, or the disk refuses.
        """
        self.path, self.grid, self.classes = path, grid, classes
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
        self._committed = open_group(path, path)[0][LOG_ODDS]
        if self._committed.shape != (1 + len(classes), *grid.shape):
            raise JaxmapError(
                f"it has the shape {self._committed.shape}, the run needs {(1 + len(classes), *grid.shape)}",
                where=path,
                fix="map it anew with --overwrite",
            )
        self._next = self._array(self._waiting)
        # Listed once: a map of kilometres has tens of thousands.
        self._there: set[Tile] = {(x, y, z) for _, x, y, z in stored_chunks(array_folder(self._committed))}
        self._removed: set[Tile] = set()

    def tiles(self) -> set[Tile]:
        """The tiles that are there, waiting ones among them."""
        return set(self._there)

    def read(self, tile: Tile) -> Float32[np.ndarray, "K X Y Z"] | None:
        """What was last written of a tile; None where that is nothing.

        Raises:
            JaxmapError: it is damaged.
        """
        if tile not in self._there:
            return None
        waits = _chunk_file(self._next, tile).exists()
        return read_part(self._next if waits else self._committed, _part(tile), self.path)

    def write(self, tile: Tile, log_odds: Float32[np.ndarray, "K X Y Z"]) -> None:
        """Writes a tile, to be part of the map with the next commit; one of nothing but zeros is removed.

        Raises:
            JaxmapError: the disk refuses, or a number is not finite.
        """
        check_finite(log_odds, self.path)
        try:
            self._next[_part(tile)] = log_odds
        except OSError as error:
            raise write_error(error, self.path) from error
        if log_odds.any():
            self._removed.discard(tile)
            self._there.add(tile)
        else:
            self._there.discard(tile)
            if _chunk_file(self._committed, tile).exists():
                self._removed.add(tile)

    def commit(self, frames_fused: int, attributes: MapAttributes) -> None:
        """Makes the waiting tiles part of the map, with the attributes, all at once.

        Raises:
            JaxmapError: the disk refuses; the map is that of the commit before.
        """
        stored = to_json(self.grid, self.classes, frames_fused, attributes)
        stored["chunks_stored"] = len(self._there)
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
            shutil.rmtree(array_folder(self._next) / "c", ignore_errors=True)
        except OSError as error:
            raise write_error(error, self.path) from error
        self._removed.clear()

    def close(self) -> None:
        """Drops what is waiting."""
        shutil.rmtree(self._waiting, ignore_errors=True)

    def _begin(self, folder: Path, stored: dict[str, Any]) -> None:
        """Makes an empty group of the form of the map, whole or not at all."""
        import zarr

        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = folder.with_name(f".{folder.name}.new-{os.getpid()}")
        shutil.rmtree(temporary, ignore_errors=True)
        group = zarr.create_group(temporary, zarr_format=3, attributes=stored | {"chunks_stored": 0})
        create_array(group, LOG_ODDS, (1 + len(self.classes), *self.grid.shape), AXES)
        os.rename(temporary, folder)

    def _array(self, folder: Path) -> zarr.Array:
        import zarr

        return zarr.open_array(folder / LOG_ODDS, mode="r+", zarr_format=3)

    def _apply(self, record: dict[str, Any]) -> None:
        """Carries a commit out; whatever part of it was done before is not done again."""
        import zarr

        waiting, committed = self._array(self._waiting), self._array(self.path)
        changed = {self.path}
        for _, *tile in stored_chunks(array_folder(waiting)):
            target = _chunk_file(committed, tile)
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(_chunk_file(waiting, tile), target)
            changed.update(target.parents[: len(tile) + 2])
        for tile in record["removed"]:
            _chunk_file(committed, tile).unlink(missing_ok=True)
            changed.add(_chunk_file(committed, tile).parent)
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
        offset = (first - np.asarray(self.store.grid.first)) // TILE
        for tile in sorted(self._touched):
            part = _part(np.asarray(tile) - offset)
            self.store.write(tile, np.ascontiguousarray(values[part]))
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
        offset = (first - np.asarray(self.store.grid.first)) // TILE
        for tile in tiles_of(self.store.grid, np.stack([first, first + self._shape])):
            if (stored := self.store.read(tile)) is not None:
                values[_part(np.asarray(tile) - offset)] = stored
        return VoxelMap(jnp.array(values), to_device(frames_fused, np.int32), grid, self.store.classes)


def tiles_of(grid: GridSpec, box: Int[np.ndarray, "2 3"]) -> Iterator[Tile]:
    """The tiles of a grid that a box of voxels, given on the lattice, touches."""
    low, high = (box - np.asarray(grid.first)).clip(0, grid.shape)
    if (high > low).all():
        x, y, z = (range(int(a) // edge, -(-int(b) // edge)) for a, b, edge in zip(low, high, TILE, strict=True))
        yield from product(x, y, z)


def _part(tile: Tile | Int[np.ndarray, "3"]) -> tuple[slice, ...]:
    return (slice(None), *(slice(int(i) * edge, (int(i) + 1) * edge) for i, edge in zip(tile, TILE, strict=True)))


def _chunk_file(array: zarr.Array, tile: Any) -> Path:
    return array_folder(array).joinpath("c", "0", *(str(int(index)) for index in tile))
