"""Maps on disk: a Zarr v3 group that is replaced as a whole, and checked when it is read.

A map is written beside its place, synced, and swapped in by renames; the one before it waits aside
until then. A process that dies at any moment leaves one of the two to load.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxmap.errors import JaxmapError
from jaxmap.host.files import sync, write_error
from jaxmap.mapping.arrays import (
    AXES,
    LAYER_AXES,
    LOG_ODDS,
    MEMBERS,
    SURFACE,
    SURFACE_AXES,
    StoredArray,
    array_folder,
    check_finite,
    check_kind,
    chunk_counts,
    create_array,
    open_group,
    present,
    read_array,
    read_part,
    stored_chunks,
    write_array,
)
from jaxmap.mapping.attributes import MapAttributes, from_json, to_json
from jaxmap.types import GridSpec, VoxelMap, layer_count, to_device

if TYPE_CHECKING:
    import zarr


def save_map(path: str | os.PathLike[str], voxel_map: VoxelMap, attributes: MapAttributes) -> None:
    """Writes a map, replacing the one that is there in one step.

    Raises:
        JaxmapError: the disk is full or refuses, the path holds something else, or the map is not finite;
            whatever was at `path` is still there.
    """
    target = Path(path)
    arrays = _arrays_of(voxel_map, attributes)
    for name in (LOG_ODDS, MEMBERS, SURFACE):
        if name in arrays:
            check_finite(arrays[name].values, target)
    temporary = target.with_name(f".{target.name}.new-{os.getpid()}")
    try:
        if target.exists() and not _replaceable(target):
            raise JaxmapError(
                "something that is no map is in the way", where=target, fix="move it or name another output"
            )
        target.parent.mkdir(parents=True, exist_ok=True)
        for stray in target.parent.glob(f".{target.name}.new-*"):
            shutil.rmtree(stray)
        _write_group(
            temporary,
            arrays,
            to_json(voxel_map.grid, voxel_map.classes, int(voxel_map.frames_fused), attributes),
        )
        sync_tree(temporary)
        swap_in(temporary, target)
    except OSError as error:
        raise write_error(error, target) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def holds_map(path: str | os.PathLike[str]) -> bool:
    """Whether there is a map, be it one that a crash has left set aside."""
    target = Path(path)
    return target.exists() or _set_aside(target).exists()


def stray_maps(path: str | os.PathLike[str]) -> list[Path]:
    """What saves that were cut off have left beside a map."""
    target = Path(path)
    return [_set_aside(target), *target.parent.glob(f".{target.name}.new-*")]


def load_map(path: str | os.PathLike[str], *, members: bool = False) -> tuple[VoxelMap, MapAttributes]:
    """Reads a map; where a save was cut off between its renames, the map from before it.

    Args:
        path: the folder.
        members: read those of an ensemble, too, where the map has one, as a resumed run needs them.

    Raises:
        JaxmapError: there is no map, it was written by a newer version, its parts disagree, a chunk is
            damaged or missing, or a number is not finite.
    """
    target = Path(path)
    _, arrays, stored = _opened(target)
    grid, classes, frames_fused, attributes = from_json(stored, target)
    log_odds = read_array(arrays, LOG_ODDS, (1 + len(classes), *grid.shape), stored.get("chunks_stored"), target)
    check_finite(log_odds, target)
    _read_layers(arrays, stored, grid, attributes, target)
    ensemble = None
    if members and MEMBERS in arrays:
        shape = (arrays[MEMBERS].shape[0], 2, *grid.shape)
        ensemble = read_array(arrays, MEMBERS, shape, chunk_counts(stored, target).get(MEMBERS), target)
        check_finite(ensemble, target)
    surface = None
    if SURFACE in arrays:
        shape = (4, *grid.shape[:2], layer_count(grid.shape[2]))
        surface = read_array(arrays, SURFACE, shape, chunk_counts(stored, target).get(SURFACE), target)
        check_finite(surface, target)
    voxel_map = VoxelMap(
        log_odds=jnp.asarray(log_odds),
        frames_fused=to_device(frames_fused, np.int32),
        grid=grid,
        classes=classes,
        members=None if ensemble is None else jnp.asarray(ensemble),
        surface=None if surface is None else jnp.asarray(surface),
    )
    return voxel_map, attributes


def _opened(target: Path) -> tuple[Path, dict[str, zarr.Array], dict[str, Any]]:
    """The folder of a map, its arrays and its attributes.

    Raises:
        JaxmapError: there is none, or it is no map.
    """
    folder = target if target.exists() else _set_aside(target)
    if not folder.exists():
        raise JaxmapError("no such map", where=target, fix="give a map.zarr folder of `jaxmap map`")
    return folder, *open_group(folder, target)


Columns = tuple[slice, slice]
"""A rectangle of columns of a grid, along x and y."""


class Block(NamedTuple):
    """A dense part of a map: columns of full height, with a margin of others around them.

    Attributes:
        voxel_map: the part; `grid.first` says where it lies.
        own: the rows of columns along x and y that are this block's; what is around them is other blocks', too.
        corner: where the own columns begin in the whole grid.
    """

    voxel_map: VoxelMap
    own: Columns
    corner: tuple[int, int]


@dataclass(frozen=True, eq=False)
class MapReader:
    """A map of any size, to be gone through block by block.

    Attributes:
        grid: of the whole map.
        classes: its classes.
        frames_fused: how many frames it holds.
        attributes: what is stored beside it; of its layers the names alone.
        surface: whether it keeps heights.
        places: where its blocks lie in the grid; what lies in none was not observed.
        blocks: `(margin=0, within=None) -> Iterator[Block]`, blocks that together hold all that was observed, each
            column once, with as many columns around them; of those only the ones that touch the columns `within`.
        layers: `(columns) -> {name: array}`, the layers of the top-down map over a rectangle of the grid.
    """

    grid: GridSpec
    classes: tuple[str, ...]
    frames_fused: int
    attributes: MapAttributes
    surface: bool
    places: tuple[Columns, ...]
    blocks: Callable[..., Iterator[Block]]
    layers: Callable[[Columns], dict[str, Float[np.ndarray, "X Y"]]]

    @property
    def whole(self) -> Columns:
        """All columns of the grid."""
        return slice(0, self.grid.shape[0]), slice(0, self.grid.shape[1])

    def extent(self) -> Columns:
        """The smallest rectangle that holds all blocks; the whole grid where there is none."""
        if not self.places:
            return self.whole
        x, y = (
            slice(min(part.start for part in along), max(part.stop for part in along))
            for along in zip(*self.places, strict=True)
        )
        return x, y


def in_memory(voxel_map: VoxelMap, attributes: MapAttributes) -> MapReader:
    """A map that is in memory as one block."""
    whole = slice(0, voxel_map.grid.shape[0]), slice(0, voxel_map.grid.shape[1])
    count = int(voxel_map.frames_fused)

    def blocks(margin: int = 0, within: Columns | None = None) -> Iterator[Block]:
        yield Block(voxel_map, whole, (0, 0))

    def layers(place: Columns) -> dict[str, Float[np.ndarray, "X Y"]]:
        return {name: np.asarray(values)[place] for name, values in attributes.layers.items()}

    kept = voxel_map.surface is not None
    return MapReader(voxel_map.grid, voxel_map.classes, count, attributes, kept, (whole,), blocks, layers)


def touch(one: Columns, other: Columns) -> bool:
    """Whether two rectangles share a column."""
    return all(a.start < b.stop and b.start < a.stop for a, b in zip(one, other, strict=True))


def open_map(path: str | os.PathLike[str]) -> MapReader:
    """Opens a map of any size; only its attributes are read at once.

    Raises:
        JaxmapError: as `load_map`; a damaged tile is found when its block is read, and named.
    """
    target = Path(path)
    folder, arrays, stored = _opened(target)
    grid, classes, frames_fused, attributes = from_json(stored, target)
    array = arrays[LOG_ODDS]
    check_kind(array, LOG_ODDS, (1 + len(classes), *grid.shape), stored.get("chunks_stored"), target)
    counts, heights = chunk_counts(stored, target), arrays.get(SURFACE)
    if heights is not None:
        shape = (4, *grid.shape[:2], layer_count(grid.shape[2]))
        check_kind(heights, SURFACE, shape, counts.get(SURFACE), target)
    for name in attributes.layers:
        check_kind(present(arrays, name, target), name, grid.shape[:2], counts.get(name), target)

    edge = array.chunks[1:3]
    places = tuple(
        (slice(x, min(x + edge[0], grid.shape[0])), slice(y, min(y + edge[1], grid.shape[1])))
        for x, y in sorted({(tile[1] * edge[0], tile[2] * edge[1]) for tile in stored_chunks(folder / LOG_ODDS)})
    )

    def blocks(margin: int = 0, within: Columns | None = None) -> Iterator[Block]:
        for place in places:
            if within is not None and not touch(place, within):
                continue
            around = [
                slice(max(own.start - margin, 0), min(own.stop + margin, size))
                for own, size in zip(place, grid.shape, strict=False)
            ]
            log_odds = read_part(array, (slice(None), *around), target)
            first = np.asarray(grid.first) + np.array([around[0].start, around[1].start, 0])
            part = replace(grid, first=to_device(first, np.int32), shape=log_odds.shape[1:])
            x, y = (slice(a.start - b.start, a.stop - b.start) for a, b in zip(place, around, strict=True))
            surface = None
            if heights is not None:
                surface = jnp.asarray(read_part(heights, (slice(None), *around, slice(None)), target))
            count = to_device(frames_fused, np.int32)
            voxel_map = VoxelMap(jnp.asarray(log_odds), count, part, classes, surface=surface)
            yield Block(voxel_map, (x, y), (place[0].start, place[1].start))

    def layers(place: Columns) -> dict[str, Float[np.ndarray, "X Y"]]:
        return {name: read_part(arrays[name], place, target, finite=False) for name in attributes.layers}

    kept = heights is not None
    return MapReader(grid, classes, frames_fused, attributes, kept, places, blocks, layers)


def add_layers(
    path: str | os.PathLike[str],
    names: Sequence[str],
    parts: Iterable[tuple[Columns, Mapping[str, Float[np.ndarray, "X Y"]]]],
) -> None:
    """Adds layers to the top-down map of a stored map, part by part: they are there when all are written.

    Args:
        path: of the map.
        names: of the layers; those that are there are written anew.
        parts: rectangles of columns, of whole tiles, and the layers there; what is beyond the grid is left out.

    Raises:
        JaxmapError: the disk refuses; the map then is without them.
    """
    import zarr

    target = Path(path)
    try:
        group = zarr.open_group(target, mode="r+", zarr_format=3)
        stored = dict(group.attrs)
        grid, *_, attributes = from_json(stored, target)
        others = [name for name in attributes.layers if name not in names]
        counts = {name: count for name, count in chunk_counts(stored, target).items() if name not in names}
        group.update_attributes({"layers": others, "chunks_stored_of": counts})
        for name in names:
            shutil.rmtree(target / name, ignore_errors=True)
        arrays = {name: create_array(group, name, grid.shape[:2], LAYER_AXES, np.nan) for name in names}
        for place, layers in parts:
            for name, array in arrays.items():
                inside = tuple(slice(s.start, min(s.stop, size)) for s, size in zip(place, array.shape, strict=True))
                array[inside] = layers[name][tuple(slice(0, s.stop - s.start) for s in inside)]
        counts |= {name: len(stored_chunks(array_folder(array))) for name, array in arrays.items()}
        for name in names:
            sync_tree(target / name)
        group.update_attributes({"layers": [*others, *names], "chunks_stored_of": counts})
        sync(target / "zarr.json")
    except OSError as error:
        raise write_error(error, target) from error


def _read_layers(
    arrays: dict[str, zarr.Array], stored: dict[str, Any], grid: GridSpec, attributes: MapAttributes, where: Path
) -> None:
    counts = chunk_counts(stored, where)
    for name in attributes.layers:
        attributes.layers[name] = read_array(arrays, name, grid.shape[:2], counts.get(name), where)


def _arrays_of(voxel_map: VoxelMap, attributes: MapAttributes) -> dict[str, StoredArray]:
    """All that is stored of a map; no copies where the device is the CPU."""
    arrays = {LOG_ODDS: StoredArray(np.asarray(voxel_map.log_odds), AXES)}
    if voxel_map.members is not None:
        arrays[MEMBERS] = StoredArray(np.asarray(voxel_map.members), ("member", *AXES))
    if voxel_map.surface is not None:
        arrays[SURFACE] = StoredArray(np.asarray(voxel_map.surface), SURFACE_AXES)
    for name, values in attributes.layers.items():
        arrays[name] = StoredArray(np.asarray(values, np.float32), LAYER_AXES, fill_value=np.nan)
    return arrays


def _write_group(folder: Path, arrays: dict[str, StoredArray], stored: dict[str, Any]) -> None:
    import zarr

    group = zarr.create_group(folder, zarr_format=3)
    counts = {name: write_array(group, name, array) for name, array in arrays.items()}
    # Chunks of the fill value are not stored, so a lost chunk would read as that: their number is kept.
    stored["chunks_stored"] = counts.pop(LOG_ODDS)
    group.update_attributes(stored | ({"chunks_stored_of": counts} if counts else {}))


def swap_in(temporary: Path, target: Path) -> None:
    """Puts a map in the place of another, which is there, whole, until then."""
    aside = _set_aside(target)
    replaces = target.exists()
    if replaces:
        if aside.exists():
            shutil.rmtree(aside)
        os.rename(target, aside)
    try:
        os.rename(temporary, target)
    except OSError:
        if replaces:
            os.rename(aside, target)
        raise
    sync(target.parent)
    shutil.rmtree(aside, ignore_errors=True)


def _set_aside(target: Path) -> Path:
    return target.with_name(f".{target.name}.previous")


def _replaceable(target: Path) -> bool:
    return target.is_dir() and ((target / "zarr.json").exists() or not any(target.iterdir()))


def sync_tree(folder: Path) -> None:
    """Waits until all that is in a folder has reached the disk."""
    for parent, _, names in os.walk(folder):
        for name in names:
            sync(Path(parent, name))
        sync(Path(parent))
