"""Orthomosaics: ground truth labelled from above, and pictures to draw on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from jaxmap.datasets.crs import Extent
from jaxmap.datasets.label_coding import DEFAULT_CODING, LabelCoding, decode
from jaxmap.datasets.label_raster import LabelRaster
from jaxmap.datasets.raster_window import RasterWindow, read_window
from jaxmap.errors import JaxmapError


def read_label_orthomosaic(
    path: Path,
    place: Extent,
    *,
    coding: LabelCoding = DEFAULT_CODING,
    target: str = "rock",
    crs: str | None = None,
    margin: float = 0.0,
) -> LabelRaster:
    """Reads the part of a labelled orthomosaic that lies over a map.

    One band of whole numbers (a palette image: its indices), or, where the coding is of colours, a palette or RGB
    image. Nodata and transparent pixels are unlabelled.

    Args:
        path: the raster.
        place: the extent of the map.
        coding: what its values mean.
        target: the class that is scored.
        crs: the raster's system, in place of what the file says.
        margin: how much more is read on each side of the map, in its units.

    Raises:
        JaxmapError: what `read_window` refuses, another number of bands, or values without a meaning.
        UsageError: the coding does not name the target.
    """
    window = read_window(path, place, crs, margin)
    codes = _colours(window, path) if coding.colours else _indices(window, path)
    labels = decode(codes, window.valid, coding, target, path)
    return LabelRaster(labels, window.T_crs_pixel, window.crs, path.name, window.notes)


def read_picture(
    path: Path, place: Extent, crs: str | None = None
) -> tuple[UInt8[np.ndarray, "H W 3"], Float64[np.ndarray, "3 3"], str | None]:
    """Reads the part of an orthomosaic that lies over a map as RGB, with its affine and its system.

    Grey becomes RGB; numbers of more than 8 bits are stretched over their middle 96 %.

    Raises:
        JaxmapError: what `read_window` refuses.
    """
    window = read_window(path, place, crs)
    bands = window.bands[:3] if len(window.bands) >= 3 else np.repeat(window.bands[:1], 3, axis=0)
    if window.palette is not None:
        table = np.zeros((256, 3), np.uint8)
        for value, colour in window.palette.items():
            table[value & 255] = colour
        bands = np.moveaxis(table[bands[0].astype(np.uint8)], -1, 0)
    elif bands.dtype != np.uint8:
        low, high = np.percentile(bands[:, window.valid], [2, 98]) if window.valid.any() else (0.0, 1.0)
        bands = np.clip((np.nan_to_num(bands.astype(np.float64)) - low) / max(high - low, 1e-9) * 255, 0, 255)
    return np.moveaxis(bands, 0, -1).astype(np.uint8), window.T_crs_pixel, window.crs


def _indices(window: RasterWindow, path: Path) -> np.ndarray:
    if len(window.bands) != 1:
        raise JaxmapError(
            f"{len(window.bands)} bands, one of labels is expected",
            where=path,
            fix="give the labelled orthomosaic, or say what its colours mean: --remap '#b23c2e=rock' '*=sand'",
        )
    values = np.where(window.valid, window.bands[0], 0)
    codes = values.astype(np.int64)
    if values.dtype.kind not in "ui" and (codes != values).any():
        raise JaxmapError("the band holds fractions, not labels", where=path, fix="give the labelled orthomosaic")
    return codes


def _colours(window: RasterWindow, path: Path) -> np.ndarray:
    if window.palette is not None and len(window.bands) == 1:
        table = {value: red << 16 | green << 8 | blue for value, (red, green, blue) in window.palette.items()}
        lookup = np.array([table.get(value, 0) for value in range(max(table, default=0) + 1)])
        return lookup[np.clip(window.bands[0].astype(np.int64), 0, len(lookup) - 1)]
    if len(window.bands) != 3 or window.bands.dtype != np.uint8:
        raise JaxmapError(
            f"{len(window.bands)} bands of {window.bands.dtype} are no colours",
            where=path,
            fix="give an RGB or palette image of 8 bits, or numbers as the codes of --remap",
        )
    red, green, blue = window.bands.astype(np.int64)
    return red << 16 | green << 8 | blue
