"""Latitude and longitude to UTM."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64

from jaxmap.errors import JaxmapError


def utm_crs(longitude_deg: float, latitude_deg: float) -> str:
    """The UTM zone of a place on WGS 84, as `EPSG:326ZZ` (north) or `EPSG:327ZZ` (south).

    Zones are 6 degrees wide from 180 degrees west on; the exceptions of Norway and Svalbard are not made.
    """
    zone = int(math.floor((longitude_deg + 180) / 6) % 60) + 1
    return f"EPSG:{326 if latitude_deg >= 0 else 327}{zone:02d}"


def to_utm(
    crs: str, longitude_deg: Float64[np.ndarray, "N"], latitude_deg: Float64[np.ndarray, "N"]
) -> tuple[Float64[np.ndarray, "N"], Float64[np.ndarray, "N"]]:
    """Easting and northing in m, by PROJ.

    Raises:
        JaxmapError: a place lies outside what the projection can do.
    """
    # Loads PROJ's database, which no other reader needs.
    from pyproj import Transformer

    easting_m, northing_m = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(
        longitude_deg, latitude_deg
    )
    if not (np.isfinite(easting_m).all() and np.isfinite(northing_m).all()):
        raise JaxmapError("a latitude or longitude has no place on the map", where=crs, fix="correct the GPS file")
    return np.asarray(easting_m), np.asarray(northing_m)
