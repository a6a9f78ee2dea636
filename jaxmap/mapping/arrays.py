"""The arrays of a map in a Zarr v3 group, tile by tile, and checked when they are read."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float32

from jaxmap.errors import JaxmapError
from jaxmap.host.files import check_regular
from jaxmap.host.memory import available_bytes
from jaxmap.mapping.attributes import FORMAT_VERSION, bad_attribute
from jaxmap.types import LAYER

if TYPE_CHECKING:
    import zarr

LOG_ODDS, AXES = "log_odds", ("channel", "x", "y", "z")
MEMBERS = "ensemble_log_odds"
"""The members of an ensemble: float32 (M, 2, X, Y, Z), occupancy and the class that is asked about."""

SURFACE = "surface"
"""Heights of the columns: float32 (4, X, Y, L), number of points, weight, mean height and sum of squares about it, of
each layer of the lattice that is as high as a tile."""
SURFACE_AXES = ("channel", "x", "y", "layer")

LAYER_AXES = ("x", "y")
"""Of the layers of the top-down map."""

TILE = (64, 64, LAYER)
"""Voxels along the edges of a tile, at most: a cube of 3.2 m with the usual voxels. Maps are stored tile by tile."""

_MOST_CHUNKS = 100_000
_MOST_FILES, _MOST_ATTRIBUTES_BYTES, _MOST_CHUNK_BYTES = 1_000_000, 64 << 20, 1 << 30


class StoredArray(NamedTuple):
    """An array and how it is stored: the names of its axes; chunks of nothing but the fill value are left out."""

    values: Float32[np.ndarray, "..."]
    axes: tuple[str, ...]
    fill_value: float = 0.0


def create_array(
    group: zarr.Group, name: str, shape: tuple[int, ...], axes: tuple[str, ...], fill_value: float = 0.0
) -> zarr.Array:
    """Creates an array of nothing but its fill value; a chunk is one tile with all its channels."""
    from zarr.codecs import ZstdCodec

    most = {"member": 1, "layer": 1, **dict(zip(("x", "y", "z"), TILE, strict=True))}
    return group.create_array(
        name,
        shape=shape,
        dtype="float32",
        chunks=tuple(min(size, most.get(axis, size)) for axis, size in zip(axes, shape, strict=True)),
        # Measured on sparse maps: smaller and twice as fast as Blosc; its checksum finds damaged chunks.
        compressors=ZstdCodec(level=1, checksum=True),
        fill_value=fill_value,
        dimension_names=axes,
    )


def write_array(group: zarr.Group, name: str, array: StoredArray) -> int:
    """Writes an array into a group, and returns how many of its chunks are stored."""
    values = array.values
    stored = create_array(group, name, values.shape, array.axes, array.fill_value)
    # One chunk a call: after a failed one nothing goes on writing in the background while we clean up.
    for corner in itertools.product(*(range(0, *pair) for pair in zip(stored.shape, stored.chunks, strict=True))):
        chunk = tuple(slice(start, start + size) for start, size in zip(corner, stored.chunks, strict=True))
        stored[chunk] = values[chunk]
    return len(stored_chunks(array_folder(stored)))


def read_array(
    arrays: Mapping[str, zarr.Array], name: str, shape: tuple[int, ...], chunks_stored: int | None, where: Path
) -> Float32[np.ndarray, "..."]:
    """Reads an array of a group.

    Args:
        arrays: of the group.
        name: which.
        shape: that it must have.
        chunks_stored: how many chunks it must have, None where that is not known.
        where: the group, for errors.

    Raises:
        JaxmapError: it is missing, of another shape or type, or a chunk is damaged or missing.
    """
    array = present(arrays, name, where)
    _check_form(array, name, where)
    check_kind(array, name, shape, chunks_stored, where)
    fix = "restore the folder from a copy or make the map again"
    try:
        return np.asarray(array[...])
    # The codec raises whatever it likes on damaged bytes.
    except Exception as error:
        raise JaxmapError(f"a chunk of {name} is damaged", where=where, fix=fix) from error


def present(arrays: Mapping[str, zarr.Array], name: str, where: Path) -> zarr.Array:
    """An array of a group.

    Raises:
        JaxmapError: it is missing.
    """
    if name not in arrays:
        raise JaxmapError(f"the array {name} is missing", where=where, fix="make the map again")
    return arrays[name]


def check_kind(array: zarr.Array, name: str, shape: tuple[int, ...], chunks_stored: int | None, where: Path) -> None:
    """Refuses an array of another shape or type than its map has, or that lacks chunks.

    Raises:
        JaxmapError: it is one.
    """
    if array.shape != shape or array.dtype != np.float32:
        raise JaxmapError(
            f"{name} is {array.dtype} {array.shape}, its attributes say float32 {shape}",
            where=where,
            fix="make the map again",
        )
    there = len(stored_chunks(array_folder(array)))
    if chunks_stored is not None and there != chunks_stored:
        raise JaxmapError(
            f"{there} of {chunks_stored} chunks of {name} are there",
            where=where,
            fix="restore the folder from a copy or make the map again",
        )


def _check_form(array: zarr.Array, name: str, where: Path) -> None:
    """Refuses an array that no memory holds, or whose chunks are so small that they take for ever.

    Raises:
        JaxmapError: it is one.
    """
    # A chunk is read whole, also where the array is smaller.
    count, free_bytes = max(math.prod(array.shape), math.prod(array.chunks)), available_bytes()
    if free_bytes is not None and 4 * count > free_bytes:
        raise JaxmapError(
            f"{name} of {' x '.join(map(str, array.shape))} takes {4 * count / 2**30:.3g} GiB, there are "
            f"{free_bytes / 2**30:.3g}",
            where=where,
            fix="read it on a larger machine, or make the map again",
        )
    chunks = math.prod(-(-size // max(edge, 1)) for size, edge in zip(array.shape, array.chunks, strict=True))
    if chunks > _MOST_CHUNKS or min(array.chunks, default=1) < 1:
        raise JaxmapError(
            f"{name} is stored in {chunks:,} chunks of {' x '.join(map(str, array.chunks))}",
            where=where,
            fix="restore the folder from a copy or make the map again",
        )


def array_folder(array: zarr.Array) -> Path:
    """Where an array lies on disk."""
    store: Any = array.store
    return Path(store.root, array.path)


def stored_chunks(folder: Path) -> list[tuple[int, ...]]:
    """The indices of the chunks of an array that are on disk."""
    # Zarr itself would try all that might be there, which in a large map are millions.
    files = [Path(parent, name) for parent, _, names in os.walk(folder / "c") for name in names]
    indices = [file.relative_to(folder / "c").parts for file in files]
    return [tuple(map(int, index)) for index in indices if all(part.isdecimal() for part in index)]


def read_part(
    array: zarr.Array, part: tuple[slice, ...], where: Path, *, finite: bool = True
) -> Float32[np.ndarray, "..."]:
    """Reads a part of an array.

    Raises:
        JaxmapError: a tile is damaged, or holds a number that is not finite where all should be.
    """
    try:
        values = np.asarray(array[part])
    # The codec raises whatever it likes on damaged bytes.
    except Exception as error:
        cut = [(s, edge) for s, edge in zip(part, array.chunks, strict=False) if s.stop is not None]
        tile = " ".join(str((s.start or 0) // edge) for s, edge in cut)
        raise JaxmapError(
            f"a chunk of {array.basename} is damaged, at or beside tile {tile}",
            where=where,
            fix="restore the folder from a copy or make the map again",
        ) from error
    if finite:
        check_finite(values, where)
    return values


def check_finite(log_odds: np.ndarray, where: Path) -> None:
    """Refuses log-odds that are no numbers.

    Raises:
        JaxmapError: some are not finite.
    """
    bad = sum(int(channel.size - np.isfinite(channel).sum()) for channel in log_odds)
    if bad:
        raise JaxmapError(
            f"{bad} of the log-odds are not finite numbers",
            where=where,
            fix="check the fusion parameters and map again",
        )


def _check_files(folder: Path, where: Path) -> None:
    """Refuses what is no folder of regular files: a pipe in place of a chunk would be waited for.

    Raises:
        JaxmapError: it is one, or its attributes are of absurd size.
    """
    fix = "restore the folder from a copy or make the map again"
    files = itertools.chain.from_iterable(
        [Path(parent, name) for name in names] for parent, _, names in os.walk(folder, followlinks=True)
    )
    for number, file in enumerate(files):
        if number > _MOST_FILES:
            raise JaxmapError(f"it holds more than {_MOST_FILES:,} files", where=where, fix=fix)
        check_regular(file, _MOST_ATTRIBUTES_BYTES if file.name == "zarr.json" else _MOST_CHUNK_BYTES)


def open_group(folder: Path, where: Path) -> tuple[dict[str, zarr.Array], dict[str, Any]]:
    """The arrays and the attributes of a stored map.

    Raises:
        JaxmapError: it is none, or was written by a newer version.
    """
    import zarr

    _check_files(folder, where)
    try:
        group = zarr.open_group(folder, mode="r", zarr_format=3)
        stored, members = dict(group.attrs), dict(group.arrays())
    # zarr answers a damaged group with errors of many kinds; all of them mean the same here.
    except Exception as error:
        raise JaxmapError(
            "not a jaxmap map: no readable Zarr group", where=where, fix="give a map.zarr folder of `jaxmap map`"
        ) from error
    version = stored.get("format_version")
    if isinstance(version, int) and version > FORMAT_VERSION:
        raise JaxmapError(
            f"written by a newer jaxmap: format {version}, this one reads {FORMAT_VERSION}",
            where=where,
            fix="upgrade jaxmap",
        )
    for name, there in (("attribute format_version", version is not None), ("array log_odds", LOG_ODDS in members)):
        if not there:
            raise JaxmapError(f"not a jaxmap map: no {name}", where=where, fix="give a map.zarr folder of `jaxmap map`")
    if version != FORMAT_VERSION:
        raise bad_attribute("format_version", version, where)
    return members, stored


def chunk_counts(stored: dict[str, Any], where: Path) -> dict[str, int]:
    """How many chunks of each array but the first were stored."""
    counts = stored.get("chunks_stored_of", {})
    if not (isinstance(counts, dict) and all(isinstance(count, int) for count in counts.values())):
        raise bad_attribute("chunks_stored_of", counts, where)
    return counts
