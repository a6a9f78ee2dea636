"""Reading images and stereo pairs; damaged files are refused.

Pillow reads them: unlike OpenCV it reports a truncated file instead of filling the rest with grey.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from os import PathLike
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16
from PIL import Image

from jaxmap.errors import FrameError, JaxmapError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm")

_GREY_MODES = ("L", "LA", "La", "1")
_DEEP_GREY_MODES = ("I", "I;16", "I;16B", "I;16L", "I;16N")
_COLOUR_MODES = ("RGB", "RGBA", "RGBX", "RGBa", "P", "PA", "CMYK", "YCbCr", "HSV", "LAB")

ImageArray = UInt8[np.ndarray, "H W"] | UInt8[np.ndarray, "H W 3"]


def read_image(path: str | PathLike[str]) -> ImageArray:
    """Reads an image as 8-bit grey or RGB.

    Grey stays grey, RGB stays RGB, palettes and other colour spaces become RGB, and alpha is
    dropped. 16-bit grey is shifted down to 8 bits from the smallest depth of 8, 10, 12, 14 or 16 bits
    that holds its brightest pixel, because cameras store 10 and 12 bits in 16-bit files. The EXIF
    orientation is not applied: a calibration refers to the pixels as they are stored.

    Returns:
        uint8 (H, W) or (H, W, 3).

    Raises:
        FrameError: the file is missing, truncated, not an image, or of another pixel type.
    """
    pixels = _read_pixels(Path(path))
    return _to_8_bits(pixels, _significant_bits(pixels))


def read_deep_image(path: Path) -> UInt16[np.ndarray, "H W"]:
    """Reads an image of 16-bit numbers as they are.

    Raises:
        FrameError: the file is missing, truncated, or no 16-bit grey image.
    """
    pixels = _read_pixels(path)
    if pixels.dtype != np.uint16:
        raise FrameError("not 16-bit grey", where=path, fix="write 16-bit numbers")
    return pixels


def read_index_image(path: Path) -> UInt8[np.ndarray, "H W"]:
    """Reads an image of class indices: 8-bit grey, or a palette image, whose indices are kept.

    Raises:
        FrameError: the file is missing, truncated, or has colours or more bits.
    """
    try:
        with Image.open(path) as image:
            image.load()
            mode, pixels = image.mode, np.array(image)
    except FileNotFoundError as fault:
        raise FrameError("the label image is missing", where=path, fix="label every left image") from fault
    except Exception as fault:
        raise _unreadable(path, fault) from fault
    if mode not in ("L", "P"):
        raise FrameError(
            f"a label image of type {mode}", where=path, fix="write class indices as 8-bit grey or palette"
        )
    return pixels


def as_rgb(image: ImageArray) -> UInt8[np.ndarray, "H W 3"]:
    """A grey or RGB image as RGB."""
    return np.broadcast_to(image[..., None], (*image.shape, 3)) if image.ndim == 2 else image


def read_image_pair(left_path: Path, right_path: Path, where: object) -> tuple[ImageArray, ImageArray]:
    """Reads the left and right image of a stereo pair.

    Where one is grey and the other RGB, both become grey (ITU-R 601 luma). Both sides of a 16-bit
    pair are shifted by the same number of bits.

    Raises:
        FrameError: an image cannot be read, or the two differ in size.
    """
    left, right = _read_pixels(left_path), _read_pixels(right_path)
    if left.shape[:2] != right.shape[:2]:
        sizes = [f"{image.shape[1]}x{image.shape[0]}" for image in (left, right)]
        raise FrameError(
            f"the left image is {sizes[0]}, the right one {sizes[1]}",
            where=where,
            fix="both images of a pair must have one size",
        )
    bits = max(_significant_bits(left), _significant_bits(right))
    left, right = _to_8_bits(left, bits), _to_8_bits(right, bits)
    if left.ndim != right.ndim:
        left, right = (np.array(Image.fromarray(image).convert("L")) for image in (left, right))
    return left, right


def image_size_px(path: Path) -> tuple[int, int]:
    """The (width, height) of an image, from its header alone.

    Raises:
        FrameError: the file is missing or not an image.
    """
    try:
        with Image.open(path) as image:
            return image.size
    except Exception as fault:
        raise _unreadable(path, fault) from fault


def first_image_size_px(left_paths: Iterable[Path], where: object) -> tuple[int, int]:
    """The (width, height) of the first left image that can be opened.

    Raises:
        JaxmapError: none can.
    """
    fault: FrameError | None = None
    for path in left_paths:
        try:
            return image_size_px(path)
        except FrameError as error:
            fault = fault or error
    reason = f" (first: {fault.what} in {fault.where})" if fault else ""
    raise JaxmapError(f"no left image can be read{reason}", where=where, fix="check the image files")


def list_images(folder: Path) -> list[Path]:
    """The images of a folder, in the natural order of their names (`f2` before `f10`).

    Raises:
        JaxmapError: the folder is missing, cannot be read, or holds no image.
    """
    try:
        files = [file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES and file.name[0] != "."]
    except OSError as fault:
        raise JaxmapError(
            f"no image folder ({fault.strerror})", where=folder, fix="check the path of the sequence"
        ) from fault
    if not files:
        raise JaxmapError("no images", where=folder, fix=f"put image files there ({' '.join(IMAGE_SUFFIXES)})")
    return sorted(files, key=_natural_key)


def _natural_key(file: Path) -> list[tuple[int, int, str]]:
    chunks = re.split(r"([0-9]+)", file.name)
    return [(1, int(chunk), "") if chunk.isascii() and chunk.isdigit() else (0, 0, chunk) for chunk in chunks]


def _read_pixels(path: Path) -> np.ndarray:
    """uint8 (H, W), uint8 (H, W, 3) or, for 16-bit grey, uint16 (H, W)."""
    # On damaged files Pillow's decoders raise nearly anything.
    try:
        with Image.open(path) as image:
            image.load()
            if image.mode in _DEEP_GREY_MODES:
                pixels = np.asarray(image)
            elif image.mode in _GREY_MODES:
                return np.array(image.convert("L"))
            elif image.mode in _COLOUR_MODES:
                return np.array(image.convert("RGB"))
            else:
                raise ValueError(f"pixels of type {image.mode}")
    except Exception as fault:
        raise _unreadable(path, fault) from fault
    if pixels.min() < 0 or pixels.max() > 65535:
        raise FrameError("pixels exceed 16 bits", where=path, fix="store the image as 8-bit or 16-bit grey, or RGB")
    return pixels.astype(np.uint16)


def _unreadable(path: Path, fault: Exception) -> FrameError:
    if isinstance(fault, FileNotFoundError):
        return FrameError("the image is missing", where=path, fix="restore the file")
    if isinstance(fault, Image.UnidentifiedImageError):
        return FrameError("not an image of a known format", where=path, fix="replace the file")
    return FrameError(f"the image cannot be read ({fault})", where=path, fix="replace the file by a whole 8-bit image")


def _significant_bits(pixels: np.ndarray) -> int:
    if pixels.dtype == np.uint8:
        return 8
    return next(bits for bits in (8, 10, 12, 14, 16) if int(pixels.max()) < 2**bits)


def _to_8_bits(pixels: np.ndarray, bits: int) -> np.ndarray:
    return pixels if pixels.dtype == np.uint8 else (pixels >> (bits - 8)).astype(np.uint8)
