"""Maps on disk: a Zarr v3 group that is replaced as a whole, and checked when it is read.

A map is written beside its place, synced, and swapped in by renames; the one before it waits aside
until then. A process that dies at any moment leaves one of the two to load.
"""

from __future__ import annotations

import itertools
import json
import math
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32

from jaxmap.errors import JaxmapError
from jaxmap.host.files import check_regular, sync, write_error
from jaxmap.host.memory import most_memory_bytes
from jaxmap.types import GridSpec, VoxelMap, to_device

if TYPE_CHECKING:
    import zarr

_CHUNK_CELLS, _MOST_CHUNKS = 128, 100_000
_MOST_FILES, _MOST_ATTRIBUTES_BYTES, _MOST_CHUNK_BYTES = 1_000_000, 64 << 20, 1 << 30
_MOST_FRAMES, _MOST_CLASSES = 2**31 - 1, 254
_VOXEL_M, _FARTHEST = (1e-6, 1e3), float(2**31)


class StoredArray(NamedTuple):
    """An array and how it is stored: the names of its axes; chunks of nothing but the fill value are left out."""

    values: Float32[np.ndarray, "..."]
    axes: tuple[str, ...]
    fill_value: float = 0.0


def write_array(group: zarr.Group, name: str, array: StoredArray) -> int:
    """Writes an array into a group, and returns how many of its chunks are stored."""
    from zarr.codecs import ZstdCodec

    values = array.values
    stored = group.create_array(
        name,
        shape=values.shape,
        dtype="float32",
        chunks=tuple(
            min(size, _CHUNK_CELLS) if axis in ("x", "y", "z") else 1
            for axis, size in zip(array.axes, values.shape, strict=True)
        ),
        # Measured on sparse maps: smaller and twice as fast as Blosc; its checksum finds damaged chunks.
        compressors=ZstdCodec(level=1, checksum=True),
        fill_value=array.fill_value,
        dimension_names=array.axes,
    )
    # One chunk a call: after a failed one nothing goes on writing in the background while we clean up.
    for corner in itertools.product(*(range(0, *pair) for pair in zip(stored.shape, stored.chunks, strict=True))):
        chunk = tuple(slice(start, start + size) for start, size in zip(corner, stored.chunks, strict=True))
        stored[chunk] = values[chunk]
    return stored.nchunks_initialized


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
    if name not in arrays:
        raise JaxmapError(f"the array {name} is missing", where=where, fix="make the map again")
    array = arrays[name]
    _check_form(array, name, where)
    if array.shape != shape or array.dtype != np.float32:
        raise JaxmapError(
            f"{name} is {array.dtype} {array.shape}, its attributes say float32 {shape}",
            where=where,
            fix="make the map again",
        )
    fix = "restore the folder from a copy or make the map again"
    if chunks_stored is not None and array.nchunks_initialized != chunks_stored:
        raise JaxmapError(
            f"{array.nchunks_initialized} of {chunks_stored} chunks of {name} are there", where=where, fix=fix
        )
    try:
        return np.asarray(array[...])
    # The codec raises whatever it likes on damaged bytes.
    except Exception as error:
        raise JaxmapError(f"a chunk of {name} is damaged", where=where, fix=fix) from error


def _check_form(array: zarr.Array, name: str, where: Path) -> None:
    """Refuses an array that no memory holds, or whose chunks are so small that they take for ever.

    Raises:
        JaxmapError: it is one.
    """
    # A chunk is read whole, also where the array is smaller.
    count, most_bytes = max(math.prod(array.shape), math.prod(array.chunks)), most_memory_bytes()
    if 4 * count > most_bytes:
        raise JaxmapError(
            f"{name} of {' x '.join(map(str, array.shape))} takes {4 * count / 2**30:.3g} GiB, this machine has "
            f"{most_bytes / 2**30:.3g}",
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


FORMAT_VERSION = 1
LOG_ODDS = "log_odds"
MEMBERS = "ensemble_log_odds"
"""The members of an ensemble: float32 (M, 2, X, Y, Z), occupancy and the class that is asked about."""


@dataclass(frozen=True, eq=False)
class MapAttributes:
    """What a map folder holds beside the map itself.

    Attributes:
        crs: name of the coordinate reference system of `site_origin`, such as "EPSG:32631".
        site_origin: where the world's origin lies in that system, metres.
        T_world_source: turns the world of the poses' source into the map's z-up world.
        fusion: the parameters and the rule the map was fused with; JSON values only.
        progress: how far the run got; `{"complete": True}` once it has ended.
        layers: other layers of the top-down map, by name; NaN where nothing is known.
    """

    crs: str | None = None
    site_origin: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    T_world_source: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    fusion: dict[str, Any] = field(default_factory=dict)
    progress: dict[str, Any] = field(default_factory=lambda: {"complete": True})
    layers: dict[str, Float[np.ndarray, "X Y"]] = field(default_factory=dict)


def save_map(path: str | os.PathLike[str], voxel_map: VoxelMap, attributes: MapAttributes) -> None:
    """Writes a map, replacing the one that is there in one step.

    Raises:
        JaxmapError: the disk is full or refuses, the path holds something else, or the map is not finite;
            whatever was at `path` is still there.
    """
    target = Path(path)
    arrays = _arrays_of(voxel_map, attributes)
    for name in (LOG_ODDS, MEMBERS):
        if name in arrays:
            _check_finite(arrays[name].values, target)
    temporary = target.with_name(f".{target.name}.new-{os.getpid()}")
    try:
        if target.exists() and not _replaceable(target):
            raise JaxmapError(
                "something that is no map is in the way", where=target, fix="move it or name another output"
            )
        target.parent.mkdir(parents=True, exist_ok=True)
        for stray in target.parent.glob(f".{target.name}.new-*"):
            shutil.rmtree(stray)
        _write_group(temporary, arrays, _to_json(voxel_map, attributes))
        _sync_tree(temporary)
        _swap_in(temporary, target)
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
    folder = target if target.exists() else _set_aside(target)
    if not folder.exists():
        raise JaxmapError("no such map", where=target, fix="give a map.zarr folder of `jaxmap map`")
    _check_files(folder, target)
    arrays, stored = _open_group(folder, target)
    grid, classes, frames_fused, attributes = _from_json(stored, target)
    log_odds = read_array(arrays, LOG_ODDS, (1 + len(classes), *grid.shape), stored.get("chunks_stored"), target)
    _check_finite(log_odds, target)
    counts = _chunk_counts(stored, target)
    for name in attributes.layers:
        attributes.layers[name] = read_array(arrays, name, grid.shape[:2], counts.get(name), target)
    ensemble = None
    if members and MEMBERS in arrays:
        shape = (arrays[MEMBERS].shape[0], 2, *grid.shape)
        ensemble = read_array(arrays, MEMBERS, shape, counts.get(MEMBERS), target)
        _check_finite(ensemble, target)
    voxel_map = VoxelMap(
        log_odds=jnp.asarray(log_odds),
        frames_fused=to_device(frames_fused, np.int32),
        grid=grid,
        classes=classes,
        members=None if ensemble is None else jnp.asarray(ensemble),
    )
    return voxel_map, attributes


def _arrays_of(voxel_map: VoxelMap, attributes: MapAttributes) -> dict[str, StoredArray]:
    """All that is stored of a map; no copies where the device is the CPU."""
    arrays = {LOG_ODDS: StoredArray(np.asarray(voxel_map.log_odds), ("channel", "x", "y", "z"))}
    if voxel_map.members is not None:
        arrays[MEMBERS] = StoredArray(np.asarray(voxel_map.members), ("member", "channel", "x", "y", "z"))
    for name, values in attributes.layers.items():
        arrays[name] = StoredArray(np.asarray(values, np.float32), ("x", "y"), fill_value=np.nan)
    return arrays


def _write_group(folder: Path, arrays: dict[str, StoredArray], stored: dict[str, Any]) -> None:
    import zarr

    group = zarr.create_group(folder, zarr_format=3)
    counts = {name: write_array(group, name, array) for name, array in arrays.items()}
    # Chunks of the fill value are not stored, so a lost chunk would read as that: their number is kept.
    stored["chunks_stored"] = counts.pop(LOG_ODDS)
    group.update_attributes(stored | ({"chunks_stored_of": counts} if counts else {}))


def _swap_in(temporary: Path, target: Path) -> None:
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


def _sync_tree(folder: Path) -> None:
    for parent, _, names in os.walk(folder):
        for name in names:
            sync(Path(parent, name))
        sync(Path(parent))


def _check_finite(log_odds: np.ndarray, where: Path) -> None:
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


def _open_group(folder: Path, where: Path) -> tuple[dict[str, zarr.Array], dict[str, Any]]:
    import zarr

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
        raise _bad_attribute("format_version", version, where)
    return members, stored


def _chunk_counts(stored: dict[str, Any], where: Path) -> dict[str, int]:
    """How many chunks of each array but the first were stored."""
    counts = stored.get("chunks_stored_of", {})
    if not (isinstance(counts, dict) and all(isinstance(count, int) for count in counts.values())):
        raise _bad_attribute("chunks_stored_of", counts, where)
    return counts


def _to_json(voxel_map: VoxelMap, attributes: MapAttributes) -> dict[str, Any]:
    # float32 numbers are exact as float64, and JSON keeps every digit of those.
    stored = {
        "format_version": FORMAT_VERSION,
        "classes": list(voxel_map.classes),
        "voxel_size_m": np.asarray(voxel_map.grid.voxel_size_m, np.float64).tolist(),
        "origin_m": np.asarray(voxel_map.grid.origin_m, np.float64).tolist(),
        "shape": list(voxel_map.grid.shape),
        "crs": attributes.crs,
        "site_origin": np.asarray(attributes.site_origin, np.float64).tolist(),
        "T_world_source": np.asarray(attributes.T_world_source, np.float64).tolist(),
        "frames_fused": int(voxel_map.frames_fused),
        "fusion": attributes.fusion,
        "progress": attributes.progress,
        **({"layers": list(attributes.layers)} if attributes.layers else {}),
    }
    return json.loads(json.dumps(stored))


def _from_json(stored: dict[str, Any], where: Path) -> tuple[GridSpec, tuple[str, ...], int, MapAttributes]:
    try:
        classes = stored["classes"]
        names = isinstance(classes, list) and all(isinstance(name, str) for name in classes)
        if not names or len(classes) > _MOST_CLASSES:
            raise _bad_attribute("classes", classes, where)
        size_m = _numbers(stored, "voxel_size_m", (3,), where)
        shape = _numbers(stored, "shape", (3,), where)
        if not _within(size_m, *_VOXEL_M) or not _within(shape, 1, 2**31) or (shape % 1).any():
            raise _bad_attribute("voxel_size_m or shape", [size_m.tolist(), shape.tolist()], where)
        grid = GridSpec(
            origin_m=to_device(_numbers(stored, "origin_m", (3,), where), np.float32),
            voxel_size_m=to_device(size_m, np.float32),
            shape=(int(shape[0]), int(shape[1]), int(shape[2])),
        )
        frames_fused = _numbers(stored, "frames_fused", (), where)
        if not _within(frames_fused, 0, _MOST_FRAMES) or frames_fused % 1:
            raise _bad_attribute("frames_fused", stored["frames_fused"], where)
        crs, fusion, progress = stored["crs"], stored["fusion"], stored.get("progress", {"complete": True})
        for name, value, kind in (("crs", crs, str | None), ("fusion", fusion, dict), ("progress", progress, dict)):
            if not isinstance(value, kind):
                raise _bad_attribute(name, value, where)
        attributes = MapAttributes(
            crs=crs,
            site_origin=_numbers(stored, "site_origin", (3,), where),
            T_world_source=_numbers(stored, "T_world_source", (4, 4), where),
            fusion=fusion,
            progress=progress,
            layers=dict.fromkeys(_layer_names(stored, where), np.zeros((0, 0), np.float32)),
        )
        return grid, tuple(classes), int(frames_fused), attributes
    except KeyError as missing:
        raise JaxmapError(f"the attribute {missing} is missing", where=where, fix="make the map again") from missing


def _within(numbers: np.ndarray, least: float, most: float) -> bool:
    return bool(((numbers >= least) & (numbers <= most)).all())


def _layer_names(stored: dict[str, Any], where: Path) -> list[str]:
    names = stored.get("layers", [])
    if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
        raise _bad_attribute("layers", names, where)
    return names


def _numbers(stored: dict[str, Any], name: str, shape: tuple[int, ...], where: Path) -> np.ndarray:
    value = stored[name]
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise _bad_attribute(name, value, where) from error
    if numbers.shape != shape or not _within(numbers, -_FARTHEST, _FARTHEST):
        raise _bad_attribute(name, value, where)
    return numbers


def _bad_attribute(name: str, value: object, where: Path) -> JaxmapError:
    return JaxmapError(f"the attribute {name} is {value!r:.100}", where=where, fix="make the map again")
