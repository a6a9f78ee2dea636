"""Laws of the camera models CAHV, CAHVOR and CAHVORE."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxmap.errors import JaxmapError
from jaxmap.geometry.cahv import CahvModel, make_cahv_model

WIDTH_PX, HEIGHT_PX, FOCAL_PX = 640, 480, 500.0

small = st.floats(-1, 1, allow_nan=False)
vectors = st.tuples(small, small, small).map(np.array)
rotations = vectors.map(lambda v: Rotation.from_rotvec(3 * v).as_matrix())


def camera(
    turn: np.ndarray, place: np.ndarray, tilt: np.ndarray, R, E, kind: int = 1, parameter: float = 1.0
) -> CahvModel:
    """A camera of 640 x 480 px whose lens is tilted a little against its image plane."""
    x, y, z = turn.T
    optical = Rotation.from_rotvec(0.02 * tilt).as_matrix() @ z
    H, V = FOCAL_PX * x + 310.3 * z, 1.01 * FOCAL_PX * y + 250.7 * z
    return make_cahv_model([place, z, H, V, optical, R, E], kind, parameter)


def pixels(step_px: int = 40) -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(0, WIDTH_PX, step_px), np.arange(0, HEIGHT_PX, step_px)), -1).astype(float)


def points_ahead(model: CahvModel, distance_m: float = 3.0) -> np.ndarray:
    origins, directions = model.rays(pixels())
    return origins + distance_m * directions


def plain_cahvor(model: CahvModel, points: np.ndarray) -> np.ndarray:
    """CAHVOR as Di and Li 2004 print it, equations 2 to 4."""
    p = points - model.C
    zeta = p @ model.O
    across = p - zeta[..., None] * model.O
    tau = (across**2).sum(-1) / zeta**2
    mu = model.R[0] + model.R[1] * tau + model.R[2] * tau**2
    bent = p + mu[..., None] * across
    return np.stack([bent @ model.H, bent @ model.V], -1) / (bent @ model.A)[..., None]


@given(rotations, vectors, vectors)
def test_cahv_is_a_pinhole(turn, place, offset):
    x, y, z = turn.T
    model = make_cahv_model([place, z, 500 * x + 310 * z, 505 * y + 250 * z])
    points = place + (turn @ (np.array([[0.3, -0.2, 1.0], [-0.5, 0.4, 2.0]]) + 0.1 * offset).T).T
    camera_points = (points - place) @ turn
    expected = camera_points[:, :2] / camera_points[:, 2:] * [500, 505] + [310, 250]
    np.testing.assert_allclose(model.project(points), expected, atol=1e-9)
    np.testing.assert_allclose(model.axes, turn, atol=1e-12)


@given(rotations, vectors, vectors)
def test_cahvor_without_radial_terms_is_cahv(turn, place, tilt):
    bent = camera(turn, place, tilt, np.zeros(3), np.zeros(3))
    straight = make_cahv_model([bent.C, bent.A, bent.H, bent.V])
    points = points_ahead(straight)
    np.testing.assert_allclose(bent.project(points), straight.project(points), atol=1e-8)


@given(rotations, vectors, vectors, vectors)
def test_cahvore_without_moving_pupil_is_cahvor(turn, place, tilt, radial):
    model = camera(turn, place, tilt, radial * [1e-4, 0.2, 0.02], np.zeros(3))
    points = points_ahead(model)
    np.testing.assert_allclose(model.project(points), plain_cahvor(model, points), atol=1e-8)


@settings(max_examples=60)
@given(
    rotations, vectors, vectors, vectors, vectors, st.sampled_from([(1, 1.0), (2, 0.0), (3, 0.5), (3, -0.4)]),
    st.floats(0.3, 1000),
)  # fmt: skip
def test_a_point_on_the_ray_of_a_pixel_is_seen_there(turn, place, tilt, radial, pupil, kind, distance_m):
    model = camera(turn, place, tilt, radial * [1e-4, 0.1, 0.02], 0.01 * pupil, *kind)
    origins, directions = model.rays(pixels())
    assert np.isfinite(directions).all()
    np.testing.assert_allclose(model.project(origins + distance_m * directions), pixels(), atol=1e-6)


@given(rotations, vectors, vectors, vectors)
def test_moving_camera_and_points_together_changes_nothing(turn, place, shift, tilt):
    model = camera(np.eye(3), place, tilt, [0, 0.1, 0.01], [0.01, 0.01, 0.01], 2)
    points = points_ahead(model)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn, shift
    moved = model.moved(T)
    np.testing.assert_allclose(moved.project(points @ turn.T + shift), model.project(points), atol=1e-8)


def test_a_part_averaged_over_blocks_sees_the_same():
    model = camera(np.eye(3), np.zeros(3), np.ones(3), [0, 0.1, 0.01], np.zeros(3))
    part = model.cropped((100, 60), (2, 4))
    # Block (10, 5) covers columns 120, 121 and rows 80 to 83.
    points = points_ahead(model)
    np.testing.assert_allclose(part.project(points), (model.project(points) - [100.5, 61.5]) / [2, 4], atol=1e-9)
    np.testing.assert_allclose(part.project(np.add(*model.rays(np.array([120.5, 81.5])))), [10, 5], atol=1e-9)


def test_a_fisheye_sees_what_a_pinhole_cannot():
    """A ray 80 degrees off the axis; the picture of an ideal fisheye is f theta from the centre."""
    model = make_cahv_model(
        [np.zeros(3), [0, 0, 1], [200, 0, 300], [0, 200, 300], [0, 0, 1], np.zeros(3), np.zeros(3)], 2
    )
    angle = np.radians(80)
    np.testing.assert_allclose(model.project(np.array([np.sin(angle), 0, np.cos(angle)])), [300 + 200 * angle, 300])


def test_what_the_lens_cannot_see_is_nan():
    model = camera(np.eye(3), np.zeros(3), np.zeros(3), [0, -0.4, 0], np.zeros(3))
    assert np.isnan(model.project(np.array([[0, 0, -1.0], [3.0, 0, 1], [np.nan, 0, 1]]))).all()
    assert np.isnan(model.rays(np.array([5000.0, 5000.0]))[1]).all()


@pytest.mark.parametrize(
    ("components", "kind", "says"),
    [
        ([np.zeros(3)] * 3, 1, "3 components"),
        ([np.zeros(3), np.zeros(2), np.ones(3), np.ones(3)], 1, "numbers"),
        ([np.zeros(3), [0, 0, 1], [np.nan, 0, 0], [0, 1, 0]], 1, "not finite"),
        ([np.zeros(3), [0, 0, 2], [1, 0, 0], [0, 1, 0]], 1, "lengths 2"),
        ([np.zeros(3), [0, 0, 1], [0, 1, 0], [1, 0, 0]], 1, "no camera"),
        ([np.zeros(3), [0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1], np.zeros(3), np.zeros(3)], 4, "type 4"),
    ],
)
def test_what_makes_no_camera_is_refused(components, kind, says):
    with pytest.raises(JaxmapError, match=says):
        make_cahv_model(components, kind)
