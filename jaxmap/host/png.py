"""Decoding of plain PNG pictures in half of Pillow's time: ISA-L inflates them, libspng undoes the filters.

Whatever is out of the ordinary is left to Pillow, damaged files among it: they are refused as they always were.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyspng
from isal import isal_zlib
from jaxtyping import UInt8, UInt16
from PIL import ImageFile, PngImagePlugin

_KINDS = {"L": (0, 1), "I": (0, 1), "RGB": (2, 3), "RGBA": (6, 4)}
"""Type of the colours and samples of a pixel, by how Pillow calls the pixels in the file; ;16B follows for 16 bits."""
_MOST_PX = 2**24
"""Larger pictures are decoded by Pillow, which holds no more than the pixels at once."""
_STORED_BYTES = 65_535
"""The most that a block holds that is not compressed."""


def plain_png(
    picture: ImageFile.ImageFile, path: Path
) -> UInt8[np.ndarray, "H W *rgb"] | UInt16[np.ndarray, "H W *rgb"] | None:
    """The pixels of a PNG of 8 or 16 bits, grey, RGB or RGBA without its alpha; None for others and damaged ones.

    Args:
        picture: opened, not yet decoded.
        path: its file.
    """
    if not isinstance(picture, PngImagePlugin.PngImageFile) or len(picture.tile) != 1:
        return None
    _, _, start, raw_mode = picture.tile[0]
    kind, _, deep = str(raw_mode).partition(";")
    if kind not in _KINDS or deep not in ("", "16B") or picture.info.get("interlace") or picture.is_animated:
        return None
    width, height = picture.size
    if width * height > _MOST_PX:
        return None
    bits, (colours, samples) = 16 if deep else 8, _KINDS[kind]
    expected_bytes = height * (1 + width * samples * bits // 8)
    data = path.read_bytes()
    try:
        inflating = isal_zlib.decompressobj()
        rows = inflating.decompress(b"".join(_compressed(data, start)), expected_bytes + 1)
        if not inflating.eof or len(rows) != expected_bytes:
            return None
        header = struct.pack(">IIBBBBB", width, height, bits, colours, 0, 0, 0)
        pixels = pyspng.load(_uncompressed(header, rows))
    except Exception:  # of either library; Pillow says what is wrong
        return None
    if pixels.ndim == 3:
        # Alpha goes, which libspng also gives to pixels of 16 bits that have none.
        pixels = pixels[..., :3] if kind.startswith("RGB") else pixels[..., 0]
    return np.ascontiguousarray(pixels)


def _compressed(data: bytes, start: int) -> Iterator[memoryview]:
    """The contents of the chunks that hold pixels, the first of which begins there."""
    view, start = memoryview(data), start - 8
    while data[start + 4 : start + 8] == b"IDAT":
        (length,) = struct.unpack_from(">I", data, start)
        yield view[start + 8 : start + 8 + length]
        start += length + 12


def _uncompressed(header: bytes, rows: bytes) -> bytes:
    """A PNG of these rows, not compressed: its decoder has nothing left to do but to undo their filters."""
    view, parts = memoryview(rows), [b"\x78\x01"]
    for start in range(0, len(rows), _STORED_BYTES):
        block = view[start : start + _STORED_BYTES]
        last = start + len(block) == len(rows)
        parts += [struct.pack("<BHH", last, len(block), len(block) ^ 0xFFFF), block]
    parts.append(struct.pack(">I", isal_zlib.adler32(rows)))
    chunks = (*_chunk(b"IHDR", header), *_chunk(b"IDAT", *parts), *_chunk(b"IEND"))
    return b"".join((b"\x89PNG\r\n\x1a\n", *chunks))


def _chunk(name: bytes, *parts: bytes | memoryview) -> list[bytes | memoryview]:
    checksum = 0
    for part in (name, *parts):
        checksum = isal_zlib.crc32(part, checksum)
    return [struct.pack(">I", sum(map(len, parts))), name, *parts, struct.pack(">I", checksum)]
