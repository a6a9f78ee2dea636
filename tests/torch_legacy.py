"""Files as PyTorch wrote them before 1.6, made by hand: pickles one after the other, then the numbers."""

from __future__ import annotations

import io
import pickle
import struct
import sys
from collections import OrderedDict
from types import ModuleType
from unittest import mock

import numpy as np

MAGIC, VERSION = 0x1950A86A20F9469CFC6C, 1001
MACHINE = {"protocol_version": VERSION, "little_endian": True, "type_sizes": {"short": 2, "int": 4, "long": 4}}


def _global(name: str, module: str) -> object:
    """A name for the pickle, as if the module were PyTorch's."""
    made = type(name, (), {}) if name.endswith("Storage") else lambda *_: None
    made.__module__, made.__name__, made.__qualname__ = module, name, name
    return made


FLOATS = _global("FloatStorage", "torch")
REBUILD = _global("_rebuild_tensor_v2", "torch._utils")


class _View:
    """A tensor that pickles as PyTorch's do."""

    def __init__(self, key: str, array: np.ndarray) -> None:
        self.key, self.array = key, array

    def __reduce__(self):
        strides = tuple(step // self.array.itemsize for step in self.array.strides)
        return REBUILD, (_Numbers(self.key, self.array.size), 0, self.array.shape, strides, False, OrderedDict())


class _Numbers:
    """The storage of a tensor."""

    def __init__(self, key: str, count: int) -> None:
        self.key, self.count = key, count


class _Pickler(pickle.Pickler):
    def persistent_id(self, obj):
        return ("storage", FLOATS, obj.key, "cpu", obj.count, None) if isinstance(obj, _Numbers) else None


def legacy_bytes(
    tensors: dict[str, np.ndarray],
    *,
    magic: object = MAGIC,
    version: object = VERSION,
    keys: list | None = None,
    counts: dict[str, int] | None = None,
    content: object = None,
) -> bytes:
    """The file of a state dict of contiguous float32 tensors; the other arguments make it a damaged one."""
    named = {name: str(1000 + place) for place, name in enumerate(tensors)}
    state = OrderedDict((name, _View(named[name], array)) for name, array in tensors.items())
    file = io.BytesIO()
    torch, utils = ModuleType("torch"), ModuleType("torch._utils")
    torch.FloatStorage, utils._rebuild_tensor_v2 = FLOATS, REBUILD  # type: ignore[attr-defined]
    with mock.patch.dict(sys.modules, {"torch": torch, "torch._utils": utils}):
        for part in (magic, version, MACHINE, state if content is None else content):
            _Pickler(file, 2).dump(part)
    pickle.dump(sorted(named.values()) if keys is None else keys, file, 2)
    for key, array in sorted((named[name], array) for name, array in tensors.items()):
        file.write(struct.pack("<q", (counts or {}).get(key, array.size)) + array.tobytes(order="K"))
    return file.getvalue()
