"""PyTorch's present form of a file, written without PyTorch: a pickle of a description, and raw numbers."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

_STORAGES = {"float32": "FloatStorage", "float16": "HalfStorage", "float64": "DoubleStorage", "int64": "LongStorage"}
_STORAGES |= {"uint16": "BFloat16Storage"}


def bfloat16(values: np.ndarray) -> np.ndarray:
    """The upper halves of float32, which `write_torch` writes as bfloat16."""
    return (np.ascontiguousarray(values, np.float32).view(np.uint32) >> 16).astype(np.uint16)


def write_torch(path: Path, content: dict) -> Path:
    """Writes a dict of arrays, plain values and dicts of them, as `torch.save` does; uint16 stands for bfloat16."""
    storages: list[np.ndarray] = []
    program = b"\x80\x02" + _described(content, storages) + b"."
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("archive/data.pkl", program)
        archive.writestr("archive/byteorder", "little")
        for key, values in enumerate(storages):
            archive.writestr(f"archive/data/{key}", values.tobytes())
    return path


def _described(value: object, storages: list[np.ndarray]) -> bytes:
    if isinstance(value, dict):
        pairs = (_described(key, storages) + _described(item, storages) for key, item in value.items())
        return b"}(" + b"".join(pairs) + b"u"
    if isinstance(value, np.ndarray):
        return _tensor(value, storages)
    if isinstance(value, bytes):  # A program of its own.
        return value
    return _word(str(value)) if isinstance(value, str) else _number(int(value))  # type: ignore[call-overload]


def _tensor(values: np.ndarray, storages: list[np.ndarray]) -> bytes:
    storages.append(values)
    kind = f"ctorch\n{_STORAGES[values.dtype.name]}\n".encode()
    key = _word(str(len(storages) - 1))
    reference = b"(" + _word("storage") + kind + key + _word("cpu") + _number(values.size) + b"tQ"
    strides = [step // values.itemsize for step in values.strides]
    view = _number(0) + _tuple(values.shape) + _tuple(strides)
    return b"ctorch._utils\n_rebuild_tensor_v2\n(" + reference + view + b"\x89ccollections\nOrderedDict\n)RtR"


def _tuple(numbers: object) -> bytes:
    return b"(" + b"".join(map(_number, numbers)) + b"t"  # type: ignore[arg-type]


def _word(text: str) -> bytes:
    return b"X" + len(text.encode()).to_bytes(4, "little") + text.encode()


def _number(value: int) -> bytes:
    return b"\x8a\x08" + value.to_bytes(8, "little", signed=True)
