"""Laws of the pinhole cameras of the Ames Stereo Pipeline."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxmap.geometry.tsai import TsaiCamera

small = st.floats(-1, 1, allow_nan=False)
vectors = st.tuples(small, small, small).map(np.array)

TERMS = {
    "NULL": np.empty(0),
    "TSAI": np.array([-0.3, 0.12, -4e-4, 1e-3, -0.01]),
    # In mm of a sensor 6.4 mm wide.
    "BROWNCONRADY": np.array([0.02, -0.03, 2e-3, -3e-5, 1e-7, 1e-4, -2e-6, 0.3]),
}


def camera(lens: str, turn: np.ndarray, place: np.ndarray) -> TsaiCamera:
    """A sensor of 640 x 480 px of 0.01 mm, behind a lens of 5 mm."""
    turned = Rotation.from_rotvec(2 * turn).as_matrix()
    return TsaiCamera(place, turned, np.array([5.0, 5.05]), np.array([3.21, 2.38]), 0.01, lens, TERMS[lens])


@pytest.mark.parametrize("lens", TERMS)
@given(vectors, vectors, st.floats(0.3, 100))
def test_a_point_on_the_ray_of_a_pixel_is_seen_there(lens, turn, place, distance_m):
    model = camera(lens, turn, place)
    pixels = np.stack(np.meshgrid(np.arange(0, 640, 80), np.arange(0, 480, 80)), -1).astype(float)
    origins, directions = model.rays(pixels)
    np.testing.assert_allclose(model.project(origins + distance_m * directions), pixels, atol=1e-6)


@given(vectors, vectors)
def test_tsai_is_the_lens_of_opencv(turn, place):
    model = camera("TSAI", turn, place)
    points = place + np.array([[0.2, -0.1, 1.0], [-0.5, 0.4, 2.0], [0, 0, 3.0]]) @ model.axes.T
    K = np.array([[500, 0, 321], [0, 505, 238], [0, 0, 1]], float)
    # OpenCV takes small rotations for none, in one way but not in the other.
    R = model.axes.T
    turned = Rotation.from_matrix(R).as_rotvec()
    expected = cv2.projectPoints(points, turned, -R @ place, K, model.terms)[0][:, 0]
    np.testing.assert_allclose(model.project(points), expected, atol=1e-6)


def test_brown_conrady_straightens_as_the_manual_says():
    model = camera("BROWNCONRADY", np.zeros(3), np.zeros(3))
    xp, yp, k1, k2, k3, p1, p2, phi = model.terms
    x, y = 1.3 - 3.21 - xp, 4.1 - 2.38 - yp
    square = x**2 + y**2
    radial = k1 * square + k2 * square**2 + k3 * square**3
    centring = p1 * square + p2 * square**2
    straight = [(x + x * radial - centring * np.sin(phi)) / 5.0, (y + y * radial + centring * np.cos(phi)) / 5.05]
    ray = model.rays(np.array([130.0, 410.0]))[1]
    np.testing.assert_allclose(ray[:2] / ray[2], straight, atol=1e-12)


def test_a_coarser_image_has_a_greater_pitch():
    model = camera("TSAI", np.zeros(3), np.zeros(3))
    point = np.array([0.3, -0.2, 2.0])
    np.testing.assert_allclose(2 * replace(model, pitch=0.02).project(point), model.project(point))


def test_what_the_lens_cannot_see_is_nan():
    model = replace(camera("TSAI", np.zeros(3), np.zeros(3)), terms=np.array([-0.4, 0, 0, 0, 0]))
    assert np.isnan(model.project(np.array([[0, 0, -1.0], [3.0, 0, 1]]))).all()
    assert np.isnan(model.rays(np.array([5000.0, 240.0]))[1][:2]).all()
