"""Reading the tensors of weight files, which are not trusted."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.models.file_kinds import kind_of_weights
from jaxmap.models.torch_files import Choose, Tensors, all_of, from_bfloat16, read_torch_file

_FLOATS = {"F16": np.float16, "F32": np.float32, "F64": np.float64}
_BFLOAT16 = "BF16"
_TORCH_SUFFIXES = (".pth", ".pt", ".bin", ".ckpt", ".tar")
_INDEX = ".index.json"
_MAX_INDEX_BYTES = 2**25


def read_tensors(path: Path, choose: Choose = all_of) -> Tensors:
    """Tensors of a `.safetensors` file or of one of PyTorch's (`.pth`, `.pt`, `.bin`, `.ckpt`), by name.

    Large networks come in shards: an index (`model.safetensors.index.json`), one of its shards, or the folder of both
    stands for all of them.

    Args:
        path: the file, index or folder.
        choose: which to read, as of `read_torch_file`.

    Raises:
        JaxmapError: a file is missing, truncated, of another kind, or asks for more than tensors.
    """
    index = _index_of(path)
    if index is None:
        return _read_one(path, choose)
    # Of a shard, all is read: what a network is can be told from the names of all of them.
    tensors: Tensors = {}
    for shard in _shards(index):
        tensors |= _read_one(shard, all_of)
    return {ours: tensors[name] for ours, name in choose({name: v.size for name, v in tensors.items()}).items()}


def _read_one(path: Path, choose: Choose) -> Tensors:
    kind = kind_of_weights(path)
    if kind == "torch" or (kind == "unknown" and path.suffix.lower() in _TORCH_SUFFIXES):
        return read_torch_file(path, choose)
    tensors = read_safetensors(path)[1]
    return {ours: tensors[name] for ours, name in choose({name: v.size for name, v in tensors.items()}).items()}


def _index_of(path: Path) -> Path | None:
    """The index of the shards that a path stands for; None where it is a file of its own."""
    if path.name.endswith(_INDEX):
        return path
    shard = "-of-" in path.name and path.suffix.lower() in (".safetensors", ".bin")
    folder = path if path.is_dir() else path.parent if shard else None
    found = [] if folder is None else sorted(folder.glob(f"*{_INDEX}"))
    # A folder may hold a network in both formats.
    return min(found, key=lambda index: "safetensors" not in index.name) if found else None


def _shards(index: Path) -> list[Path]:
    """The files that an index names.

    Raises:
        JaxmapError: it is no index, or shards are missing.
    """
    try:
        if index.stat().st_size > _MAX_INDEX_BYTES:
            raise ValueError("it is too large")
        places = json.loads(index.read_text(encoding="utf-8"))["weight_map"]
        names = sorted({str(name) for name in places.values()})
        if not names or any(Path(name).name != name for name in names):
            raise ValueError("weight_map does not name files beside it")
    except FileNotFoundError as fault:
        raise JaxmapError("no such file", where=index, fix="check the path") from fault
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as fault:
        reason = f"{type(fault).__name__}: {' '.join(str(fault).split())[:100]}"
        raise JaxmapError(f"no index of shards ({reason})", where=index, fix="download it again") from fault
    missing = [name for name in names if not (index.parent / name).is_file()]
    if missing:
        raise JaxmapError(
            f"{len(missing)} of {len(names)} shards are missing: {shortened(missing)}",
            where=index,
            fix="download them beside it",
        )
    return [index.parent / name for name in names]


def read_safetensors(path: Path) -> tuple[dict[str, str], Tensors]:
    """Metadata and tensors of a safetensors file; integer tensors (counters) are left out, bfloat16 becomes float32.

    The library compares every declared shape and offset with the size of the file before it
    allocates anything.

    Raises:
        JaxmapError: the file is missing, truncated or not safetensors, or a tensor is of another
            type than a float of 16, 32 or 64 bits.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise JaxmapError("no such file", where=path, fix="give a .safetensors or .pth file of weights")
    try:
        with safe_open(path, framework="numpy") as file:
            types = {name: file.get_slice(name).get_dtype() for name in file.keys()}  # noqa: SIM118
            known = {*_FLOATS, _BFLOAT16}
            wrong = [f"{name} is {kind}" for name, kind in types.items() if kind not in known and kind[0] not in "IU"]
            if wrong:
                raise JaxmapError(
                    f"tensors of a type that is not read: {shortened(wrong)}",
                    where=path,
                    fix="save the weights as float32",
                )
            tensors = {name: file.get_tensor(name) for name, kind in types.items() if kind in _FLOATS}
            metadata = dict(file.metadata() or {})
        return metadata, tensors | _bfloat16_tensors(path, types)
    except (SafetensorError, ValueError, MemoryError) as fault:
        # NumPy has its own limits: a tensor of more than 64 axes is well-formed, but no array.
        raise JaxmapError(
            f"not a whole safetensors file ({' '.join(str(fault).split())[:120]})",
            where=path,
            fix="it may be truncated: copy or download it again",
        ) from fault
    except OSError as fault:
        raise JaxmapError(f"cannot be read ({fault.strerror or fault})", where=path, fix="check the file") from fault


def _bfloat16_tensors(path: Path, types: Mapping[str, str]) -> Tensors:
    """Those of a type that NumPy has not, from the bytes of the file, whose header the library has checked."""
    if _BFLOAT16 not in types.values():
        return {}
    from safetensors import deserialize

    return {
        name: from_bfloat16(np.frombuffer(stored["data"], "<u2")).reshape(stored["shape"])
        for name, stored in deserialize(path.read_bytes())
        if stored["dtype"] == _BFLOAT16
    }


def shortened(items: Sequence[str], at_most: int = 3, length: int = 100) -> str:
    """The first of them, each cut to `length`, and how many more there are."""
    more = f" and {len(items) - at_most} more" if len(items) > at_most else ""
    return ", ".join(item if len(item) <= length else f"{item[:length]}..." for item in items[:at_most]) + more


def as_float32(array: np.ndarray) -> np.ndarray:
    """The array in float32; what is too large for it becomes infinite, and is reported with what is not finite."""
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array, np.float32)
