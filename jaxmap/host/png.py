"""Decoding of plain PNG pictures in half of Pillow's time: ISA-L inflates them, libspng undoes the filters.

Whatever is out of the ordinary is left to Pillow, damaged files among it: they are refused as they always were.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16
from PIL import ImageFile, PngImagePlugin

try:
    import pyspng
    from isal import isal_zlib
except ImportError:  # rare machines have neither
    isal_zlib = pyspng = None

_SAMPLES = {"L": 1, "I": 1, "RGB": 3, "RGBA": 4}
"""Of a pixel, by how Pillow calls the pixels in the file; ;16B follows where they have 16 bits."""
_MOST_PX = 2**24
"""Larger pictures are decoded by Pillow, which holds no more than the pixels at once."""
_HEADER_BYTES, _STORED_BYTES = 33, 65_535
"""Signature and first chunk of a PNG; the most that a block holds that is not compressed."""


def plain_png(
    picture: ImageFile.ImageFile, path: Path
) -> UInt8[np.ndarray, "H W *rgb"] | UInt16[np.ndarray, "H W *rgb"] | None:
    """The pixels of a PNG of 8 or 16 bits, grey, RGB or RGBA without its alpha; None for others and damaged ones.

    Args:
        picture: opened, not yet decoded.
        path: its file.
    """
    if isal_zlib is None or not isinstance(picture, PngImagePlugin.PngImageFile) or len(picture.tile) != 1:
        return None
    _, _, start, raw_mode = picture.tile[0]
    kind, _, deep = str(raw_mode).partition(";")
    if kind not in _SAMPLES or deep not in ("", "16B") or picture.info.get("interlace") or picture.is_animated:
        return None
    width, height = picture.size
    if width * height > _MOST_PX:
        return None
    row_bytes = 1 + width * _SAMPLES[kind] * (2 if deep else 1)
    data = path.read_bytes()
    try:
        inflating = isal_zlib.decompressobj()
        filtered = inflating.decompress(b"".join(_compressed(data, start)), height * row_bytes + 1)
        if not inflating.eof or len(filtered) != height * row_bytes:
            return None
        pixels = pyspng.load(_uncompressed(data[:_HEADER_BYTES], filtered))
    except (isal_zlib.error, EOFError, RuntimeError, struct.error):
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


def _uncompressed(header: bytes, filtered: bytes) -> bytes:
    """A PNG of these rows, not compressed: its decoder has nothing left to do but to undo their filters."""
    view, parts = memoryview(filtered), [b"\x78\x01"]
    for start in range(0, len(filtered), _STORED_BYTES):
        block = view[start : start + _STORED_BYTES]
        last = start + len(block) == len(filtered)
        parts += [struct.pack("<BHH", last, len(block), len(block) ^ 0xFFFF), block]
    parts.append(struct.pack(">I", isal_zlib.adler32(filtered)))
    return b"".join([header, *_chunk(b"IDAT", *parts), *_chunk(b"IEND")])


def _chunk(name: bytes, *parts: bytes | memoryview) -> list[bytes | memoryview]:
    checksum = 0
    for part in (name, *parts):
        checksum = isal_zlib.crc32(part, checksum)
    return [struct.pack(">I", sum(map(len, parts))), name, *parts, struct.pack(">I", checksum)]
