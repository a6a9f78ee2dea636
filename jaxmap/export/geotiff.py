"""The view from above as a GeoTIFF."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Mapping, Sequence

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
    site_origin = np.asarray(site_origin, np.float64)
    layers = layers or {}
    bands = _bands(top, site_origin[2], list(layers.values()))
    names = ("label", "height_m", *(f"probability_{name}" for name in classes), *layers)
    content = _encode(bands, names, grid, classes, crs, site_origin, where=path)
    # Encoded in memory: Python reports a full disk, where GDAL may find out only while closing.
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def _bands(top: TopDown, site_height_m: float, layers: Sequence[np.ndarray]) -> Float[np.ndarray, "B Y X"]:
    observed = np.asarray(top.observed)
    label = np.asarray(top.label)
    bands = [
        np.where(label == IGNORE, np.nan, label),
        np.asarray(top.height_m, np.float64) + site_height_m,
        *(np.where(observed, channel, np.nan) for channel in np.asarray(top.probability)),
        *layers,
    ]
    # From x east, y north to rows from the north and columns to the east.
    return np.stack([band.T[::-1] for band in bands]).astype(np.float32)


def _encode(
    bands: Float[np.ndarray, "B Y X"],
    names: Sequence[str],
    grid: GridSpec,
    classes: Sequence[str],
    crs: str | None,
    site_origin: np.ndarray,
    where: object,
) -> bytes:
    from rasterio import Affine
    from rasterio.crs import CRS
    from rasterio.errors import CRSError, NotGeoreferencedWarning
    from rasterio.io import MemoryFile

    count, height, width = bands.shape
    origin_m, (east_m, north_m, _) = exact_corner(grid)
    west, south = site_origin[:2] + origin_m[:2]
    try:
        reference = CRS.from_user_input(crs) if crs else None
    except CRSError as error:
        raise JaxmapError(
            f"unknown coordinate reference system {crs!r}", where=where, fix='give a name such as "EPSG:32631"'
        ) from error
    profile = dict(
        driver="GTiff",
        count=count,
        height=height,
        width=width,
        dtype="float32",
        nodata=np.nan,
        crs=reference,
        transform=Affine(east_m, 0.0, west, 0.0, -north_m, south + height * north_m),
        compress="deflate",
        predictor=3,
        interleave="band",
    )
    with warnings.catch_warnings(), MemoryFile() as memory:
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with memory.open(**profile) as raster:
            raster.write(bands)
            raster.descriptions = tuple(names)
            raster.units = tuple("m" if name == "height_m" else "" for name in names)
            raster.update_tags(classes=json.dumps(list(classes)))
        return bytes(memory.getbuffer())
