"""PyTorch's files of tensors, read without unpickling.

Since 1.6 PyTorch writes a zip that holds `NAME/data.pkl`, a pickle that describes the tensors, and `NAME/data/KEY`,
their raw numbers. Before, it wrote five pickles (a magic number, the version, facts about the machine, the
description, the keys of the storages) and after them, for each key, how many numbers there are and the numbers.
"""

from __future__ import annotations

import io
import math
import os
import struct
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.models.torch_pickle import BFLOAT16, Refused, Storage, StoredTensor, interpret, short

MAX_PROGRAM_BYTES = 4 * 2**20
"""A description takes some 200 bytes for each tensor."""
MAX_SHARING = 4
"""Tensors may share numbers, but not so that a small file fills the memory."""

MAX_NESTING = 6
MAX_VALUES = 200_000
MAX_NAME = 500
_ZIP_START = b"PK\x03\x04"
_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_VERSION = 1001

Tensors = dict[str, np.ndarray]
Choose = Callable[[Mapping[str, int]], Mapping[str, str]]
"""The file's names of the tensors to read by those to give them, from the number of numbers of all of them."""


def all_of(sizes: Mapping[str, int]) -> Mapping[str, str]:
    """All tensors under their own names."""
    return {name: name for name in sizes}


def read_torch_file(path: Path, choose: Choose = all_of) -> Tensors:
    """The float tensors of a state dict, or of dicts within dicts.

    Args:
        path: the file.
        choose: which to read, given how many numbers each has; names in nested dicts are joined by dots.

    Raises:
        JaxmapError: the file is missing, truncated, or holds anything but tensors and plain values.
    """
    if not path.is_file():
        raise JaxmapError("no such file", where=path, fix="give a .safetensors or .pth file of weights")
    try:
        with path.open("rb") as file:
            tensors = _read(file, choose)
    except Refused as fault:
        raise JaxmapError(
            str(fault), where=path, fix="save only the state dict, best as safetensors: safetensors.torch.save_file"
        ) from fault
    except OSError as fault:
        raise JaxmapError(f"cannot be read ({fault.strerror or fault})", where=path, fix="check the file") from fault
    except Exception as fault:
        # Damaged bytes make the parsers raise any exception.
        reason = " ".join(str(fault)[:1000].split())[:120] or type(fault).__name__
        raise JaxmapError(f"a broken PyTorch file ({reason})", where=path, fix="copy or download it again") from fault
    if not tensors:
        raise JaxmapError("no tensors", where=path, fix="give the state dict of a network")
    return tensors


def _read(file: BinaryIO, choose: Choose) -> Tensors:
    file_bytes = file.seek(0, os.SEEK_END)
    file.seek(0)
    start = file.read(len(_ZIP_START))
    file.seek(0)
    if start == _ZIP_START:
        with zipfile.ZipFile(file) as archive:
            return _read_zip(archive, file_bytes, choose)
    return _read_legacy(file, file_bytes, choose)


def _read_zip(archive: zipfile.ZipFile, file_bytes: int, choose: Choose) -> Tensors:
    if sum(info.compress_size for info in archive.infolist()) > file_bytes:
        raise Refused("members that are larger than the file, or share its bytes")
    programs = [name for name in archive.namelist() if name.endswith("data.pkl") and name.count("/") <= 1]
    if len(programs) != 1:
        raise Refused("no data.pkl, so it is no PyTorch file")
    root = programs[0].removesuffix("data.pkl")
    order = ">" if _member(archive, f"{root}byteorder", 16, optional=True).strip() == b"big" else "<"
    content = interpret(_member(archive, programs[0], MAX_PROGRAM_BYTES)).content
    buffers: dict[str, bytes] = {}

    def numbers(storage: Storage) -> bytes:
        if storage.key not in buffers:
            buffers[storage.key] = _member(archive, f"{root}data/{storage.key}", storage.bytes)
        return buffers[storage.key]

    return _tensors(content, numbers, order, file_bytes, choose)


def _read_legacy(file: BinaryIO, file_bytes: int, choose: Choose) -> Tensors:
    programs = io.BytesIO(file.read(MAX_PROGRAM_BYTES))
    try:
        magic = interpret(programs).content
    except Exception as fault:
        raise Refused("no file of PyTorch's") from fault
    if magic != _LEGACY_MAGIC or interpret(programs).content != _LEGACY_VERSION:
        raise Refused("no file of PyTorch's")
    interpret(programs)  # Sizes of C's types where it was written, which do not matter: numbers are little-endian.
    content, storages = interpret(programs)
    keys = interpret(programs).content
    file.seek(programs.tell())
    sizes: dict[str, Storage] = {}
    for storage in storages:
        if sizes.setdefault(storage.key, storage) != storage:
            raise Refused(f"storage {short(storage.key)} has two sizes")
    if not isinstance(keys, list) or not all(isinstance(key, str) for key in keys) or sorted(keys) != sorted(sizes):
        raise Refused("a list of storages that is not that of the tensors")
    buffers: dict[str, bytes] = {}
    for key in keys:
        (count,) = struct.unpack("<q", file.read(8))
        size, left = sizes[key].bytes, file_bytes - file.tell()
        if count != sizes[key].count:
            raise Refused(f"storage {short(key)} should hold {short(size)} bytes, the file says otherwise")
        if size > left:
            raise ValueError(f"storage {short(key)} should hold {short(size)} bytes, {left} are left")
        buffers[key] = file.read(size)
    if file.tell() != file_bytes:
        raise Refused("bytes after the last storage")
    return _tensors(content, lambda storage: buffers[storage.key], "<", file_bytes, choose)


def _tensors(
    content: object, numbers: Callable[[Storage], bytes], order: str, file_bytes: int, choose: Choose
) -> Tensors:
    """The chosen float tensors of what a program describes.

    Args:
        content: the description.
        numbers: gives the bytes of a storage.
        order: of the bytes of a number, as NumPy writes it.
        file_bytes: size of the file, which bounds that of the tensors.
        choose: which are read.
    """
    if not isinstance(content, dict):
        raise Refused("no dict of tensors")
    described = dict(_described(content))
    for value in described.values():
        if (size := value.storage.bytes) > file_bytes:
            raise Refused(f"storage {short(value.storage.key)} should hold {short(size)} bytes, the file is smaller")
    sizes = {name: value.check() // value.storage.item_bytes for name, value in described.items()}
    chosen = choose(sizes)
    if sum(described[name].check() for name in chosen.values()) > MAX_SHARING * file_bytes:
        raise Refused("tensors that share their numbers many times over")
    return {ours: _materialise(described[name], numbers, order) for ours, name in chosen.items()}


def _described(content: dict) -> Iterator[tuple[str, StoredTensor]]:
    """The float tensors of a dict and of those within it; a file may name one dict many times over."""
    left, seen = [("", content, 0)], 0
    while left:
        prefix, values, depth = left.pop()
        seen += len(values)
        if seen > MAX_VALUES:
            raise Refused("dicts within dicts of more values than a network has")
        for name, value in values.items():
            if isinstance(name, str) and len(name) > MAX_NAME:
                raise Refused(f"a name of {len(name)} letters")
            if isinstance(value, StoredTensor) and "f" in value.storage.dtype:
                yield f"{prefix}{name}", value
            elif isinstance(value, dict) and depth < MAX_NESTING:
                left.append((f"{prefix}{name}.", value, depth + 1))


def _member(archive: zipfile.ZipFile, name: str, at_most: int, *, optional: bool = False) -> bytes:
    """A member of the zip; PyTorch stores them uncompressed, so nothing can grow while it is read."""
    try:
        info = archive.getinfo(name)
    except KeyError:
        if optional:
            return b""
        raise Refused(f"{short(name)} is missing") from None
    if info.compress_type != zipfile.ZIP_STORED or info.file_size > at_most:
        raise Refused(f"{short(name)} is compressed or too large")
    return archive.read(info)


def _materialise(tensor: StoredTensor, numbers: Callable[[Storage], bytes], order: str) -> np.ndarray:
    """The numbers of a tensor that has been checked."""
    storage = tensor.storage
    if math.prod(tensor.shape) == 0:
        return np.zeros(tensor.shape, _numbers(b"", storage.dtype, order).dtype)
    content = numbers(storage)
    # Asked each time: the file may give one storage two sizes.
    if len(content) != storage.bytes:
        raise Refused(f"storage {short(storage.key)} holds {len(content)} bytes, not {short(storage.bytes)}")
    values = _numbers(content, storage.dtype, order)
    strides = [step * values.itemsize for step in tensor.strides]
    return np.lib.stride_tricks.as_strided(values[tensor.offset :], tensor.shape, strides).copy()


def _numbers(content: bytes, dtype: str, order: str) -> np.ndarray:
    if dtype == BFLOAT16:
        return from_bfloat16(np.frombuffer(content, f"{order}u2"))
    return np.frombuffer(content, order + dtype).astype(np.dtype(dtype), copy=False)


def from_bfloat16(bits: np.ndarray) -> np.ndarray:
    """float32 of the bits of bfloat16, which are its upper half."""
    return (bits.astype(np.uint32) << 16).view(np.float32)
