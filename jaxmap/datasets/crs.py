"""Coordinate reference systems: their names, and points and extents transformed between them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxmap.errors import JaxmapError, UsageError

if TYPE_CHECKING:
    import pyproj

Points = Float64[np.ndarray, "*s"]
Transform = Callable[[Points, Points], tuple[Points, Points]]
"""Takes x (east, or longitude) and y (north, or latitude) of one system to those of another."""

_EDGE_POINTS = 21


class Extent(NamedTuple):
    """A box in the units of a coordinate reference system (None: unknown)."""

    west: float
    south: float
    east: float
    north: float
    crs: str | None = None

    def overlaps(self, other: Extent) -> bool:
        """Whether two boxes of the same system overlap."""
        return (
            self.west < other.east and other.west < self.east and self.south < other.north and other.south < self.north
        )

    def grown(self, margin: float) -> Extent:
        """The box with a margin on all sides."""
        return Extent(self.west - margin, self.south - margin, self.east + margin, self.north + margin, self.crs)

    def text(self) -> str:
        """The box as text."""
        west, south, east, north = (f"{value:.9g}" for value in self[:4])
        return f"{west} to {east} east, {south} to {north} north"


def read_crs(name: str, where: object) -> pyproj.CRS:
    """The coordinate reference system of a name (EPSG:32631), WKT or PROJ string.

    Raises:
        JaxmapError: it is unknown.
    """
    import pyproj
    from pyproj.exceptions import CRSError

    try:
        return pyproj.CRS.from_user_input(name)
    except CRSError as error:
        raise JaxmapError(
            f"unknown coordinate reference system {name[:60]!r}", where=where, fix='give a name such as "EPSG:32631"'
        ) from error


def check_crs(name: str) -> None:
    """Checks the `--crs` of a user with GDAL, which writes it into GeoTIFFs.

    Raises:
        UsageError: it is unknown.
    """
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        CRS.from_user_input(name)
    except (CRSError, ValueError) as error:
        raise UsageError(
            f"{name!r} is not a coordinate reference system", where="--crs", fix="give EPSG:NUMBER"
        ) from error


def crs_text(name: str | None) -> str:
    """A short name of a system: `EPSG:32631` where it has one."""
    if name is None:
        return "no CRS"
    system = read_crs(name, "coordinate reference system")
    authority = system.to_authority(min_confidence=70)
    return ":".join(authority) if authority else system.name


def transform_between(source: str | None, target: str | None, where: object) -> Transform:
    """The transform of points between two systems; the identity if they are the same or one of them is unknown.

    x is always east or longitude, whatever order the authority prescribes. Points outside the domain of the target
    become infinite.

    Raises:
        JaxmapError: an unknown name, or no transform between the two.
    """
    if source is None or target is None or source == target:
        return lambda x, y: (x, y)
    import pyproj
    from pyproj.exceptions import ProjError

    known = read_crs(source, where), read_crs(target, where)
    if known[0] == known[1]:
        return lambda x, y: (x, y)
    try:
        transformer = pyproj.Transformer.from_crs(*known, always_xy=True)
    except ProjError as error:
        raise JaxmapError(
            f"no transform from {known[0].name} to {known[1].name}", where=where, fix="reproject the ground truth"
        ) from error

    def transform(x: Points, y: Points) -> tuple[Points, Points]:
        moved_x, moved_y = transformer.transform(x, y)
        return np.asarray(moved_x), np.asarray(moved_y)

    return transform


def extent_in(extent: Extent, crs: str | None, where: object) -> Extent:
    """The bounding box of an extent in another system, from a grid of points.

    Raises:
        JaxmapError: it lies outside the domain of the other system.
    """
    along = np.linspace(0.0, 1.0, _EDGE_POINTS)
    x = extent.west + (extent.east - extent.west) * along
    y = extent.south + (extent.north - extent.south) * along
    # Inside too: an extent over a pole has its extreme there.
    grid_x, grid_y = np.meshgrid(x, y)
    moved_x, moved_y = transform_between(extent.crs, crs, where)(grid_x.ravel(), grid_y.ravel())
    fine = np.isfinite(moved_x) & np.isfinite(moved_y)
    if not fine.any():
        raise JaxmapError(
            f"the extent {extent.text()} lies outside the domain of {crs_text(crs)}",
            where=where,
            fix="check the coordinate reference systems",
        )
    return Extent(
        float(moved_x[fine].min()),
        float(moved_y[fine].min()),
        float(moved_x[fine].max()),
        float(moved_y[fine].max()),
        crs,
    )


def utm_crs(longitude_deg: float, latitude_deg: float) -> str:
    """The UTM zone of a place on WGS 84, `EPSG:326ZZ` (north) or `EPSG:327ZZ` (south).

    Zones are 6 degrees wide from 180 degrees west on; the exceptions of Norway and Svalbard are ignored.
    """
    zone = int(math.floor((longitude_deg + 180) / 6) % 60) + 1
    return f"EPSG:{326 if latitude_deg >= 0 else 327}{zone:02d}"


def to_utm(
    crs: str, longitude_deg: Float64[np.ndarray, "N"], latitude_deg: Float64[np.ndarray, "N"]
) -> tuple[Float64[np.ndarray, "N"], Float64[np.ndarray, "N"]]:
    """Easting and northing in m, by PROJ.

    Raises:
        JaxmapError: a place lies outside the domain of the projection.
    """
    # Imported here: it loads PROJ's database, which no other reader needs.
    from pyproj import Transformer

    easting_m, northing_m = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(
        longitude_deg, latitude_deg
    )
    if not (np.isfinite(easting_m).all() and np.isfinite(northing_m).all()):
        raise JaxmapError(
            "a latitude or longitude is outside the domain of the projection", where=crs, fix="correct the GPS file"
        )
    return np.asarray(easting_m), np.asarray(northing_m)
