"""PyTorch's zip files of tensors, read without unpickling.

Such a zip holds `NAME/data.pkl`, a pickle that says which tensors there are, and `NAME/data/KEY`, their raw
numbers. The pickle is never given to Python's own reader: see `torch_program`.
"""

from __future__ import annotations

import math
import zipfile
from pathlib import Path

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.models.torch_program import Refused, StoredTensor, interpret, short

MAX_PROGRAM_BYTES = 4 * 2**20
"""A description takes some 200 bytes for each tensor."""
MAX_SHARING = 4
"""Tensors may share numbers, but not so that a small file fills the memory."""

_WRAPPERS = ("state_dict", "model_state_dict", "model", "net", "network")
_ZIP_START = b"PK\x03\x04"


def read_torch_zip(path: Path) -> dict[str, np.ndarray]:
    """The float tensors of a state dict, also where it lies under `state_dict` or `model`.

    Raises:
        JaxmapError: the file is missing, truncated, of the format before PyTorch 1.6, or holds
            anything but tensors and plain values.
    """
    if not path.is_file():
        raise JaxmapError("no such file", where=path, fix="give a .safetensors or .pth file of weights")
    try:
        with path.open("rb") as file:
            starts_as_zip = file.read(4) == _ZIP_START
    except OSError as fault:
        raise JaxmapError(f"cannot be read ({fault.strerror or fault})", where=path, fix="check the file") from fault
    if not starts_as_zip:
        raise JaxmapError(
            "not the zip that PyTorch writes since 1.6",
            where=path,
            fix="convert it where PyTorch is installed: safetensors.torch.save_file(torch.load(FILE, "
            "weights_only=True), 'weights.safetensors')",
        )
    try:
        with zipfile.ZipFile(path) as archive:
            tensors = _read(archive, path.stat().st_size)
    except Refused as fault:
        raise JaxmapError(
            str(fault), where=path, fix="save only the state dict, best as safetensors: safetensors.torch.save_file"
        ) from fault
    except Exception as fault:
        # There is no end of what damaged bytes make the parsers raise.
        reason = " ".join(str(fault)[:1000].split())[:120] or type(fault).__name__
        raise JaxmapError(f"a broken PyTorch file ({reason})", where=path, fix="copy or download it again") from fault
    if not tensors:
        raise JaxmapError("no tensors", where=path, fix="give the state dict of a network")
    return tensors


def _read(archive: zipfile.ZipFile, file_bytes: int) -> dict[str, np.ndarray]:
    if sum(info.compress_size for info in archive.infolist()) > file_bytes:
        raise Refused("members that are larger than the file, or share its bytes")
    programs = [name for name in archive.namelist() if name.endswith("data.pkl") and name.count("/") <= 1]
    if len(programs) != 1:
        raise Refused("no data.pkl, so it is no PyTorch file")
    root = programs[0].removesuffix("data.pkl")
    order = ">" if _member(archive, f"{root}byteorder", 16, optional=True).strip() == b"big" else "<"
    content = interpret(_member(archive, programs[0], MAX_PROGRAM_BYTES))
    if isinstance(content, dict):
        content = next((content[name] for name in _WRAPPERS if isinstance(content.get(name), dict)), content)
    if not isinstance(content, dict):
        raise Refused("no dict of tensors")
    buffers: dict[str, bytes] = {}
    tensors: dict[str, np.ndarray] = {}
    total = 0
    for name, value in content.items():
        if isinstance(name, str) and isinstance(value, StoredTensor) and "f" in value.storage.dtype:
            if (size := value.storage.bytes) > file_bytes:
                raise Refused(
                    f"storage {short(value.storage.key)} is said to hold {short(size)} bytes, the file is smaller"
                )
            total += value.check()
            if total > MAX_SHARING * file_bytes:
                raise Refused("tensors that share their numbers many times over")
            tensors[name] = _materialise(value, archive, root, order, buffers)
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


def _materialise(
    tensor: StoredTensor, archive: zipfile.ZipFile, root: str, order: str, buffers: dict[str, bytes]
) -> np.ndarray:
    """The numbers of a tensor that has been checked."""
    storage, dtype = tensor.storage, np.dtype(order + tensor.storage.dtype)
    if math.prod(tensor.shape) == 0:
        return np.zeros(tensor.shape, dtype.newbyteorder("="))
    size = storage.bytes
    if storage.key not in buffers:
        buffers[storage.key] = _member(archive, f"{root}data/{storage.key}", size)
    # Asked each time: the file may give one storage two sizes.
    if len(buffers[storage.key]) != size:
        raise Refused(f"storage {short(storage.key)} holds {len(buffers[storage.key])} bytes, not {short(size)}")
    numbers = np.frombuffer(buffers[storage.key], dtype)
    strides = [step * dtype.itemsize for step in tensor.strides]
    view = np.lib.stride_tricks.as_strided(numbers[tensor.offset :], tensor.shape, strides)
    return view.astype(dtype.newbyteorder("="))
