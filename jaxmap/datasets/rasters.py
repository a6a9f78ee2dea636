"""The part of a georeferenced raster that lies over a map, from any file format that GDAL reads."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Shaped, UInt8

from jaxmap.datasets.crs import Extent, crs_text, extent_in
from jaxmap.errors import JaxmapError
from jaxmap.host.files import check_regular

if TYPE_CHECKING:
    from rasterio.io import DatasetReader
    from rasterio.windows import Window

_MOST_BYTES, _MOST_FILE_BYTES = 4 << 30, 1 << 44
_PIXEL_BYTES = 12
"""Of masks and codes that are made of each pixel."""
_MOST_BLOCK_BYTES = 1 << 30
"""GDAL reads whole blocks, however small the window is."""
_FARTHEST, _LEAST_PIXEL = 1e9, 1e-24
_MARGIN_PX = 2

Colours = dict[int, tuple[int, int, int]]


class RasterWindow(NamedTuple):
    """Georeferenced pixels of a raster.

    Attributes:
        bands: the values as stored, without an alpha band.
        valid: pixels that are neither nodata nor transparent.
        T_crs_pixel: affine, takes (column, row, 1) of this window to coordinates of `crs`; pixel `i` spans
            `[i, i + 1)`.
        crs: the coordinate reference system; None where both the file's and the map's are unknown.
        palette: RGB of the values of a palette image, or None.
        notes: assumptions made in reading it.
    """

    bands: Shaped[np.ndarray, "B H W"]
    valid: Bool[np.ndarray, "H W"]
    T_crs_pixel: Float64[np.ndarray, "3 3"]
    crs: str | None
    palette: Colours | None
    notes: tuple[str, ...]


class HeightRaster(NamedTuple):
    """Georeferenced heights.

    Attributes:
        height_m: (rows, columns), NaN where there is none.
        T_crs_pixel: affine, takes (column, row, 1) to coordinates of `crs`; pixel `i` spans `[i, i + 1)`.
        crs: the coordinate reference system, None where it is unknown.
        notes: assumptions made in reading it.
    """

    height_m: Float64[np.ndarray, "H W"]
    T_crs_pixel: Float64[np.ndarray, "3 3"]
    crs: str | None
    notes: tuple[str, ...]


def read_window(path: Path, place: Extent, crs: str | None = None, margin: float = 0.0) -> RasterWindow:
    """Reads the pixels of a raster that lie over an extent.

    Where the coordinate reference system of one of the two is unknown, that of the other is assumed if they overlap.

    Args:
        path: the file.
        place: the extent.
        crs: the raster's coordinate reference system, in place of the file's own.
        margin: added on each side, in units of the extent.

    Raises:
        JaxmapError: the file is missing, not a raster, truncated, not georeferenced, or elsewhere.
    """
    with _opened(path) as raster:
        T_crs_pixel = np.array(raster.transform, np.float64).reshape(3, 3)
        near = (np.abs(T_crs_pixel) < _FARTHEST).all()
        if not near or np.array_equal(T_crs_pixel, np.eye(3)) or abs(np.linalg.det(T_crs_pixel)) < _LEAST_PIXEL:
            raise JaxmapError(
                "the raster is not georeferenced", where=path, fix="give a GeoTIFF, or a world file beside it"
            )
        own = crs or (raster.crs.to_wkt() if raster.crs else None)
        covered = _covered(T_crs_pixel, raster.width, raster.height, own)
        notes = _check_overlap(covered, place, path)
        window = _window(raster, T_crs_pixel, extent_in(place.grown(margin), own, path))
        bands, valid = _read(raster, window, path)
        shift = np.array([[1.0, 0, window.col_off], [0, 1, window.row_off], [0, 0, 1]])
        return RasterWindow(bands, valid, T_crs_pixel @ shift, own or place.crs, _palette(raster), notes)


def read_heights(path: Path, place: Extent, *, crs: str | None = None, margin: float = 0.0) -> HeightRaster:
    """Reads the part of a digital elevation model that lies over a map.

    Args:
        path: the raster, one band of heights in metres.
        place: the extent of the map.
        crs: the raster's coordinate reference system, in place of the file's own.
        margin: added on each side of the map, in its units.

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


def read_picture(
    path: Path, place: Extent, crs: str | None = None
) -> tuple[UInt8[np.ndarray, "H W 3"], Float64[np.ndarray, "3 3"], str | None]:
    """Reads the part of an orthomosaic that lies over a map: RGB, `T_crs_pixel`, and coordinate reference system.

    Grey becomes RGB; more than 8 bits are stretched from the 2nd to the 98th percentile.

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


@contextmanager
def _opened(path: Path) -> Iterator[DatasetReader]:
    import rasterio
    from rasterio.errors import CRSError, NotGeoreferencedWarning, RasterioError

    if not path.exists():
        raise JaxmapError("no such file", where=path, fix="check the path of the raster")
    check_regular(path, _MOST_FILE_BYTES)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            with rasterio.open(path) as raster:
                yield raster
        except (RasterioError, CRSError, UnicodeError) as error:
            raise JaxmapError(
                "not a readable raster: damaged, cut off or not an image", where=path, fix="give a whole GeoTIFF"
            ) from error


def _covered(T_crs_pixel: np.ndarray, width: int, height: int, crs: str | None) -> Extent:
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]]) @ T_crs_pixel.T
    (west, south), (east, north) = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
    return Extent(float(west), float(south), float(east), float(north), crs)


def _check_overlap(covered: Extent, place: Extent, path: Path) -> tuple[str, ...]:
    """Notes on an unknown coordinate reference system.

    Raises:
        JaxmapError: the two do not overlap.
    """
    there = extent_in(covered, place.crs, path)
    if not there.overlaps(place):
        unknown = {
            (False, True): "; the raster has no CRS, name it with --truth-crs",
            (True, False): "; the map has no CRS: name it with jaxmap map --crs",
        }.get((covered.crs is not None, place.crs is not None), "; check that both are of one site")
        raise JaxmapError(
            f"the raster does not lie over the map: it reaches from {there.text()}, the map from {place.text()} "
            f"({crs_text(place.crs or covered.crs)})",
            where=path,
            fix=unknown.removeprefix("; "),
        )
    if covered.crs is None and place.crs is not None:
        return (f"{path.name} has no CRS: taken for the map's, {crs_text(place.crs)}",)
    if covered.crs is not None and place.crs is None:
        return (f"the map has no CRS: taken for that of {path.name}, {crs_text(covered.crs)}",)
    return ()


def _window(raster: DatasetReader, T_crs_pixel: np.ndarray, wanted: Extent) -> Window:
    """The window of whole pixels that covers a box, with a margin."""
    from rasterio.windows import Window

    west, south, east, north = wanted[:4]
    corners = np.array([[west, south, 1], [east, south, 1], [west, north, 1], [east, north, 1]])
    pixels = (corners @ np.linalg.inv(T_crs_pixel).T)[:, :2]
    size = np.array([raster.width, raster.height])
    first = np.clip(np.floor(pixels.min(axis=0)) - _MARGIN_PX, 0, size - 1).astype(int)
    last = np.clip(np.ceil(pixels.max(axis=0)) + _MARGIN_PX, first + 1, size).astype(int)
    return Window(int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1]))  # type: ignore[call-arg]


def _read(raster: DatasetReader, window: Window, path: Path) -> tuple[np.ndarray, np.ndarray]:
    from rasterio.enums import ColorInterp

    bands = [index for index, kind in zip(raster.indexes, raster.colorinterp, strict=True) if kind != ColorInterp.alpha]
    if not bands:
        raise JaxmapError("the raster has no band but transparency", where=path, fix="give one with values")
    number_bytes = max(np.dtype(kind).itemsize for kind in raster.dtypes)
    size = f"{window.width} x {window.height} pixels of {len(bands)} bands"
    if window.width * window.height * (len(bands) * number_bytes + _PIXEL_BYTES) > _MOST_BYTES:
        raise JaxmapError(f"{size} lie over the map", where=path, fix="give the raster at a coarser resolution")
    if max(height * width for height, width in raster.block_shapes) * number_bytes > _MOST_BLOCK_BYTES:
        raise JaxmapError(
            "the raster is stored in too large blocks",
            where=path,
            fix="write it anew in tiles: gdal_translate -co TILED=YES",
        )
    values = raster.read(bands, window=window)
    valid = raster.dataset_mask(window=window) > 0
    if values.dtype.kind == "f":
        valid &= np.isfinite(values).all(axis=0)
    return values, valid


def _palette(raster: DatasetReader) -> Colours | None:
    try:
        return {value: colour[:3] for value, colour in raster.colormap(1).items()}
    except ValueError:
        return None
