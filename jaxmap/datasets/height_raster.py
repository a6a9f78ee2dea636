"""Heights of the ground from a GeoTIFF, or any raster that GDAL knows."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxmap.datasets.crs import Extent
from jaxmap.datasets.raster_window import read_window
from jaxmap.errors import JaxmapError


class HeightRaster(NamedTuple):
    """Heights with a place.

    Attributes:
        height_m: (rows, columns), NaN where there is none.
        T_crs_pixel: affine, takes (column, row, 1) to coordinates of `crs`; pixel `i` spans `[i, i + 1)`.
        crs: the coordinate reference system, None where it is unknown.
        notes: what was assumed in reading it, in words.
    """

    height_m: Float64[np.ndarray, "H W"]
    T_crs_pixel: Float64[np.ndarray, "3 3"]
    crs: str | None
    notes: tuple[str, ...]


def read_heights(path: Path, place: Extent, *, crs: str | None = None, margin: float = 0.0) -> HeightRaster:
    """Reads the part of a digital elevation model that lies over a place.

    Args:
        path: the raster, one band of heights in metres.
        place: the extent of the map.
        crs: the raster's system, in place of what the file says.
        margin: how much more is read on each side of the map, in its units.

    Raises:
        JaxmapError: what `read_window` refuses, another number of bands, or no height at all.
    """
    window = read_window(path, place, crs, margin)
    if len(window.bands) != 1 or window.palette is not None:
        kind = "colours of a palette" if window.palette is not None else f"{len(window.bands)} bands"
        raise JaxmapError(f"{kind}, one band of heights is expected", where=path, fix="give an elevation model")
    height_m = np.where(window.valid, window.bands[0].astype(np.float64), np.nan)
    if not np.isfinite(height_m).any():
        raise JaxmapError("no height lies over the map", where=path, fix="check nodata and extent of the raster")
    return HeightRaster(height_m, window.T_crs_pixel, window.crs, window.notes)
