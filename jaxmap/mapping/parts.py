"""The parts of a map that are fused apart, on disk: tiles of a region, and the map that is put together from them.

A part is written whole under a name that tells all that decides what it comes out as. What is there needs not be done
again, and doing it twice does no harm. The map keeps a record of what each of its tiles is made of.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import read_json
from jaxmap.host.files import sync, write_error
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
from jaxmap.mapping.regions import corner_tile
from jaxmap.mapping.store import swap_in, sync_tree
from jaxmap.mapping.tiles import Tile
from jaxmap.types import GridSpec, VoxelMap

RECORD = f"{LOG_ODDS}/tiles.json"
"""Within a map that was fused in regions: what each of its tiles is made of."""


def part_name(digest: str, sources: Mapping[Tile, str]) -> str:
    """The name of what a task writes: a fingerprint of the run and of what the tiles are made of."""
    told = json.dumps([digest, sorted(sources.items())])
    return hashlib.sha256(told.encode()).hexdigest()[:32]


def write_part(folder: Path, voxel_map: VoxelMap, tiles: Iterable[Tile], told: dict[str, Any]) -> None:
    """Writes tiles of a region, and what is told of its frames, whole or not at all; what is there stays.

    Args:
        folder: the part, by its name.
        voxel_map: the dense map of the region.
        tiles: those to write, counted along the lattice; of nothing but zeros, they are left out.
        told: JSON values.

    Raises:
        JaxmapError: the disk refuses, or a number is not finite.
    """
    import zarr

    if folder.exists():
        return
    # Another machine may write the same, in a process of the same number.
    temporary = folder.with_name(f".{folder.name}.tmp-{secrets.token_hex(8)}")
    low = np.asarray(voxel_map.grid.first) // TILE
    values = np.asarray(voxel_map.log_odds)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        group = zarr.create_group(temporary, zarr_format=3)
        array = create_array(group, LOG_ODDS, values.shape, AXES)
        for tile in tiles:
            here = tuple(int(a - b) for a, b in zip(tile, low, strict=True))
            part = tile_part(here)
            one = np.ascontiguousarray(values[part])
            check_finite(one, folder)
            if one.any():
                array[part] = one
        (temporary / "told.json").write_text(json.dumps({"first_tile": low.tolist(), **told}), "utf-8")
        sync_tree(temporary)
        try:
            os.rename(temporary, folder)
        except OSError:
            # Another worker was faster, and has written the same.
            if not (folder / "told.json").exists():
                raise
        sync(folder.parent)
    except OSError as error:
        raise write_error(error, folder) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def read_told(folder: Path) -> dict[str, Any]:
    """What `write_part` was told."""
    return read_json(folder / "told.json")


def part_tiles(folder: Path) -> dict[Tile, Path]:
    """The files of the tiles of a part, counted along the lattice."""
    low = read_told(folder)["first_tile"]
    chunks = folder / LOG_ODDS
    return {
        (x + low[0], y + low[1], z + low[2]): chunks.joinpath("c", "0", str(x), str(y), str(z))
        for _, x, y, z in stored_chunks(chunks)
    }


class TileRecord(NamedTuple):
    """What the tiles of a map are made of.

    Attributes:
        digest: of the run, whatever the poses: only of one run are tiles of one source the same.
        sources: of each tile that frames touch (`tile_sources`), by its place along the lattice.
        stored: those of them that are not all zero.
        frames: what was told of each frame, by name.
    """

    digest: str
    sources: dict[Tile, str]
    stored: set[Tile]
    frames: dict[str, list[Any]]


def read_record(map_folder: Path) -> TileRecord | None:
    """The record of a map; None where it has none, as it was not fused in regions.

    Raises:
        JaxmapError: it is damaged.
    """
    path = map_folder / RECORD
    if not path.exists():
        return None
    tree = read_json(path)
    try:
        tiles = {_tile(name): (str(source), bool(stored)) for name, (source, stored) in tree["tiles"].items()}
        return TileRecord(
            str(tree["digest"]),
            {tile: source for tile, (source, _) in tiles.items()},
            {tile for tile, (_, stored) in tiles.items() if stored},
            {str(name): list(told) for name, told in tree["frames"].items()},
        )
    except (KeyError, TypeError, ValueError, AttributeError) as fault:
        raise JaxmapError("it is damaged", where=path, fix="map the observations anew with --overwrite") from fault


def assemble_map(
    path: Path,
    grid: GridSpec,
    classes: tuple[str, ...],
    frames_fused: int,
    attributes: MapAttributes,
    tiles: Mapping[Tile, Path],
    record: TileRecord,
) -> None:
    """Puts a map together from the files of its tiles, and swaps it in as a whole; the files stay.

    Args:
        path: of the map.
        grid: of whole tiles.
        classes: of the map.
        frames_fused: how many frames it holds.
        attributes: stored beside it.
        tiles: the files, by their place along the lattice.
        record: stored within.

    Raises:
        JaxmapError: the disk refuses; what was at `path` is still there.
    """
    import zarr

    temporary = path.with_name(f".{path.name}.new-{os.getpid()}")
    corner = corner_tile(grid)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for stray in path.parent.glob(f".{path.name}.new-*"):
            shutil.rmtree(stray)
        stored = to_json(grid, classes, frames_fused, attributes) | {"chunks_stored": len(tiles)}
        group = zarr.create_group(temporary, zarr_format=3, attributes=stored)
        array = create_array(group, LOG_ODDS, (1 + len(classes), *grid.shape), AXES)
        for tile, file in tiles.items():
            here = (str(int(a - b)) for a, b in zip(tile, corner, strict=True))
            target = array_folder(array).joinpath("c", "0", *here)
            target.parent.mkdir(parents=True, exist_ok=True)
            _link(file, target)
        named = {_name(tile): [source, tile in tiles] for tile, source in sorted(record.sources.items())}
        tree = {"digest": record.digest, "tiles": named, "frames": record.frames}
        (temporary / RECORD).write_text(json.dumps(tree), "utf-8")
        sync_tree(temporary)
        swap_in(temporary, path)
    except OSError as error:
        raise write_error(error, path) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


class KeptTiles(NamedTuple):
    """The tiles of an earlier map that can stay.

    Attributes:
        files: of those that are stored.
        done: all of them, with those that hold nothing but zeros.
        lost: those that should be there and are damaged (the message) or missing.
    """

    files: dict[Tile, Path]
    done: set[Tile]
    lost: dict[Tile, str]


def kept_tiles(path: Path, record: TileRecord, sources: Mapping[Tile, str], grid: GridSpec) -> KeptTiles:
    """The tiles of a map that are made of the same frames at the same poses, each read and found whole.

    Args:
        path: of the map.
        record: its own.
        sources: what the tiles of the map to come are made of.
        grid: of the map to come; one on another lattice has none in common.

    Raises:
        JaxmapError: it is no map.
    """
    arrays, stored = open_group(path, path)
    array, low = arrays[LOG_ODDS], np.array(stored.get("first_voxel", (0, 0, 0))) // TILE
    files: dict[Tile, Path] = {}
    done: set[Tile] = set()
    lost: dict[Tile, str] = {}
    same_voxels = stored.get("voxel_size_m") == np.asarray(grid.voxel_size_m, np.float64).tolist()
    if not same_voxels or stored.get("lattice_m") != np.asarray(grid.lattice_m, np.float64).tolist():
        return KeptTiles(files, done, lost)
    for tile, source in sources.items():
        if record.sources.get(tile) != source:
            continue
        if tile not in record.stored:
            done.add(tile)
            continue
        here = tuple(int(a - b) for a, b in zip(tile, low, strict=True))
        file = array_folder(array).joinpath("c", "0", *map(str, here))
        if not file.exists():
            lost[tile] = "is missing"
            continue
        try:
            read_part(array, tile_part(here), path)
        except JaxmapError:
            lost[tile] = "is damaged"
            continue
        files[tile] = file
        done.add(tile)
    return KeptTiles(files, done, lost)


def tile_part(tile: Sequence[int]) -> tuple[slice, ...]:
    """Where a tile lies in an array of log-odds that begins with tile 0 0 0."""
    return (slice(None), *(slice(i * edge, (i + 1) * edge) for i, edge in zip(tile, TILE, strict=True)))


def _link(file: Path, target: Path) -> None:
    """The same content at another place. Files of tiles are replaced, never written into: both may be one."""
    try:
        os.link(file, target)
    except OSError:
        shutil.copyfile(file, target)


def _name(tile: Tile) -> str:
    return " ".join(map(str, tile))


def _tile(name: str) -> Tile:
    x, y, z = map(int, name.split(" "))
    return x, y, z
