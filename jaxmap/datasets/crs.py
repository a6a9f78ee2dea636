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


def check_metres(name: str, path_m: Float64[np.ndarray, "N 3"]) -> None:
    """Refuses a system whose x and y are no metres: of degrees, of feet, or geocentric.

    Args:
        name: of the system that poses are said to be in.
        path_m: positions as the poses give them, from which the UTM zone of the place is told where they can.

    Raises:
        UsageError: x and y are no metres; the error names the UTM zone, where the place is known.
    """
    system = read_crs(name, "--crs")
    while system.is_bound and system.source_crs is not None:
        system = system.source_crs
    flat = system.sub_crs_list[0] if system.is_compound else system
    factors = [axis.unit_conversion_factor for axis in flat.axis_info[:2]]
    stretch = 1.0
    if not (flat.is_geographic or flat.is_geocentric) and all(abs(factor - 1) < 1e-9 for factor in factors):
        stretch = _stretch_at(flat, path_m)
        if abs(stretch - 1) < _MOST_STRETCH:
            return
    unit = next((axis.unit_name for axis in flat.axis_info), "another unit")
    kind = "geocentric, so that z is not up" if flat.is_geocentric else f"in units of a {unit}, and a map is in metres"
    if stretch != 1:
        kind = f"in metres that are {stretch:.2f} times too long there"
    if flat.ellipsoid is None or abs(flat.ellipsoid.semi_major_metre / _EARTH_M - 1) > 0.01:
        fix = "give the poses in a projected system of that body in metres, and name it with --crs"
    elif (zone := _zone_of(flat, path_m)) is not None:
        fix = f"transform the poses to the UTM zone of the place, {zone}, and give --crs {zone}"
    else:
        fix = (
            "name the system that the poses are in: the UTM zone of the place, EPSG:326ZZ (south: EPSG:327ZZ) with "
            "ZZ = floor((longitude + 180) / 6) + 1; or leave --crs out if they are local metres"
        )
    raise UsageError(f"{name[:60]} ({flat.name}) is {kind}", where="--crs", fix=fix)


_EARTH_M = 6_378_137.0
_LARGE_AREA_DEG = 15.0
_MOST_STRETCH = 0.05
"""Web Mercator stretches lengths by 1 / cos(latitude); polar systems by up to 3 % where they are used."""


def _stretch_at(system: pyproj.CRS, path_m: Float64[np.ndarray, "N 3"]) -> float:
    """How many times longer lengths are in a projected system than on the ground, at the first position.

    1 where the position is not in the area that the system is for: then it is local, and says nothing of the place.
    """
    import pyproj
    from pyproj.exceptions import ProjError

    try:
        projection = pyproj.Proj(system)
        longitude, latitude = projection(*path_m[0, :2], inverse=True)
        if not _is_inside(system, longitude, latitude):
            return 1.0
        factors = projection.get_factors(longitude, latitude)
        stretch = float(np.sqrt(factors.meridional_scale * factors.parallel_scale))
    except ProjError:
        return 1.0
    return stretch if np.isfinite(stretch) else 1.0


def _is_inside(system: pyproj.CRS, longitude_deg: float, latitude_deg: float) -> bool:
    area = system.area_of_use
    return area is None or (area.west <= longitude_deg <= area.east and area.south <= latitude_deg <= area.north)


def _zone_of(system: pyproj.CRS, path_m: Float64[np.ndarray, "N 3"]) -> str | None:
    """The UTM zone of positions in a system, or of the middle of the area that the system is for; None if unknown."""
    import pyproj

    x, y, z = path_m[0]
    area = system.area_of_use
    # Local metres about zero would be degrees near the Gulf of Guinea.
    spread = float(np.ptp(path_m[:, :2], axis=0).max())
    if system.is_geographic:
        known = spread < 0.1 and max(abs(x), abs(y)) > 1 and abs(x) <= 180 and abs(y) <= 90
    elif system.is_geocentric:
        known = abs(np.linalg.norm(path_m[0]) / _EARTH_M - 1) < 0.02
    else:
        known = max(abs(x), abs(y)) > 1e4
    if known:
        to_degrees = pyproj.Transformer.from_crs(
            system, "EPSG:4979" if system.is_geocentric else "EPSG:4326", always_xy=True
        )
        longitude, latitude, *_ = to_degrees.transform(x, y, z)
        if np.isfinite([longitude, latitude]).all() and (
            system.is_geocentric or _is_inside(system, longitude, latitude)
        ):
            return utm_crs(longitude, latitude)
    if area is not None and 0 <= area.east - area.west < _LARGE_AREA_DEG:
        return utm_crs((area.west + area.east) / 2, (area.south + area.north) / 2)
    return None


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
