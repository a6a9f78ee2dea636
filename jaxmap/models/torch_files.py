"""PyTorch's zip files of tensors, read without unpickling.

Such a zip holds `NAME/data.pkl`, a pickle that says which tensors there are, and `NAME/data/KEY`, their raw
numbers. A pickle is a program; here only the few instructions that describe dicts of tensors are
interpreted, by the stack machine below, and every function or class that is not a tensor's is refused by
its name. Nothing is imported or called that the file asks for.
"""

from __future__ import annotations

import pickletools
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxmap.errors import JaxmapError

MAX_PROGRAM_BYTES = 64 * 2**20
MAX_SHARING = 4

_STORAGES = {
    "DoubleStorage": "f8",
    "FloatStorage": "f4",
    "HalfStorage": "f2",
    "LongStorage": "i8",
    "IntStorage": "i4",
    "ShortStorage": "i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "?",
}
_WRAPPERS = ("state_dict", "model_state_dict", "model", "net", "network")
_ZIP_START = b"PK\x03\x04"
_MARK = object()


@dataclass(frozen=True)
class _Global:
    """A name that the file asks for."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


@dataclass(frozen=True)
class _Storage:
    """The numbers of one or more tensors, not read yet."""

    key: str
    dtype: str
    count: int


class _Refused(Exception):
    """The file holds what is no dict of tensors."""


def read_torch_zip(path: Path) -> dict[str, np.ndarray]:
    """The float tensors of a state dict, also where it lies under `state_dict` or `model`.

    Raises:
        JaxmapError: the file is missing, truncated, of the format before PyTorch 1.6, or holds
            anything but tensors and plain values.
    """
    if not path.is_file():
        raise JaxmapError("no such file", where=path, fix="give a .safetensors or .pth file of weights")
    with path.open("rb") as file:
        starts_as_zip = file.read(4) == _ZIP_START
    if not starts_as_zip:
        raise JaxmapError(
            "not the zip that PyTorch writes since 1.6",
            where=path,
            fix="convert it where PyTorch is installed: safetensors.torch.save_file(torch.load(FILE, "
            "weights_only=True), 'weights.safetensors')",
        )
    try:
        with zipfile.ZipFile(path) as archive:
            tensors = _read(archive)
    except _Refused as fault:
        raise JaxmapError(
            str(fault), where=path, fix="save only the state dict, best as safetensors: safetensors.torch.save_file"
        ) from fault
    except Exception as fault:
        # There is no end of what damaged bytes make the parsers raise.
        reason = " ".join(str(fault).split())[:120] or type(fault).__name__
        raise JaxmapError(f"a broken PyTorch file ({reason})", where=path, fix="copy or download it again") from fault
    if not tensors:
        raise JaxmapError("no tensors", where=path, fix="give the state dict of a network")
    return tensors


def _read(archive: zipfile.ZipFile) -> dict[str, np.ndarray]:
    programs = [name for name in archive.namelist() if name.endswith("data.pkl") and name.count("/") <= 1]
    if len(programs) != 1:
        raise _Refused("no data.pkl, so it is no PyTorch file")
    root = programs[0].removesuffix("data.pkl")
    order = ">" if _member(archive, f"{root}byteorder", 16, optional=True).strip() == b"big" else "<"
    content = _interpret(_member(archive, programs[0], MAX_PROGRAM_BYTES))
    if isinstance(content, dict):
        content = next((content[name] for name in _WRAPPERS if isinstance(content.get(name), dict)), content)
    if not isinstance(content, dict):
        raise _Refused("no dict of tensors")
    buffers: dict[str, np.ndarray] = {}
    tensors: dict[str, np.ndarray] = {}
    archive_sizes = [info.compress_size for info in archive.infolist()]
    for name, value in content.items():
        if isinstance(name, str) and isinstance(value, _Tensor) and "f" in value.storage.dtype:
            tensors[name] = _materialise(value, archive, root, order, buffers)
            # Tensors may share numbers, but not so that a small file fills the memory.
            if sum(tensor.nbytes for tensor in tensors.values()) > MAX_SHARING * sum(archive_sizes):
                raise _Refused("tensors that share their numbers many times over")
    return tensors


def _member(archive: zipfile.ZipFile, name: str, at_most: int, *, optional: bool = False) -> bytes:
    """A member of the zip; PyTorch stores them uncompressed, so nothing can grow while it is read."""
    try:
        info = archive.getinfo(name)
    except KeyError:
        if optional:
            return b""
        raise _Refused(f"{name} is missing") from None
    if info.compress_type != zipfile.ZIP_STORED or info.file_size > at_most:
        raise _Refused(f"{name} is compressed or too large")
    return archive.read(info)


@dataclass(frozen=True)
class _Tensor:
    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


def _materialise(
    tensor: _Tensor, archive: zipfile.ZipFile, root: str, order: str, buffers: dict[str, np.ndarray]
) -> np.ndarray:
    storage, dtype = tensor.storage, np.dtype(order + tensor.storage.dtype)
    if storage.key not in buffers:
        raw = _member(archive, f"{root}data/{storage.key}", storage.count * dtype.itemsize)
        if len(raw) != storage.count * dtype.itemsize:
            raise _Refused(f"storage {storage.key} holds {len(raw)} bytes, not {storage.count * dtype.itemsize}")
        buffers[storage.key] = np.frombuffer(raw, dtype)
    whole = [*tensor.shape, *tensor.strides, tensor.offset]
    if not all(isinstance(value, int) and value >= 0 for value in whole) or len(tensor.shape) != len(tensor.strides):
        raise _Refused("a tensor of impossible shape")
    last = tensor.offset + sum((n - 1) * step for n, step in zip(tensor.shape, tensor.strides, strict=True))
    count = 1
    for n in tensor.shape:
        count *= n
    if count and (last >= storage.count or count > storage.count):
        raise _Refused(f"a tensor of shape {list(tensor.shape)[:8]} in a storage of {storage.count} numbers")
    if not count:
        return np.zeros(tensor.shape, dtype.newbyteorder("="))
    strides = [step * dtype.itemsize for step in tensor.strides]
    view = np.lib.stride_tricks.as_strided(buffers[storage.key][tensor.offset :], tensor.shape, strides)
    return view.astype(dtype.newbyteorder("="))


def _call(function: object, arguments: tuple) -> object:
    """What the few functions do that a tensor's description needs."""
    name = str(function)
    if name == "collections.OrderedDict":
        return dict(*arguments)
    if name == "torch._utils._rebuild_parameter":
        return arguments[0]
    if name == "torch._utils._rebuild_tensor_v2":
        storage, offset, shape, strides = arguments[:4]
        if not isinstance(storage, _Storage):
            raise _Refused("a tensor without a storage")
        return _Tensor(storage, offset, tuple(shape), tuple(strides))
    raise _Refused(f"the file asks to call {name}, which is refused")


def _named(module: str, name: str) -> _Global:
    found = _Global(module, name)
    known = ("collections.OrderedDict", "torch._utils._rebuild_parameter", "torch._utils._rebuild_tensor_v2")
    if str(found) not in known and not (module == "torch" and name in _STORAGES):
        raise _Refused(f"the file asks for {found}, which is refused")
    return found


def _storage(identity: object) -> _Storage:
    if not isinstance(identity, tuple) or len(identity) != 5 or identity[0] != "storage":
        raise _Refused("a reference that is no storage")
    kind, key, count = identity[1], identity[2], identity[4]
    if not isinstance(kind, _Global) or not isinstance(key, str) or not isinstance(count, int) or count < 0:
        raise _Refused("a reference that is no storage")
    return _Storage(key, _STORAGES[kind.name], count)


def _interpret(program: bytes) -> object:
    """Runs the description of a dict of tensors on a stack of plain values."""
    stack: list[Any] = []
    memo: dict[int, object] = {}
    for opcode, argument, _ in pickletools.genops(program):
        name = opcode.name
        if name == "STOP":
            return stack.pop()
        if name in _IGNORED:
            continue
        if name in _PUSHED:
            stack.append(argument)
        elif name in _MADE:
            stack.append(_MADE[name]())
        elif name in ("BINPUT", "LONG_BINPUT", "PUT"):
            memo[int(argument)] = stack[-1]  # type: ignore[arg-type]
        elif name == "MEMOIZE":
            memo[len(memo)] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET", "GET"):
            stack.append(memo[int(argument)])  # type: ignore[arg-type]
        elif name == "GLOBAL":
            stack.append(_named(*str(argument).split(" ", 1)))
        elif name in _STACK_STEPS:
            _STACK_STEPS[name](stack)
        else:
            raise _Refused(f"the file uses the pickle instruction {name}, which is refused")
    raise _Refused("a description without an end")


def _since_mark(stack: list) -> list:
    index = len(stack) - 1 - next(back for back, value in enumerate(reversed(stack)) if value is _MARK)
    values = stack[index + 1 :]
    del stack[index:]
    return values


def _set_items(stack: list, values: list) -> None:
    stack[-1].update(zip(values[::2], values[1::2], strict=True))


def _set_item(stack: list) -> None:
    value, key = stack.pop(), stack.pop()
    _set_items(stack, [key, value])


def _tuple(stack: list, count: int) -> None:
    values = tuple(stack[len(stack) - count :])
    del stack[len(stack) - count :]
    stack.append(values)


def _reduce(stack: list) -> None:
    arguments, function = stack.pop(), stack.pop()
    stack.append(_call(function, arguments))


def _append(stack: list) -> None:
    value = stack.pop()
    stack[-1].append(value)


def _append_all(stack: list) -> None:
    values = _since_mark(stack)
    stack[-1].extend(values)


def _drop_state(stack: list) -> None:
    # The state of an OrderedDict is PyTorch's version notes, which say nothing of the tensors.
    stack.pop()


def _stack_global(stack: list) -> None:
    name, module = stack.pop(), stack.pop()
    stack.append(_named(module, name))


_IGNORED = {"PROTO", "FRAME"}
_PUSHED = {
    *("BINUNICODE", "SHORT_BINUNICODE", "UNICODE", "BINUNICODE8", "SHORT_BINSTRING", "BINSTRING"),
    *("BININT", "BININT1", "BININT2", "INT", "LONG", "LONG1", "BINFLOAT", "FLOAT"),
}
_MADE: dict[str, Callable[[], object]] = {
    "MARK": lambda: _MARK,
    "EMPTY_DICT": dict,
    "EMPTY_LIST": list,
    "EMPTY_TUPLE": tuple,
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
}
_STACK_STEPS: dict[str, Callable[[list], None]] = {
    "SETITEM": _set_item,
    "SETITEMS": lambda stack: _set_items(stack, _since_mark(stack)),
    "APPEND": _append,
    "APPENDS": _append_all,
    "TUPLE": lambda stack: stack.append(tuple(_since_mark(stack))),
    "TUPLE1": lambda stack: _tuple(stack, 1),
    "TUPLE2": lambda stack: _tuple(stack, 2),
    "TUPLE3": lambda stack: _tuple(stack, 3),
    "REDUCE": _reduce,
    "BINPERSID": lambda stack: stack.append(_storage(stack.pop())),
    "STACK_GLOBAL": _stack_global,
    "BUILD": _drop_state,
}
