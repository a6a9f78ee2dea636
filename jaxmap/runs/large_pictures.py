"""Pictures too large to be held as numbers: read decimated, labelled small, and written a band of rows at a time."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from jaxmap.datasets.bit_depth import to_8_bits, used_bits
from jaxmap.errors import FrameError
from jaxmap.host.pictures import Turn, open_picture, oriented, size_of, turn_of
from jaxmap.models.resizing import resize_taps

LARGE_PX = 2**25
"""Pictures of more pixels are decimated while they are read."""
OVERVIEW_PX = 2048
"""The longer side of the overlays of those."""

_BAND_PX = 2**21
_DRIVERS = {"PNG": "PNG", "JPEG": "JPEG", "TIFF": "GTiff", "BMP": "BMP", "PPM": "PNM", "WEBP": "WEBP"}

Size = tuple[int, int]
"""Height and width in pixels."""


def read_decimated(path: Path, size: Size) -> UInt8[np.ndarray, "h w *rgb"]:
    """Reads a picture of any size, as viewers show it, at a smaller size: GDAL averages it while it is decoded.

    Args:
        path: the picture.
        size: the wanted height and width; what comes is never larger than the picture itself.

    Raises:
        FrameError: the file is missing, broken, or of a rare kind of pixels.
    """
    import rasterio
    from rasterio.enums import ColorInterp, Resampling
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    with open_picture(path, max_px=None) as picture:
        driver, tag = _DRIVERS[picture.format or ""], turn_of(picture).tag
        width, height = size_of(picture)
    rows, columns = size[::-1] if tag > 4 else size
    rows, columns = min(rows, height), min(columns, width)
    try:
        # No files beside the picture are looked for.
        with warnings.catch_warnings(), rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR"):
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path, driver=driver) as raster:
                meanings = dict(zip(raster.indexes, raster.colorinterp, strict=True))
                bands = [band for band, meaning in meanings.items() if meaning != ColorInterp.alpha]
                palette = raster.colormap(1) if meanings[1] == ColorInterp.palette else None
                how = Resampling.average if palette is None else Resampling.nearest
                pixels = raster.read(bands, out_shape=(len(bands), rows, columns), resampling=how)
                levels = 2 ** int(raster.tags(1, ns="IMAGE_STRUCTURE").get("NBITS", 8)) - 1
    except (RasterioError, ValueError) as fault:
        raise FrameError(f"the image cannot be read ({fault})", where=path, fix="replace the file") from fault
    if len(pixels) not in (1, 3) or pixels.dtype not in (np.uint8, np.uint16):
        raise FrameError(
            f"{len(pixels)} bands of {pixels.dtype}", where=path, fix="store the image as 8-bit or 16-bit grey, or RGB"
        )
    if palette is not None:
        pixels = np.array([palette.get(index, (0, 0, 0))[:3] for index in range(256)], np.uint8)[pixels[0]]
        pixels = pixels.transpose(2, 0, 1)
    elif pixels.dtype == np.uint16:
        pixels = to_8_bits(pixels, used_bits(list(pixels)).bits)
    elif levels < 255:
        pixels = pixels * np.uint8(255 // levels)
    image = pixels[0] if len(pixels) == 1 else np.ascontiguousarray(pixels.transpose(1, 2, 0))
    return oriented(image, Turn(tag, done=False), as_shown=True)


def enlarged(logits: Float[np.ndarray, "h w C"], size: Size) -> Iterator[tuple[slice, Float[np.ndarray, "R W C"]]]:
    """Logits at a larger size, a band of rows at a time; bilinear, as `models.pixelwise.resized_output`.

    Args:
        logits: of the decimated picture.
        size: the height and width wanted.

    Yields:
        The rows of a band, and its logits.
    """
    height, width = size
    low, high, share = resize_taps(len(logits), height, False)
    before, after, part = resize_taps(logits.shape[1], width, False)
    wide = logits[:, before] + (logits[:, after] - logits[:, before]) * part[:, None]
    step = max(1, _BAND_PX // width)
    for first in range(0, height, step):
        rows = slice(first, min(first + step, height))
        yield rows, wide[low[rows]] + (wide[high[rows]] - wide[low[rows]]) * share[rows, None, None]
