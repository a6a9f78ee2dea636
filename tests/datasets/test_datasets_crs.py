"""Latitude and longitude to UTM."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.datasets.crs import to_utm, utm_crs
from jaxmap.errors import JaxmapError


def reference_utm(longitude_deg: float, latitude_deg: float, meridian_deg: float) -> tuple[float, float]:
    """Krüger's series to the third order of n (Karney 2011, equations 7 to 11 and 35), northern hemisphere."""
    f = 1 / 298.257223563
    n, e = f / (2 - f), np.sqrt(f * (2 - f))
    phi, lam = np.radians(latitude_deg), np.radians(longitude_deg - meridian_deg)
    tau = np.tan(phi)
    sigma = np.sinh(e * np.arctanh(e * np.sin(phi)))
    conformal = tau * np.hypot(1, sigma) - sigma * np.hypot(1, tau)
    xi, eta = np.arctan2(conformal, np.cos(lam)), np.arcsinh(np.sin(lam) / np.hypot(conformal, np.cos(lam)))
    alpha = [n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16, 13 * n**2 / 48 - 3 * n**3 / 5, 61 * n**3 / 240]
    north = xi + sum(a * np.sin(2 * j * xi) * np.cosh(2 * j * eta) for j, a in enumerate(alpha, 1))
    east = eta + sum(a * np.cos(2 * j * xi) * np.sinh(2 * j * eta) for j, a in enumerate(alpha, 1))
    radius = 6378137 / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    return 500_000 + 0.9996 * radius * east, 0.9996 * radius * north


@given(st.floats(0.1, 5.9), st.floats(1, 80))
def test_utm_is_that_of_the_series(longitude, latitude):
    east, north = to_utm(utm_crs(longitude, latitude), np.array([longitude]), np.array([latitude]))
    np.testing.assert_allclose([east[0], north[0]], reference_utm(longitude, latitude, 3), atol=1e-3)


def test_katwijk_lies_in_zone_31_north():
    assert utm_crs(4.4, 52.2) == "EPSG:32631"
    east, north = to_utm("EPSG:32631", np.array([4.4003985435]), np.array([52.2141543786667]))
    np.testing.assert_allclose([east[0], north[0]], [595_676.32, 5_785_781.65], atol=0.01)


@pytest.mark.parametrize(
    ("longitude", "latitude", "crs"),
    [
        (-180, 1, "EPSG:32601"),
        (180, 1, "EPSG:32601"),
        (179.9, -1, "EPSG:32760"),
        (0, 0, "EPSG:32631"),
        (-0.1, 10, "EPSG:32630"),
    ],
)
def test_zones_are_six_degrees_wide(longitude, latitude, crs):
    assert utm_crs(longitude, latitude) == crs


def test_places_off_the_earth_are_reported():
    with pytest.raises(JaxmapError, match="is outside the domain of the projection in EPSG:32631"):
        to_utm("EPSG:32631", np.array([4.4]), np.array([1e5]))
