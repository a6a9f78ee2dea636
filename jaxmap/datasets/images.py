"""Reading images and stereo pairs; damaged files are refused.

Pillow reads them: unlike OpenCV it reports a truncated file instead of filling the rest with grey.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from os import PathLike
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16
from PIL import Image, ImageFile

from jaxmap.datasets.bit_depth import BitDepth, to_8_bits, used_bits
from jaxmap.datasets.options import Bits
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.host.pictures import open_picture, oriented, raw_mode, size_of, turn_of
from jaxmap.host.png import plain_png
from jaxmap.models.tensor_files import shortened

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp")

_GREY_MODES = ("L", "LA", "La", "1")
_DEEP_GREY_MODES = ("I", "I;16", "I;16B", "I;16L", "I;16N")
_COLOUR_MODES = ("RGB", "RGBA", "RGBX", "RGBa", "P", "PA", "CMYK", "YCbCr", "HSV", "LAB")

_FRAMES_TO_JUDGE = 8

ImageArray = UInt8[np.ndarray, "H W"] | UInt8[np.ndarray, "H W 3"]
Pixels = ImageArray | UInt16[np.ndarray, "H W"] | UInt16[np.ndarray, "H W 3"]


def read_image(path: str | PathLike[str], *, bits: Bits | None = None, as_shown: bool = False) -> ImageArray:
    """Reads an image as 8-bit grey or RGB.

    Grey stays grey, RGB stays RGB, palettes and other colour spaces become RGB, and alpha is dropped. 16-bit grey and
    RGB are shifted down to 8 bits from the bits they use.

    Args:
        path: PNG, JPEG, TIFF, BMP, PGM, PPM or WebP.
        bits: how many a 16-bit image uses; by default what `bit_depth.used_bits` finds in this image.
        as_shown: whether a photograph's rotation tag (EXIF orientation) is applied, as viewers do. By default pixels
            come as they are stored, which is what a calibration refers to.

    Returns:
        uint8 (H, W) or (H, W, 3).

    Raises:
        FrameError: the file is missing, truncated, not an image, too large, or of another pixel type.
    """
    pixels = read_pixels(Path(path), as_shown=as_shown)
    return to_8_bits(pixels, bits or used_bits([pixels]).bits) if pixels.dtype == np.uint16 else pixels


def read_deep_image(path: Path) -> UInt16[np.ndarray, "H W"]:
    """Reads an image of 16-bit numbers as they are.

    Raises:
        FrameError: the file is missing, truncated, or no 16-bit grey image.
    """
    pixels = read_pixels(path)
    if pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise FrameError("not 16-bit grey", where=path, fix="write 16-bit numbers")
    return pixels


def as_rgb(image: ImageArray) -> UInt8[np.ndarray, "H W 3"]:
    """A grey or RGB image as RGB."""
    return np.broadcast_to(image[..., None], (*image.shape, 3)) if image.ndim == 2 else image


def read_image_pair(
    left_path: Path,
    right_path: Path,
    where: object,
    *,
    bits: Bits | None = None,
    size_px: tuple[int, int] | None = None,
) -> tuple[ImageArray, ImageArray]:
    """Reads the left and right image of a stereo pair, on the pixels as they are stored.

    Where one is grey and the other RGB, both become grey (ITU-R 601 luma). Both sides of a 16-bit pair are shifted by
    the same number of bits.

    Args:
        left_path: of the left image.
        right_path: of the right image.
        where: the pair, for errors.
        bits: how many 16-bit images use; found from this pair alone by default.
        size_px: (width, height) that both must declare before either is decoded.

    Raises:
        FrameError: an image cannot be read, or has another size than asked for or than the other one.
    """
    left, right = (read_pixels(path, size_px=size_px) for path in (left_path, right_path))
    if left.shape[:2] != right.shape[:2]:
        sizes = [f"{image.shape[1]}x{image.shape[0]}" for image in (left, right)]
        raise FrameError(
            f"the left image is {sizes[0]}, the right one {sizes[1]}",
            where=where,
            fix="both images of a pair must have one size",
        )
    deep = [image for image in (left, right) if image.dtype == np.uint16]
    if deep:
        bits = bits or used_bits(deep).bits
        left, right = to_8_bits(left, bits), to_8_bits(right, bits)
    if left.ndim != right.ndim:
        left, right = (np.array(Image.fromarray(image).convert("L")) for image in (left, right))
    return left, right


def sequence_bits(pairs: Sequence[tuple[Path, Path]]) -> BitDepth | None:
    """How many bits the images of a sequence use, judged from a few frames of both cameras.

    It is decided once for all frames: a shift that changes from frame to frame would change their contrast.

    Args:
        pairs: left and right files.

    Returns:
        None where none of those images has more than 8 bits or can be read.
    """
    picked = np.unique(np.linspace(0, len(pairs) - 1, _FRAMES_TO_JUDGE).round().astype(int)) if pairs else []
    images = []
    for path in (path for index in picked for path in pairs[index]):
        try:
            with open_picture(path) as image:
                deep = image.mode in _DEEP_GREY_MODES or has_deep_colours(image)
            images += [pixels] if deep and (pixels := read_pixels(path)).dtype == np.uint16 else []
        except FrameError:
            continue
    return used_bits(images) if images else None


def image_size_px(path: Path, *, as_shown: bool = False) -> tuple[int, int]:
    """The (width, height) of an image, from its header alone; stored, or as viewers show it.

    Raises:
        FrameError: the file is missing or not an image.
    """
    with open_picture(path, max_px=None) as image:
        return size_of(image, as_shown=as_shown)


def image_rotation_tag(path: Path) -> int:
    """The rotation tag of an image (EXIF orientation, 1 for none), from its header alone.

    Raises:
        FrameError: the file is missing or not an image.
    """
    with open_picture(path, max_px=None) as image:
        return turn_of(image).tag


def rotation_notes(images: Sequence[Path]) -> list[str]:
    """A note on the photographs whose rotation tag turns them; none where there are none."""
    turned = []
    for path in images:
        with suppress(FrameError):
            turned += [path.name] if image_rotation_tag(path) != 1 else []
    if not turned:
        return []
    return [
        f"{len(turned)} of {len(images)} images carry a rotation tag ({shortened(turned, 3)}) and are turned as "
        "viewers show them; masks and labels lie on the turned pixels"
    ]


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


def read_pixels(path: Path, *, as_shown: bool = False, size_px: tuple[int, int] | None = None) -> Pixels:
    """Reads an image with the bits that it has; see `read_image` and `read_image_pair` for the arguments.

    Returns:
        uint8 or uint16, (H, W) or (H, W, 3).

    Raises:
        FrameError: as `read_image`.
    """
    with open_picture(path) as image:
        if size_px is not None and size_of(image) != size_px:
            (width, height), (wanted_width, wanted_height) = size_of(image), size_px
            raise FrameError(
                f"the image is {width}x{height} px, the calibration is for {wanted_width}x{wanted_height} px",
                where=path,
                fix="give the calibration of these images",
            )
        turn = turn_of(image)
        pixels = _decoded(image, path)
    if pixels.dtype not in (np.uint8, np.uint16):
        if pixels.min() < 0 or pixels.max() > 65535:
            raise FrameError("pixels exceed 16 bits", where=path, fix="store the image as 8-bit or 16-bit grey, or RGB")
        pixels = pixels.astype(np.uint16)
    return oriented(pixels, turn, as_shown=as_shown)


def _decoded(image: ImageFile.ImageFile, path: Path) -> np.ndarray:
    if (pixels := plain_png(image, path)) is not None:
        return pixels
    if has_deep_colours(image):
        return decode_deep(image, path)
    image.load()
    if image.mode in _DEEP_GREY_MODES:
        return np.array(image)
    for wanted, modes in (("L", _GREY_MODES), ("RGB", _COLOUR_MODES)):
        if image.mode in modes:
            # Pillow copies what it need not convert.
            return np.array(image if image.mode == wanted else image.convert(wanted))
    raise ValueError(f"pixels of type {image.mode}")


def has_deep_colours(image: ImageFile.ImageFile) -> bool:
    """Whether Pillow would cut or scale the bits of an image not yet decoded: 16-bit colours or alpha, deep PNM."""
    decoder, _, _, arguments = image.tile[0] if image.tile else ("", None, 0, None)
    if decoder == "ppm" and isinstance(arguments, tuple):
        return arguments[-1] > 255
    return image.mode in ("RGB", "RGBA", "RGBX", "LA") and ";16" in raw_mode(image)


def decode_deep(image: ImageFile.ImageFile, path: Path) -> UInt16[np.ndarray, "H W *rgb"]:
    """The pixels of an image that `has_deep_colours`, as 16-bit grey or RGB, without alpha.

    Raises:
        Exception: of many kinds, where the file is damaged.
    """
    grey = "L" in raw_mode(image)
    # OpenCV keeps all bits, but fills up what a cut file lacks; Pillow refuses it.
    image.load()
    pixels = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.shape[:2] != image.size[::-1]:
        raise ValueError("16-bit colours of a rare kind")
    if pixels.ndim == 3:
        pixels = np.ascontiguousarray(pixels[..., 0] if grey else pixels[..., 2::-1])
    return pixels
