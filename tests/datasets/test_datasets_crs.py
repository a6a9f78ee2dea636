"""Latitude and longitude to UTM."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.datasets.crs import check_metres, to_utm, utm_crs
from jaxmap.errors import JaxmapError, UsageError


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


MARS = "+proj=eqc +a=3396190 +b=3396190 +units=m"
LOCAL = np.array([[0.0, 0.0, 1.5], [4.0, 6.0, 1.5]])
DEGREES = np.array([[4.4004, 52.2141, 3.0], [4.4005, 52.2142, 3.0]])
GEOCENTRIC = np.array([[3903000.0, 300000.0, 5018000.0]])
FEET = np.array([[985000.0, 195000.0, 30.0], [985020.0, 195010.0, 30.0]])


@pytest.mark.parametrize(
    ("name", "path", "what", "fix"),
    [
        ("EPSG:4326", LOCAL, "is in units of a degree", "EPSG:326ZZ"),
        ("EPSG:4326", DEGREES, "is in units of a degree", "--crs EPSG:32631"),
        ("EPSG:4258", DEGREES, "is in units of a degree", "--crs EPSG:32631"),
        ("EPSG:4978", GEOCENTRIC, "geocentric", "--crs EPSG:32631"),
        ("EPSG:4978", LOCAL, "geocentric", "EPSG:326ZZ"),
        ("EPSG:2263", FEET, "is in units of a US survey foot", "--crs EPSG:32618"),
        ("EPSG:2263", LOCAL, "is in units of a US survey foot", "--crs EPSG:32618"),
        ("EPSG:3857", np.array([[489_000.0, 6_841_000.0, 3.0]]), "metres that are 1.63 times too long", "EPSG:32631"),
        ("EPSG:4326+5773", LOCAL, "is in units of a degree", "EPSG:326ZZ"),
        (
            "+proj=longlat +a=3396190 +b=3376200 +no_defs",
            LOCAL,
            "is in units of a degree",
            "projected system of that body",
        ),
        ("+proj=utm +zone=31 +units=us-ft", LOCAL, "is in units of a US survey foot", "EPSG:326"),
    ],
)
def test_a_system_that_is_not_of_metres_is_refused_with_the_zone_of_the_place(name, path, what, fix):
    with pytest.raises(UsageError) as caught:
        check_metres(name, path)
    assert what in caught.value.what and fix in str(caught.value.fix)


@pytest.mark.parametrize(
    "name",
    [
        "EPSG:32631",
        "EPSG:3857",
        "EPSG:3031",
        "EPSG:28992",
        "EPSG:31467",
        "+proj=eqc +a=3396190 +b=3396190 +units=m",
        "EPSG:32631+5773",
    ],
)
def test_systems_of_metres_pass(name):
    check_metres(name, LOCAL)
