"""Maps of several sessions added up: fusion is a sum, so the sum of maps is the map of all sessions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Int

from jaxmap.errors import UsageError
from jaxmap.fusion.surface import combine
from jaxmap.geometry.grid import exact_corner
from jaxmap.mapping.arrays import TILE
from jaxmap.mapping.store import Block, MapReader
from jaxmap.mapping.tile_arrays import Tile
from jaxmap.mapping.tiles import TileStore, tiles_of, whole_tiles
from jaxmap.types import LAYER, MOST_VOXELS_ALONG, GridSpec, to_device

_FULL_VOXEL = 1e-3
"""Lattices that are less than this share of a voxel apart are one: they are stored in float32."""


Shift = Int[np.ndarray, "3"]
"""From the voxels of one lattice to those of another."""


def common_grid(maps: Sequence[MapReader], names: Sequence[object]) -> tuple[GridSpec, list[Shift]]:
    """The grid that holds all maps, in whole tiles on the lattice of the first, about the first's site origin.

    Args:
        maps: with voxels of one size (`check_alike`).
        names: of the maps, for errors.

    Returns:
        The grid, and what is to be added to voxels of each map's lattice to count them on the grid's.

    Raises:
        UsageError: the lattices differ by a part of a voxel.
    """
    size_m = exact_corner(maps[0].grid)[1]
    corners = [_lattice_m(one) for one in maps]
    shifts = []
    for corner, name in zip(corners, names, strict=True):
        apart = (corner - corners[0]) / size_m
        shift = np.round(apart)
        if (np.abs(apart - shift) > _FULL_VOXEL).any():
            raise UsageError(
                f"the lattice is {(apart - shift).round(3).tolist()} of a voxel off that of {names[0]}",
                where=name,
                fix="map one of the two again: maps of one CRS and voxel size then share their voxels",
            )
        shifts.append(shift.astype(np.int64))
    boxes = [_box(one.grid) + shift for one, shift in zip(maps, shifts, strict=True)]
    low, high = np.min(boxes, axis=(0, 1)), np.max(boxes, axis=(0, 1))
    if max(np.abs(low).max(), np.abs(high).max()) > MOST_VOXELS_ALONG - max(TILE):
        raise UsageError(
            f"{np.abs([low, high]).max():.3g} voxels from the first site's origin, at most {MOST_VOXELS_ALONG:,} can "
            "be told apart",
            where=names[0],
            fix="merge sessions of one site",
        )
    x, y, z = (high - low).tolist()
    return whole_tiles(replace(maps[0].grid, first=to_device(low, np.int32), shape=(x, y, z))), shifts


def check_alike(maps: Sequence[MapReader], names: Sequence[object]) -> None:
    """Refuses maps whose sum would mean nothing; every reason is told.

    Raises:
        UsageError: they differ in their system, voxels, classes or fusion, or share frames.
    """
    first = maps[0]
    for one, name in zip(maps, names, strict=True):
        ours, theirs = one.attributes, first.attributes
        pairs = {
            "CRS": (ours.crs, theirs.crs),
            "voxel size": tuple(np.asarray(of.grid.voxel_size_m).tolist() for of in (one, first)),
            "classes": (list(one.classes), list(first.classes)),
            **{
                f"fusion.{key}": (ours.fusion.get(key), theirs.fusion.get(key))
                for key in sorted(ours.fusion.keys() | theirs.fusion.keys())
            },
        }
        apart = [f"{key} is {a}, not {b}" for key, (a, b) in pairs.items() if a != b]
        if apart:
            raise UsageError(
                f"not to be added to {names[0]}: {'; '.join(apart)}", where=name, fix="map all sessions alike"
            )
    seen: dict[str, object] = {}
    for one, name in zip(maps, names, strict=True):
        for digest in digests_of(one):
            if digest in seen:
                raise UsageError(
                    f"frames of {seen[digest]} would count twice",
                    where=name,
                    fix="name each session once",
                )
            seen[digest] = name


def digests_of(one: MapReader) -> list[str]:
    """The fingerprints of the frames in a map; several where it was merged."""
    progress = one.attributes.progress
    digests = progress.get("digests", [progress.get("digest")])
    return [digest for digest in digests if isinstance(digest, str) and digest] if isinstance(digests, list) else []


def add_maps(
    maps: Sequence[MapReader],
    shifts: Sequence[Int[np.ndarray, "3"]],
    store: TileStore,
    on_block: Callable[[int], object] = lambda done: None,
) -> None:
    """Adds maps into the tiles of an empty map, block by block; its tiles then wait for a commit.

    A voxel that one map alone has seen holds just what that has; memory stays that of one block.

    Args:
        maps: what is added.
        shifts: of `common_grid`.
        store: on its grid.
        on_block: is told how many blocks are done.

    Raises:
        JaxmapError: a tile is damaged, or the disk refuses.
    """
    done = 0
    for one, shift in zip(maps, shifts, strict=True):
        higher_m = float(np.asarray(one.attributes.site_origin)[2] - np.asarray(maps[0].attributes.site_origin)[2])
        for block in one.blocks():
            _add(block, shift, store)
            if store.surface:
                _add_heights(block, shift, higher_m, store)
            done += 1
            on_block(done)


Slices = tuple[slice, ...]


def _add(block: Block, shift: Shift, store: TileStore) -> None:
    values = np.asarray(block.voxel_map.log_odds)[(slice(None), *block.own)]
    for tile, here, there in _shared(_corner(block, shift), values.shape[1:], store):
        if (added := values[(slice(None), *here)]).any():
            sums = store.read(tile) or store.empty()
            sums.log_odds[(slice(None), *there)] += added
            store.write(tile, sums)


def _add_heights(block: Block, shift: Shift, higher_m: float, store: TileStore) -> None:
    """Adds the heights of a block; its layers and those of the sum need not begin at the same height.

    All points of a layer then count in the layer where it begins: that of a column is the same.
    """
    assert block.voxel_map.surface is not None
    values = np.array(np.asarray(block.voxel_map.surface)[(slice(None), *block.own)])
    values[2] += np.where(values[1] > 0, np.float32(higher_m), 0)
    low, count = int(np.asarray(store.grid.first)[2]), store.grid.shape[2] // LAYER
    begins = int(np.asarray(block.voxel_map.grid.first)[2]) // LAYER * LAYER + int(shift[2])
    for layer in range(values.shape[3]):
        level = min(max((begins + layer * LAYER - low) // LAYER, 0), count - 1)
        added = values[..., layer]
        corner = np.array([*_corner(block, shift)[:2], low + level * LAYER])
        for tile, here, there in _shared(corner, (*added.shape[1:], LAYER), store):
            if (part := added[(slice(None), *here[:2])]).any():
                sums = store.read(tile) or store.empty()
                assert sums.surface is not None
                into = (slice(None), *there[:2], 0)
                sums.surface[into] = combine(sums.surface[into], part)
                store.write(tile, sums)


def _corner(block: Block, shift: Shift) -> Shift:
    """Where the own columns of a block begin on the lattice of the sum."""
    own = [block.own[0].start or 0, block.own[1].start or 0, 0]
    return np.asarray(block.voxel_map.grid.first) + shift + own


def _shared(corner: Shift, shape: Sequence[int], store: TileStore) -> Iterator[tuple[Tile, Slices, Slices]]:
    """The tiles that a box of voxels touches, and what they share with it, as counted in the box and in the tile."""
    box, origin = np.stack([corner, corner + shape]), np.asarray(store.grid.first)
    for tile in tiles_of(store.grid, box):
        begin = origin + np.multiply(tile, TILE)
        low, high = np.maximum(begin, box[0]), np.minimum(begin + TILE, box[1])
        here, there = (
            tuple(slice(int(a), int(b)) for a, b in zip(low - base, high - base, strict=True))
            for base in (corner, begin)
        )
        yield tile, here, there


def _lattice_m(one: MapReader) -> np.ndarray:
    """Where voxel 0 of a map's lattice lies in its system, float64."""
    corner_m, size_m = exact_corner(one.grid)
    return np.asarray(one.attributes.site_origin, np.float64) + corner_m - np.asarray(one.grid.first) * size_m


def _box(grid: GridSpec) -> Int[np.ndarray, "2 3"]:
    first = np.asarray(grid.first, np.int64)
    return np.stack([first, first + grid.shape])
