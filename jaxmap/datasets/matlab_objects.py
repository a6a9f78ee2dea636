"""The structs inside MATLAB objects, which `scipy.io` does not open.

A MAT file keeps the contents of its objects in a hidden variable, which is a stream of elements in
the format of MAT files themselves (version 5: "MAT-File Format", The MathWorks). A class that saves
itself as a struct, such as `stereoParameters`, leaves that struct in the stream with all its names.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxmap.errors import JaxmapError

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Storage types of elements."""

_MATRIX, _CELL, _STRUCT, _CHAR, _OPAQUE = 14, 1, 2, 4, 17
_NUMERIC = range(6, 16)
_HEADER = 8
_MAX_DEPTH = 16


def structs_of_objects(stream: bytes, where: object) -> list[dict[str, Any]]:
    """All structs of a `__function_workspace__`, in their order: name -> array, text or None.

    Arrays have their MATLAB shape; what is neither numbers nor text is None.

    Raises:
        JaxmapError: the stream is damaged.
    """
    if len(stream) < _HEADER or stream[2:4] not in (b"IM", b"MI"):
        raise JaxmapError("the objects in the file cannot be read", where=where, fix="save them as plain structs")
    order = "<" if stream[2:4] == b"IM" else ">"
    found: list[dict[str, Any]] = []
    try:
        for kind, data in _elements(stream[_HEADER:], order):
            if kind == _MATRIX:
                _value(data, order, found, 0)
    except (struct.error, ValueError, IndexError, UnicodeDecodeError) as fault:
        raise JaxmapError(
            f"the objects in the file are damaged ({fault})", where=where, fix="restore the file"
        ) from fault
    return found


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Type and content of each element."""
    position = 0
    while position + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, position)
        if kind >> 16:
            # Small elements hold size and type in one word, and up to four bytes in the next.
            yield kind & 0xFFFF, data[position + 4 : position + 4 + (kind >> 16)]
            position += 8
            continue
        if position + 8 + size > len(data):
            raise ValueError("an element is cut off")
        yield kind, data[position + 8 : position + 8 + size]
        position += 8 + (size + 7) // 8 * 8


def _value(data: bytes, order: str, found: list[dict[str, Any]], depth: int) -> Any:
    """The value of a matrix element; structs in it are added to `found`."""
    if depth > _MAX_DEPTH:
        raise ValueError("nested too deep")
    parts = [*_elements(data, order)]
    if not parts:
        return None
    flags = int.from_bytes(parts[0][1][:4], "little" if order == "<" else "big")
    array_class = flags & 0xFF
    if array_class == _OPAQUE:
        # Names of type and class, then what the object was made from.
        for kind, inner in parts[1:]:
            if kind == _MATRIX:
                _value(inner, order, found, depth + 1)
        return None
    shape = np.frombuffer(parts[1][1], f"{order}i4")
    if array_class == _CELL:
        for _, inner in parts[3:]:
            _value(inner, order, found, depth + 1)
    elif array_class == _STRUCT:
        # Names lie in one text, each padded to the length that the element before it tells.
        width = int(np.frombuffer(parts[3][1], f"{order}i4")[0])
        text = parts[4][1]
        names = [text[at : at + width].split(b"\0")[0].decode("ascii") for at in range(0, len(text), max(width, 1))]
        whole: dict[str, Any] = {}
        found.append(whole)
        whole |= {
            name: _value(inner, order, found, depth + 1) for name, (_, inner) in zip(names, parts[5:], strict=False)
        }
    elif array_class == _CHAR:
        kind, raw = parts[3]
        return raw.decode(f"utf-16-{'le' if order == '<' else 'be'}" if kind in (4, 17) else "utf-8", "replace")
    elif array_class in _NUMERIC and len(parts) > 3:
        kind, raw = parts[3]
        return np.frombuffer(raw, order + _NUMBERS.get(kind, "u1")).reshape(shape, order="F")
    return None
