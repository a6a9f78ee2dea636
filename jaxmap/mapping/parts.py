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
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import read_json
from jaxmap.host.files import sync, write_error
from jaxmap.mapping.arrays import LOG_ODDS, SURFACE, TILE, open_group
from jaxmap.mapping.attributes import MapAttributes, to_json
from jaxmap.mapping.regions import corner_tile
from jaxmap.mapping.store import swap_in, sync_tree
from jaxmap.mapping.tile_arrays import Tile, TileArrays, chunk_attributes, values_of
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
    if folder.exists():
        return
    # Another machine may write the same, in a process of the same number.
    temporary = folder.with_name(f".{folder.name}.tmp-{secrets.token_hex(8)}")
    low = np.asarray(voxel_map.grid.first) // TILE
    values = np.asarray(voxel_map.log_odds)
    surface = None if voxel_map.surface is None else np.asarray(voxel_map.surface)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        kept = surface is not None
        arrays = TileArrays.create(temporary, voxel_map.grid, len(values), surface=kept, stored={}, where=folder)
        for tile in tiles:
            arrays.write(tile - low, values_of(values, surface, tile - low))
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


TileFiles = dict[tuple[str, Tile], Path]
"""Files by the array and the tile that they are of; tiles counted along the lattice."""


def part_tiles(folder: Path) -> TileFiles:
    """The files of the tiles of a part."""
    low, arrays = read_told(folder)["first_tile"], TileArrays.open(folder, folder, "r")
    return {
        (name, (x + low[0], y + low[1], z + low[2])): arrays.file(name, (x, y, z))
        for name, tiles in arrays.stored().items()
        for x, y, z in tiles
    }


class TileRecord(NamedTuple):
    """What the tiles of a map are made of.

    Attributes:
        digest: of the run, whatever the poses: only of one run are tiles of one source the same.
        sources: of each tile that frames touch (`tile_sources`), by its place along the lattice.
        stored: the arrays in which they are not all zero, with them.
        frames: what was told of each frame, by name.
    """

    digest: str
    sources: dict[Tile, str]
    stored: set[tuple[str, Tile]]
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
        tiles = {_tile(name): (str(source), list(stored)) for name, (source, stored) in tree["tiles"].items()}
        return TileRecord(
            str(tree["digest"]),
            {tile: source for tile, (source, _) in tiles.items()},
            {(str(name), tile) for tile, (_, stored) in tiles.items() for name in stored},
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
    files: TileFiles,
    record: TileRecord,
    *,
    surface: bool,
) -> None:
    """Puts a map together from the files of its tiles, and swaps it in as a whole; the files stay.

    Args:
        path: of the map.
        grid: of whole tiles.
        classes: of the map.
        frames_fused: how many frames it holds.
        attributes: stored beside it.
        files: of its tiles.
        record: stored within.
        surface: whether it keeps heights.

    Raises:
        JaxmapError: the disk refuses; what was at `path` is still there.
    """
    temporary = path.with_name(f".{path.name}.new-{os.getpid()}")
    corner = corner_tile(grid)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for stray in path.parent.glob(f".{path.name}.new-*"):
            shutil.rmtree(stray)
        kept = (LOG_ODDS, SURFACE) if surface else (LOG_ODDS,)
        counts = {name: sum(of == name for of, _ in files) for name in kept}
        stored = to_json(grid, classes, frames_fused, attributes) | chunk_attributes(counts)
        arrays = TileArrays.create(temporary, grid, 1 + len(classes), surface=surface, stored=stored, where=path)
        for (name, tile), file in files.items():
            target = arrays.file(name, tile - corner)
            target.parent.mkdir(parents=True, exist_ok=True)
            _link(file, target)
        named = {
            _name(tile): [source, [name for name in kept if (name, tile) in files]]
            for tile, source in sorted(record.sources.items())
        }
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
        files: theirs.
        done: all of them, with those that hold nothing but zeros.
        lost: those that should be there and are damaged (the message) or missing.
    """

    files: TileFiles
    done: set[Tile]
    lost: dict[Tile, str]


def kept_tiles(
    path: Path, record: TileRecord, sources: Mapping[Tile, str], grid: GridSpec, *, surface: bool
) -> KeptTiles:
    """The tiles of a map that are made of the same frames at the same poses, each read and found whole.

    Args:
        path: of the map.
        record: its own.
        sources: what the tiles of the map to come are made of.
        grid: of the map to come; one on another lattice has none in common.
        surface: whether that keeps heights; one that does not has none in common with one that does.

    Raises:
        JaxmapError: it is no map.
    """
    found, stored = open_group(path, path)
    arrays, low = TileArrays(found, path), np.array(stored.get("first_voxel", (0, 0, 0))) // TILE
    files: TileFiles = {}
    done: set[Tile] = set()
    lost: dict[Tile, str] = {}
    same_voxels = stored.get("voxel_size_m") == np.asarray(grid.voxel_size_m, np.float64).tolist()
    same_lattice = stored.get("lattice_m") == np.asarray(grid.lattice_m, np.float64).tolist()
    if not same_voxels or not same_lattice or (SURFACE in arrays.arrays) != surface:
        return KeptTiles(files, done, lost)
    for tile, source in sources.items():
        if record.sources.get(tile) != source:
            continue
        names = [name for name in arrays.arrays if (name, tile) in record.stored]
        if fault := next(filter(None, (_fault(arrays, name, tile - low) for name in names)), None):
            lost[tile] = fault
            continue
        files |= {(name, tile): arrays.file(name, tile - low) for name in names}
        done.add(tile)
    return KeptTiles(files, done, lost)


def _fault(arrays: TileArrays, name: str, tile: Int[np.ndarray, "3"]) -> str:
    """What is wrong with a tile that should be there; empty where it can be read."""
    if not arrays.file(name, tile).exists():
        return "is missing"
    try:
        arrays.read(name, tile)
    except JaxmapError:
        return "is damaged"
    return ""


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
