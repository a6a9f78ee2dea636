"""Opening pictures: a few formats, named here, and a size that is bounded before anything is decoded.

Pillow picks a decoder by a file's content and knows dozens, one of which starts Ghostscript. So every picture of the
package is opened here, and a test sees to it.
"""

from __future__ import annotations

import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import (
    BmpImagePlugin,
    ExifTags,
    ImageFile,
    JpegImagePlugin,
    PngImagePlugin,
    PpmImagePlugin,
    TiffImagePlugin,
    WebPImagePlugin,
)

from jaxmap.errors import FrameError, JaxmapError

FORMATS = "PNG, JPEG, TIFF, BMP, PGM, PPM or WebP"

MAX_PX = 2**27
"""Pixels of the largest picture that is decoded whole: 512 MiB in colour, as Pillow holds it."""

_KINDS: dict[bytes, type[ImageFile.ImageFile]] = {
    b"\x89PNG\r\n\x1a\n": PngImagePlugin.PngImageFile,
    b"\xff\xd8\xff": JpegImagePlugin.JpegImageFile,
    **dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), TiffImagePlugin.TiffImageFile),
    b"BM": BmpImagePlugin.BmpImageFile,
    **dict.fromkeys((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6"), PpmImagePlugin.PpmImageFile),
    b"RIFF": WebPImagePlugin.WebPImageFile,
}


@contextmanager
def open_picture(path: Path, noun: str = "image", *, max_px: int | None = MAX_PX) -> Iterator[ImageFile.ImageFile]:
    """Opens a picture of one of `FORMATS`; nothing is decoded before the block asks for it.

    Args:
        path: a regular file.
        noun: what errors call it.
        max_px: a picture that declares more pixels is refused; None where it is not decoded here.

    Raises:
        FrameError: no such file, none of these formats, too large, or, from the block, anything that a decoder raised.
    """
    # On damaged files Pillow's decoders raise nearly anything.
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise OSError("no regular file")
        with path.open("rb") as file:
            yield _identified(file, path, noun, max_px)
    except JaxmapError:
        raise
    except FileNotFoundError as fault:
        raise FrameError(f"the {noun} is missing", where=path, fix="restore the file") from fault
    except MemoryError as fault:
        raise FrameError(f"the {noun} takes more memory than there is", where=path, fix="give a smaller one") from fault
    except Exception as fault:
        reason = str(fault) or type(fault).__name__
        raise FrameError(
            f"the {noun} cannot be read ({reason})", where=path, fix="replace it by a whole one of 8 or 16 bits"
        ) from fault


def _identified(file, path: Path, noun: str, max_px: int | None) -> ImageFile.ImageFile:
    start = file.read(16)
    file.seek(0)
    kind = next((kind for magic, kind in _KINDS.items() if start.startswith(magic)), None)
    if kind is None or (start.startswith(b"RIFF") and start[8:12] != b"WEBP"):
        raise FrameError("not an image of a known format", where=path, fix=f"give {FORMATS}")
    picture = kind(file)
    width, height = picture.size
    if max_px is not None and width * height > max_px:
        raise FrameError(
            f"the {noun} is {width}x{height} px, more than the {max_px / 1e6:.0f} million that are read at once",
            where=path,
            fix="give it smaller, or in tiles",
        )
    return picture


def raw_mode(picture: ImageFile.ImageFile) -> str:
    """How the pixels of a picture not yet decoded lie in its file, in Pillow's words, such as `RGB;16B`."""
    arguments = picture.tile[0][3] if picture.tile else ""
    return str(arguments[0] if isinstance(arguments, tuple) else arguments)


class Turn(NamedTuple):
    """How a picture is to be turned, taken before it is decoded.

    Attributes:
        tag: the EXIF orientation, 1 to 8; 1 where there is none or an invalid one.
        done: whether decoding applies it, as Pillow and OpenCV do for TIFF.
    """

    tag: int
    done: bool


def turn_of(picture: ImageFile.ImageFile) -> Turn:
    """The turn of a picture not yet decoded."""
    tag = 1
    # A PNG's tags may follow its pixels, and asking for them would decode these.
    if "exif" in picture.info or not isinstance(picture, PngImagePlugin.PngImageFile):
        # What damaged tags raise is as open as above, and the pixels may be whole.
        with suppress(Exception):
            tag = picture.getexif().get(ExifTags.Base.Orientation, 1)
    return Turn(tag if tag in range(2, 9) else 1, picture.format == "TIFF")


def size_of(picture: ImageFile.ImageFile, *, as_shown: bool = False) -> tuple[int, int]:
    """The declared (width, height) of a picture not yet decoded: of the stored pixels, or as viewers show it."""
    tag, done = turn_of(picture)
    width, height = picture.size
    return (height, width) if tag > 4 and as_shown != done else (width, height)


def oriented(pixels: np.ndarray, turn: Turn, *, as_shown: bool) -> np.ndarray:
    """Decoded pixels (H, W, ...) as they are stored, or as viewers show them."""
    if as_shown == turn.done:
        return pixels
    # Quarter turns exchange on the way back, and mirrors are their own.
    tag = turn.tag if as_shown else {6: 8, 8: 6}.get(turn.tag, turn.tag)
    result = pixels.swapaxes(0, 1) if tag > 4 else pixels
    result = result[::-1] if tag in (3, 4, 7, 8) else result
    result = result[:, ::-1] if tag in (2, 3, 6, 7) else result
    return np.ascontiguousarray(result)
