"""The top-down map as a GeoTIFF."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxmap.errors import JaxmapError
from jaxmap.fusion.query import TopDown
from jaxmap.geometry.grid import exact_corner
from jaxmap.host.files import atomic_path
from jaxmap.labels import IGNORE
from jaxmap.types import GridSpec


def write_geotiff(
    path: str | os.PathLike[str],
    top: TopDown,
    grid: GridSpec,
    classes: Sequence[str],
    crs: str | None,
    site_origin: np.ndarray,
    *,
    layers: Mapping[str, Float[np.ndarray, "X Y"]] | None = None,
) -> None:
    """Writes a north-up raster with one cell per column of voxels, float32, NaN where nothing was seen.

    Bands, named by their descriptions: `label` (class index), `height_m` (of the highest occupied
    voxel's centre, `site_origin` added), then `probability_NAME` of each class, then the `layers` of the map.

    Raises:
        JaxmapError: an unknown `crs`, or the disk is full or refuses.
    """
    site_origin, layers = np.asarray(site_origin, np.float64), layers or {}
    label, observed = np.asarray(top.label), np.asarray(top.observed)
    named = {
        "label": np.where(label == IGNORE, np.nan, label),
        "height_m": np.asarray(top.height_m, np.float64) + site_origin[2],
    }
    for name, probability in zip(classes, np.asarray(top.probability), strict=True):
        named[f"probability_{name}"] = np.where(observed, probability, np.nan)
    named |= layers
    write_bands(path, named, grid, crs, site_origin, classes=json.dumps(list(classes)))


def write_bands(
    path: str | os.PathLike[str],
    named: Mapping[str, Float[np.ndarray, "X Y"]],
    grid: GridSpec,
    crs: str | None,
    site_origin: np.ndarray,
    **tags: str,
) -> None:
    """Writes layers of the columns of a grid as the bands of a north-up raster, float32, NaN where nothing is known.

    Bands are named by their descriptions; a name that ends in `_m` or `_deg` says the unit.

    Raises:
        JaxmapError: an unknown `crs`, or the disk is full or refuses.
    """
    from rasterio import Affine
    from rasterio.crs import CRS
    from rasterio.errors import CRSError, NotGeoreferencedWarning
    from rasterio.io import MemoryFile

    # From x east, y north to rows from the north and columns to the east.
    bands = np.stack([band.T[::-1] for band in named.values()]).astype(np.float32)
    count, height, width = bands.shape
    origin_m, (east_m, north_m, _) = exact_corner(grid)
    west, south = site_origin[:2] + origin_m[:2]
    try:
        reference = CRS.from_user_input(crs) if crs else None
    except CRSError as error:
        raise JaxmapError(
            f"unknown coordinate reference system {crs!r}", where=path, fix='give a name such as "EPSG:32631"'
        ) from error
    profile: dict[str, Any] = dict(
        driver="GTiff", count=count, height=height, width=width, dtype="float32", nodata=np.nan
    )
    profile |= dict(compress="deflate", predictor=3, interleave="band", crs=reference)
    profile |= dict(transform=Affine(east_m, 0.0, west, 0.0, -north_m, south + height * north_m))
    with warnings.catch_warnings(), MemoryFile() as memory:
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with memory.open(**profile) as raster:
            raster.write(bands)
            raster.descriptions = tuple(named)
            raster.units = tuple(
                next((unit for unit in ("m", "deg") if name.endswith(f"_{unit}")), "") for name in named
            )
            raster.update_tags(**tags)
        content = bytes(memory.getbuffer())
    # Encoded in memory: Python reports a full disk, where GDAL may find out only while closing.
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
