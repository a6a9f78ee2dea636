"""The world from straight above: orthomosaic, labels and heights as GeoTIFFs."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from jaxmap.host.files import atomic_path
from jaxmap.simulation.mesh import BACKGROUND, ROCK, SAND, SURFACE_LABEL, Mesh
from jaxmap.simulation.rays import RayImage, downward_rays
from jaxmap.simulation.render import FirstHits

_TOP_M, _BOTTOM_M = 60.0, -20.0


class Raster(NamedTuple):
    """A north-up raster in the world: its north-west corner, square cells, rows and columns."""

    west_m: float
    north_m: float
    cell_m: float
    shape: tuple[int, int]


def raster_around(points_m: Float[np.ndarray, "P 2"], reach_m: float, cell_m: float) -> Raster:
    """The raster of whole cells that holds all that lies within `reach_m` of the points."""
    lower = np.floor((points_m.min(axis=0) - reach_m) / cell_m)
    upper = np.ceil((points_m.max(axis=0) + reach_m) / cell_m)
    columns, rows = (upper - lower).astype(int)
    return Raster(float(lower[0] * cell_m), float(upper[1] * cell_m), cell_m, (int(rows), int(columns)))


def raster_rays(raster: Raster) -> RayImage:
    """A ray straight down through each cell."""
    return downward_rays(raster.west_m, raster.north_m, raster.cell_m, raster.shape, _TOP_M, _BOTTOM_M)


def raster_heights_m(hits: FirstHits) -> Float[np.ndarray, "H W"]:
    """Height of the topmost surface in the world."""
    return (_TOP_M + hits.depth * (_BOTTOM_M - _TOP_M)).astype(np.float32)


def surface_labels(hits: FirstHits, mesh: Mesh) -> UInt8[np.ndarray, "H W"]:
    """The class of what each pixel sees: background, sand or rock; the sky is background."""
    labels = SURFACE_LABEL[mesh.surface[np.maximum(hits.face, 0)]]
    return np.where(hits.face >= 0, labels, BACKGROUND).astype(np.uint8)


def ground_truth_labels(hits: FirstHits, mesh: Mesh) -> UInt8[np.ndarray, "H W"]:
    """The coding of labelled orthomosaics: 0 unlabelled, 1 sand, 2 rock where the topmost surface is one."""
    labels = surface_labels(hits, mesh)
    coded = np.zeros_like(labels)
    coded[labels == SAND], coded[labels == ROCK] = 1, 2
    return coded


def write_raster(
    path: str | os.PathLike[str],
    bands: Shaped[np.ndarray, "B H W"],
    raster: Raster,
    site_utm_m: tuple[float, float, float],
    crs: str,
    nodata: float | None = None,
) -> None:
    """Writes bands as a GeoTIFF, losslessly, whole or not at all.

    Raises:
        JaxmapError: the file cannot be written.
    """
    from rasterio import Affine
    from rasterio.io import MemoryFile

    west, north = raster.west_m + site_utm_m[0], raster.north_m + site_utm_m[1]
    profile: dict[str, Any] = dict(
        driver="GTiff",
        count=len(bands),
        height=raster.shape[0],
        width=raster.shape[1],
        dtype=bands.dtype.name,
        crs=crs,
        nodata=nodata,
        transform=Affine(raster.cell_m, 0.0, round(west, 6), 0.0, -raster.cell_m, round(north, 6)),
        compress="deflate",
        predictor=3 if bands.dtype.kind == "f" else 2,
    )
    with MemoryFile() as memory:
        with memory.open(**profile) as file:
            file.write(bands)
        content = bytes(memory.getbuffer())
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
