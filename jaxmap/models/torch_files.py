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
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.models.torch_pickle import Refused, Storage, StoredTensor, interpret, short

MAX_PROGRAM_BYTES = 4 * 2**20
"""A description takes some 200 bytes for each tensor."""
MAX_SHARING = 4
"""Tensors may share numbers, but not so that a small file fills the memory."""

_WRAPPERS = ("state_dict", "model_state_dict", "model", "net", "network")
_ZIP_START = b"PK\x03\x04"
_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_VERSION = 1001

Tensors = dict[str, np.ndarray]


def read_torch_file(path: Path) -> Tensors:
    """The float tensors of a state dict, also where it lies under `state_dict` or `model`.

    Raises:
        JaxmapError: the file is missing, truncated, or holds anything but tensors and plain values.
    """
    if not path.is_file():
        raise JaxmapError("no such file", where=path, fix="give a .safetensors or .pth file of weights")
    try:
        with path.open("rb") as file:
            tensors = _read(file)
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


def _read(file: BinaryIO) -> Tensors:
    file_bytes = file.seek(0, os.SEEK_END)
    file.seek(0)
    start = file.read(len(_ZIP_START))
    file.seek(0)
    if start == _ZIP_START:
        with zipfile.ZipFile(file) as archive:
            return _read_zip(archive, file_bytes)
    return _read_legacy(file, file_bytes)


def _read_zip(archive: zipfile.ZipFile, file_bytes: int) -> Tensors:
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

    return _tensors(content, numbers, order, file_bytes)


def _read_legacy(file: BinaryIO, file_bytes: int) -> Tensors:
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
    return _tensors(content, lambda storage: buffers[storage.key], "<", file_bytes)


def _tensors(content: object, numbers: Callable[[Storage], bytes], order: str, file_bytes: int) -> Tensors:
    """The float tensors of what a program describes.

    Args:
        content: the description.
        numbers: gives the bytes of a storage.
        order: of the bytes of a number, as NumPy writes it.
        file_bytes: size of the file, which bounds that of the tensors.
    """
    if isinstance(content, dict):
        content = next((content[name] for name in _WRAPPERS if isinstance(content.get(name), dict)), content)
    if not isinstance(content, dict):
        raise Refused("no dict of tensors")
    tensors: Tensors = {}
    total = 0
    for name, value in content.items():
        if isinstance(name, str) and isinstance(value, StoredTensor) and "f" in value.storage.dtype:
            if (size := value.storage.bytes) > file_bytes:
                raise Refused(
                    f"storage {short(value.storage.key)} should hold {short(size)} bytes, the file is smaller"
                )
            total += value.check()
            if total > MAX_SHARING * file_bytes:
                raise Refused("tensors that share their numbers many times over")
            tensors[name] = _materialise(value, numbers, order)
    return tensors


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
    storage, dtype = tensor.storage, np.dtype(order + tensor.storage.dtype)
    if math.prod(tensor.shape) == 0:
        return np.zeros(tensor.shape, dtype.newbyteorder("="))
    content = numbers(storage)
    # Asked each time: the file may give one storage two sizes.
    if len(content) != storage.bytes:
        raise Refused(f"storage {short(storage.key)} holds {len(content)} bytes, not {short(storage.bytes)}")
    values = np.frombuffer(content, dtype)
    strides = [step * dtype.itemsize for step in tensor.strides]
    view = np.lib.stride_tricks.as_strided(values[tensor.offset :], tensor.shape, strides)
    return view.astype(dtype.newbyteorder("="))
