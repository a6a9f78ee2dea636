"""The descriptions in PyTorch's files, which are pickles, read without unpickling.

A pickle is a program. It is never given to Python's own reader: the stack machine below interprets only the few
instructions that describe dicts of tensors, and refuses by name every function or class that is not a tensor's.
Nothing is imported or called that the file asks for.

A small program can name one value twice, that pair twice, and so on: walking through such a value
(hashing, printing, copying) never ends. So only text and numbers are keys, only names are called,
and no list is copied that the file can name again.
"""

from __future__ import annotations

import math
import pickletools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, BinaryIO, NamedTuple

import numpy as np

MAX_AXES = 16

BFLOAT16 = "bf16"
"""NumPy has no such type: the upper half of a float32."""

_STORAGES = {
    "BFloat16Storage": BFLOAT16,
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
_BESIDE = {
    *("torch", "torchmetrics", "pytorch_lightning", "lightning", "lightning_fabric", "omegaconf", "numpy", "pathlib"),
    *("argparse", "collections", "datetime", "_codecs", "copyreg", "copy_reg"),
}
"""Modules whose values trainers keep beside the tensors (hyperparameters, states of schedulers)."""
_PLAIN_TYPES = ("list", "dict", "set", "frozenset", "tuple", "slice", "object", "int", "float", "str", "bytearray")

_FUNCTIONS = ("collections.OrderedDict", "torch._utils._rebuild_parameter", "torch._utils._rebuild_tensor_v2")
_MARK = object()
_BLANK = object()
"""Stands for any value that is neither a tensor nor plain; it is not made, whatever the file says of it."""


@dataclass(frozen=True)
class _Global:
    """A function or class that the file names."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


@dataclass(frozen=True)
class Storage:
    """The numbers of one or more tensors, not read yet."""

    key: str
    dtype: str
    count: int

    @property
    def item_bytes(self) -> int:
        """The size of a number in the file."""
        return 2 if self.dtype == BFLOAT16 else np.dtype(self.dtype).itemsize

    @property
    def bytes(self) -> int:
        """The size that the file declares."""
        return self.count * self.item_bytes


class Refused(Exception):
    """The file holds something other than a dict of tensors."""


@dataclass(frozen=True)
class StoredTensor:
    """A view of a storage, as the file describes it."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    def check(self) -> int:
        """The bytes it takes.

        Raises:
            Refused: it does not lie inside its storage.
        """
        whole = (*self.shape, *self.strides, self.offset)
        if not all(isinstance(value, int) and value >= 0 for value in whole) or len(self.shape) != len(self.strides):
            raise Refused("a tensor of impossible shape")
        count = math.prod(self.shape)
        last = self.offset + sum((n - 1) * step for n, step in zip(self.shape, self.strides, strict=True))
        if count and (last >= self.storage.count or count > self.storage.count):
            raise Refused(f"a tensor of shape {short(list(self.shape))} in a storage of fewer numbers")
        return count * self.storage.item_bytes


def short(value: object) -> str:
    """At most 80 characters of a value of the file; only for text, numbers and lists of numbers."""
    text = str(value)
    return text if len(text) <= 80 else f"{text[:80]}..."


def _call(function: object, arguments: object) -> object:
    """The results of the few functions that describe tensors."""
    if function is _BLANK:
        return _BLANK
    if not isinstance(function, _Global) or not isinstance(arguments, tuple):
        raise Refused("the file asks to call something that is no function")
    name = str(function)
    if name == "collections.OrderedDict" and not arguments:
        return {}
    if name == "torch._utils._rebuild_parameter" and arguments:
        return arguments[0]
    if name == "torch._utils._rebuild_tensor_v2" and len(arguments) >= 4:
        storage, offset, shape, strides = arguments[:4]
        if not isinstance(storage, Storage):
            raise Refused("a tensor without a storage")
        if not isinstance(shape, tuple) or not isinstance(strides, tuple) or len(shape) > MAX_AXES:
            raise Refused("a tensor of impossible shape")
        return StoredTensor(storage, offset, shape, strides)
    raise Refused(f"the file asks to call {name} in another way than PyTorch does, which is refused")


def _named(module: object, name: object) -> object:
    if not isinstance(module, str) or not isinstance(name, str):
        raise Refused("a name that is no text")
    found = _Global(module, name)
    if str(found) not in _FUNCTIONS and not (module == "torch" and name in _STORAGES):
        plain = module in ("builtins", "__builtin__") and name in _PLAIN_TYPES
        if plain or module.partition(".")[0] in _BESIDE:
            return _BLANK
        raise Refused(f"the file asks for {short(found)}, which is refused")
    return found


def _storage(identity: object) -> Storage:
    # Before PyTorch 1.6 a sixth element named the storage that this one is part of; it has long been None.
    if not isinstance(identity, tuple) or len(identity) not in (5, 6) or identity[0] != "storage":
        raise Refused("a reference that is no storage")
    if len(identity) == 6 and identity[5] is not None:
        raise Refused("a storage that is part of another")
    kind, key, count = identity[1], identity[2], identity[4]
    if not isinstance(kind, _Global) or kind.name not in _STORAGES:
        raise Refused("a reference that is no storage")
    if not isinstance(key, str) or not isinstance(count, int) or count < 0:
        raise Refused("a reference that is no storage")
    return Storage(key, _STORAGES[kind.name], count)


class Description(NamedTuple):
    """What a program describes, and every storage that it mentions."""

    content: object
    storages: list[Storage]


def interpret(program: bytes | BinaryIO) -> Description:
    """Runs the description of a dict of tensors on a stack of plain values; of a file, up to its end.

    Raises:
        Refused: it asks for anything else.
    """
    stack: list[Any] = []
    memo: dict[int, object] = {}
    storages: list[Storage] = []
    for opcode, argument, _ in pickletools.genops(program):
        name = opcode.name
        if name == "STOP":
            content = stack.pop()
            if content is _BLANK:
                raise Refused("the file holds an object in place of a dict of tensors, which is refused")
            return Description(content, storages)
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
        elif name == "BINPERSID":
            storages.append(_storage(stack.pop()))
            stack.append(storages[-1])
        elif name in _STACK_STEPS:
            _STACK_STEPS[name](stack)
        else:
            raise Refused(f"the file uses the pickle instruction {name}, which is refused")
    raise Refused("a description without an end")


def _popped(stack: list, count: int) -> list:
    values = stack[len(stack) - count :]
    del stack[len(stack) - count :]
    return values


def _since_mark(stack: list) -> list:
    values = _popped(stack, next(back for back, value in enumerate(reversed(stack)) if value is _MARK))
    stack.pop()
    return values


def _set_items(stack: list, values: list) -> None:
    if not all(isinstance(key, str | int | float) for key in values[::2]):
        raise Refused("a dict whose keys are neither text nor numbers")
    if stack[-1] is not _BLANK:
        stack[-1].update(zip(values[::2], values[1::2], strict=True))


def _extend(stack: list, values: list) -> None:
    if stack[-1] is not _BLANK:
        stack[-1].extend(values)


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
    "SETITEM": lambda stack: _set_items(stack, _popped(stack, 2)),
    "SETITEMS": lambda stack: _set_items(stack, _since_mark(stack)),
    "APPEND": lambda stack: _extend(stack, _popped(stack, 1)),
    "APPENDS": lambda stack: _extend(stack, _since_mark(stack)),
    "TUPLE": lambda stack: stack.append(tuple(_since_mark(stack))),
    "TUPLE1": lambda stack: stack.append(tuple(_popped(stack, 1))),
    "TUPLE2": lambda stack: stack.append(tuple(_popped(stack, 2))),
    "TUPLE3": lambda stack: stack.append(tuple(_popped(stack, 3))),
    "NEWOBJ": lambda stack: stack.append(_call(*_popped(stack, 2))),
    "REDUCE": lambda stack: stack.append(_call(*_popped(stack, 2))),
    "STACK_GLOBAL": lambda stack: stack.append(_named(*_popped(stack, 2))),
    # The state of an OrderedDict is PyTorch's version notes, which are no tensors.
    "BUILD": lambda stack: stack.pop(),
}
