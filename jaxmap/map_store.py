"""Maps on disk: a Zarr v3 group that is replaced as a whole, and checked when it is read.

A map is written beside its place, synced, and swapped in by renames; the one before it waits aside
until then. A process that dies at any moment leaves one of the two to load.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxmap.errors import JaxmapError
from jaxmap.files import sync, write_error
from jaxmap.types import GridSpec, VoxelMap

if TYPE_CHECKING:
    import zarr

FORMAT_VERSION = 1
_ARRAY = "log_odds"
_CHUNK_VOXELS = 128


@dataclass(frozen=True, eq=False)
class MapAttributes:
    """What a map folder holds beside the map itself.

    Attributes:
        crs: name of the coordinate reference system of `site_origin`, such as "EPSG:32631".
        site_origin: where the world's origin lies in that system, metres.
        T_world_source: turns the world of the poses' source into the map's z-up world.
        fusion: the parameters and the rule the map was fused with; JSON values only.
        progress: how far the run got; `{"complete": True}` once it has ended.
    """

    crs: str | None = None
    site_origin: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    T_world_source: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    fusion: dict[str, Any] = field(default_factory=dict)
    progress: dict[str, Any] = field(default_factory=lambda: {"complete": True})


def save_map(path: str | os.PathLike[str], voxel_map: VoxelMap, attributes: MapAttributes) -> None:
    """Writes a map, replacing the one that is there in one step.

    Raises:
        JaxmapError: the disk is full or refuses, the path holds something else, or the map is not finite;
            whatever was at `path` is still there.
    """
    target = Path(path)
    # No copy where the device is the CPU.
    log_odds = np.asarray(voxel_map.log_odds)
    _check_finite(log_odds, target)
    temporary = target.with_name(f".{target.name}.new-{os.getpid()}")
    try:
        if target.exists() and not _replaceable(target):
            raise JaxmapError(
                "something that is no map is in the way", where=target, fix="move it or name another output"
            )
        target.parent.mkdir(parents=True, exist_ok=True)
        for stray in target.parent.glob(f".{target.name}.new-*"):
            shutil.rmtree(stray)
        _write_group(temporary, log_odds, _to_json(voxel_map, attributes))
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


def load_map(path: str | os.PathLike[str]) -> tuple[VoxelMap, MapAttributes]:
    """Reads a map; where a save was cut off between its renames, the map from before it.

    Raises:
        JaxmapError: there is no map, it was written by a newer version, its parts disagree, a chunk is
            damaged or missing, or a number is not finite.
    """
    target = Path(path)
    folder = target if target.exists() else _set_aside(target)
    if not folder.exists():
        raise JaxmapError("no such map", where=target, fix="give a map.zarr folder of `jaxmap map`")
    array, stored = _open_group(folder, target)
    grid, classes, frames_fused, attributes = _from_json(stored, target)
    expected = (1 + len(classes), *grid.shape)
    if array.shape != expected or array.dtype != np.float32:
        raise JaxmapError(
            f"log_odds is {array.dtype} {array.shape}, its attributes say float32 {expected}",
            where=target,
            fix="make the map again",
        )
    log_odds = _read_chunks(array, stored.get("chunks_stored"), target)
    _check_finite(log_odds, target)
    voxel_map = VoxelMap(
        log_odds=jnp.asarray(log_odds), frames_fused=jnp.asarray(frames_fused, jnp.int32), grid=grid, classes=classes
    )
    return voxel_map, attributes


def _write_group(folder: Path, log_odds: np.ndarray, stored: dict[str, Any]) -> None:
    import zarr
    from zarr.codecs import ZstdCodec

    group = zarr.create_group(folder, zarr_format=3)
    array = group.create_array(
        _ARRAY,
        shape=log_odds.shape,
        dtype="float32",
        chunks=(1, *(min(size, _CHUNK_VOXELS) for size in log_odds.shape[1:])),
        # Measured on sparse maps: smaller and twice as fast as Blosc; its checksum finds damaged chunks.
        compressors=ZstdCodec(level=1, checksum=True),
        fill_value=0.0,
        dimension_names=("channel", "x", "y", "z"),
    )
    # One chunk a call: after a failed one nothing goes on writing in the background while we clean up.
    for corner in itertools.product(*(range(0, *pair) for pair in zip(array.shape, array.chunks, strict=True))):
        chunk = tuple(slice(start, start + size) for start, size in zip(corner, array.chunks, strict=True))
        array[chunk] = log_odds[chunk]
    # Chunks of zeros are not stored, so a lost chunk would read as zeros: their number tells.
    group.update_attributes({**stored, "chunks_stored": array.nchunks_initialized})


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


def _open_group(folder: Path, where: Path) -> tuple[zarr.Array, dict[str, Any]]:
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
    for name, there in (("attribute format_version", version is not None), ("array log_odds", _ARRAY in members)):
        if not there:
            raise JaxmapError(f"not a jaxmap map: no {name}", where=where, fix="give a map.zarr folder of `jaxmap map`")
    if version != FORMAT_VERSION:
        raise _bad_attribute("format_version", version, where)
    return members[_ARRAY], stored


def _read_chunks(array: zarr.Array, chunks_stored: int | None, where: Path) -> np.ndarray:
    fix = "restore the folder from a copy or make the map again"
    if chunks_stored is not None and array.nchunks_initialized != chunks_stored:
        raise JaxmapError(f"{array.nchunks_initialized} of {chunks_stored} chunks are there", where=where, fix=fix)
    try:
        return np.asarray(array[...])
    # The codec raises whatever it likes on damaged bytes.
    except Exception as error:
        raise JaxmapError("a chunk of log_odds is damaged", where=where, fix=fix) from error


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
    }
    return json.loads(json.dumps(stored))


def _from_json(stored: dict[str, Any], where: Path) -> tuple[GridSpec, tuple[str, ...], int, MapAttributes]:
    try:
        classes = stored["classes"]
        if not (isinstance(classes, list) and all(isinstance(name, str) for name in classes)):
            raise _bad_attribute("classes", classes, where)
        size_m = _numbers(stored, "voxel_size_m", (3,), where)
        shape = _numbers(stored, "shape", (3,), where)
        if (size_m <= 0).any() or (shape < 1).any() or (shape % 1).any():
            raise _bad_attribute("voxel_size_m or shape", [size_m.tolist(), shape.tolist()], where)
        grid = GridSpec(
            origin_m=jnp.asarray(_numbers(stored, "origin_m", (3,), where), jnp.float32),
            voxel_size_m=jnp.asarray(size_m, jnp.float32),
            shape=(int(shape[0]), int(shape[1]), int(shape[2])),
        )
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
        )
        return grid, tuple(classes), int(_numbers(stored, "frames_fused", (), where)), attributes
    except KeyError as missing:
        raise JaxmapError(f"the attribute {missing} is missing", where=where, fix="make the map again") from missing


def _numbers(stored: dict[str, Any], name: str, shape: tuple[int, ...], where: Path) -> np.ndarray:
    value = stored[name]
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise _bad_attribute(name, value, where) from error
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise _bad_attribute(name, value, where)
    return numbers


def _bad_attribute(name: str, value: object, where: Path) -> JaxmapError:
    return JaxmapError(f"the attribute {name} is {value!r}", where=where, fix="make the map again")
