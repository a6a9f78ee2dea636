"""The top-down map as a GeoTIFF, window by window, and as a cloud-optimised one."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmap.errors import JaxmapError
from jaxmap.export.source import Source, absolute
from jaxmap.geometry.grid import exact_corner
from jaxmap.host.files import atomic_path
from jaxmap.labels import IGNORE
from jaxmap.types import GridSpec

_Part = tuple[tuple[int, int], Float[np.ndarray, "B X Y"]]
"""Bands of a part of the map, and where it begins."""

_BLOCK, _LARGE_BLOCK, _LARGE = 64, 256, 1 << 14
"""Cells along the edges of what is compressed as one: that of a map's tiles, and of rasters with a longer side."""


def write_geotiff(source: Source, path: Path) -> None:
    """Writes a north-up raster with one cell per column of voxels, float32, NaN where nothing was seen.

    Bands, named by their descriptions: `label` (class index), `height_m` (of the highest occupied
    voxel's centre, site origin added), then `probability_NAME` of each class, then the layers of the map. It is tiled
    and sparse: what nothing was seen of takes no space.

    Raises:
        JaxmapError: an unknown coordinate reference system, or the disk is full or refuses.
    """
    with _quiet(path), atomic_path(path) as temporary:
        _write(temporary, path, _described(source), _parts(source))


def write_cog(source: Source, path: Path) -> None:
    """Writes the raster of `write_geotiff` as a cloud-optimised GeoTIFF: with overviews, to be read in parts by HTTP.

    Overviews take the nearest cell, so that labels stay labels.

    Raises:
        JaxmapError: as `write_geotiff`.
    """
    from rasterio.shutil import copy

    with _quiet(path), atomic_path(path) as temporary:
        plain = temporary.with_name(f"{temporary.name}.plain.tif")
        try:
            _write(plain, path, _described(source), _parts(source))
            form = dict(compress="DEFLATE", predictor="YES", overview_resampling="NEAREST", sparse_ok=True)
            copy(plain, temporary, driver="COG", blocksize=256, bigtiff="IF_SAFER", **form)
            _read_back(temporary)
        finally:
            plain.unlink(missing_ok=True)


def write_bands(
    path: Path,
    bands: Mapping[str, Float[np.ndarray, "X Y"]],
    grid: GridSpec,
    crs: str | None,
    site_origin: Float[np.ndarray, "3"],
) -> None:
    """Writes layers of a top-down map, by name, as the bands of a raster like that of `write_geotiff`.

    A name that ends in `_m` or `_deg` says the unit.

    Raises:
        JaxmapError: as `write_geotiff`.
    """
    parts = [((0, 0), np.stack([*bands.values()]).astype(np.float32))]
    with _quiet(path), atomic_path(path) as temporary:
        _write(temporary, path, _Raster([*bands], grid, crs, site_origin, {}), parts)


class _Raster(NamedTuple):
    names: Sequence[str]
    grid: GridSpec
    crs: str | None
    site_origin: Float[np.ndarray, "3"]
    tags: dict[str, str]


def _described(source: Source) -> _Raster:
    tags = dict(classes=json.dumps(list(source.classes)))
    names = ["label", "height_m", *(f"probability_{name}" for name in source.classes), *source.reader.attributes.layers]
    return _Raster(names, source.reader.grid, source.reader.attributes.crs, source.site_origin, tags)


def _parts(source: Source) -> Iterator[_Part]:
    for part in source.parts():
        top = part.top
        label = np.where(top.label == IGNORE, np.nan, top.label)
        bands = [label, np.asarray(top.height_m, np.float64) + source.site_origin[2]]
        bands += [np.where(top.observed, probability, np.nan) for probability in top.probability]
        layers = absolute(part.layers, source.site_origin[2])
        yield part.corner, np.stack([*bands, *layers.values()]).astype(np.float32)


def _write(temporary: Path, path: Path, described: _Raster, parts: Iterable[_Part]) -> None:
    import rasterio
    from rasterio import Affine
    from rasterio.crs import CRS
    from rasterio.errors import CRSError
    from rasterio.windows import Window

    names, grid, crs, site_origin, tags = described
    width, height = grid.shape[:2]
    try:
        reference = CRS.from_user_input(crs) if crs else None
    except CRSError as error:
        raise JaxmapError(
            f"unknown coordinate reference system {crs!r}", where=path, fix='give a name such as "EPSG:32631"'
        ) from error
    corner_m, (east_m, north_m, _) = exact_corner(grid)
    west, south = np.asarray(site_origin, np.float64)[:2] + corner_m[:2]
    edge = _BLOCK if max(width, height) < _LARGE else _LARGE_BLOCK
    profile: dict[str, Any] = dict(driver="GTiff", count=len(names), height=height, width=width, dtype="float32")
    profile |= dict(nodata=np.nan, compress="deflate", predictor=3, interleave="band", crs=reference)
    profile |= dict(tiled=True, blockxsize=edge, blockysize=edge, sparse_ok=True, bigtiff="IF_SAFER")
    profile |= dict(transform=Affine(east_m, 0.0, west, 0.0, -north_m, south + height * north_m))
    with rasterio.open(temporary, "w", **profile) as raster:
        raster.descriptions = tuple(names)
        raster.units = tuple(next((unit for unit in ("m", "deg") if name.endswith(f"_{unit}")), "") for name in names)
        raster.update_tags(**tags)
        for (west_cell, south_cell), bands in parts:
            # From x east, y north to rows from the north and columns to the east.
            rows, cells = bands.shape[2], bands.shape[1]
            window = Window(west_cell, height - south_cell - rows, cells, rows)  # pyright: ignore[reportCallIssue]
            raster.write(bands.transpose(0, 2, 1)[:, ::-1], window=window)
    _read_back(temporary)


def _read_back(path: Path) -> None:
    """Reads a raster once: GDAL may find out only while closing that the disk is full, and then says nothing."""
    import rasterio

    with rasterio.open(path) as raster:
        for _, window in raster.block_windows(1):
            raster.read(window=window)


@contextmanager
def _quiet(path: Path) -> Iterator[None]:
    """Rasters without coordinate reference system are no reason for a warning; what GDAL cannot write is an error."""
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            yield
    except RasterioError as error:
        raise JaxmapError(
            f"the raster could not be written ({error})", where=path, fix="free some space or write to another disk"
        ) from error
