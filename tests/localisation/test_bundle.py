"""Bundle adjustment, on points and cameras without images."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxmap.localisation.bundle import (
    Bundle,
    Sightings,
    _linearised,
    _moved,
    adjust,
    adjust_pose,
    errors_px,
    project,
    to_camera,
    to_world,
    triangulate,
)
from jaxmap.types import Pinhole

CAMERA = Pinhole(fx_px=500.0, fy_px=510.0, cx_px=320.0, cy_px=240.0, baseline_m=0.12, doffs_px=1.5)
seeds = st.integers(0, 2**31)


def made(seed: int, cameras: int = 4, points: int = 40, noise_px: float = 0.0) -> tuple[Bundle, Sightings]:
    """Cameras that drive towards points, and where they see them."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (cameras, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(cameras, 3)) * 0.05).as_matrix()
    T[:, :3, 3] = np.arange(cameras)[:, None] * [0.02, 0.01, 0.2]
    world = rng.uniform([-3, -2, 3], [3, 2, 12], (points, 3))
    seen = Sightings(np.repeat(np.arange(cameras), points), np.tile(np.arange(points), cameras), np.zeros((0, 3)))
    uvr_px = project(CAMERA, to_camera(T[seen.cameras], world[seen.points]))
    return Bundle(T, world), seen._replace(uvr_px=uvr_px + noise_px * rng.normal(size=uvr_px.shape))


def displaced(bundle: Bundle, seed: int) -> Bundle:
    """All but the first camera, and all points, a little elsewhere."""
    rng = np.random.default_rng(seed + 1)
    step = rng.normal(size=(len(bundle.T_world_camera), 6)) * [0.03, 0.03, 0.03, 0.01, 0.01, 0.01]
    step[0] = 0
    points = bundle.points_world * (1 + 0.02 * rng.normal(size=(len(bundle.points_world), 1)))
    return Bundle(_moved(bundle.T_world_camera, step), points)


@given(seeds)
def test_triangulation_undoes_projection(seed):
    points = np.random.default_rng(seed).uniform([-3, -2, 0.5], [3, 2, 30], (20, 3))
    np.testing.assert_allclose(triangulate(CAMERA, project(CAMERA, points)), points, rtol=1e-6, atol=1e-6)


def test_what_has_no_place_or_no_depth_is_nan():
    assert np.isnan(project(CAMERA, np.array([[0.0, 0, -1], [0, 0, 0]]))).all()
    assert np.isnan(triangulate(CAMERA, np.array([[10.0, 10, 20]]))).any()


@given(seeds)
def test_camera_and_world_are_inverse(seed):
    bundle, _ = made(seed)
    T = bundle.T_world_camera[1]
    np.testing.assert_allclose(to_world(T, to_camera(T, bundle.points_world)), bundle.points_world, atol=1e-9)


@settings(max_examples=10)
@given(seeds)
def test_without_noise_the_truth_is_found(seed):
    truth, seen = made(seed)
    found = adjust(CAMERA, displaced(truth, seed), seen, np.arange(4) == 0, 0.5, steps=30)
    np.testing.assert_allclose(found.T_world_camera, truth.T_world_camera, atol=1e-4)
    assert np.abs(errors_px(CAMERA, found, seen)).max() < 0.01


@settings(max_examples=10)
@given(seeds)
def test_adjusting_never_makes_it_worse_and_holds_what_is_fixed(seed):
    truth, seen = made(seed, noise_px=0.5)
    start, fixed = displaced(truth, seed), np.array([True, False, True, False])
    found = adjust(CAMERA, start, seen, fixed, 0.5, steps=4)
    np.testing.assert_array_equal(found.T_world_camera[fixed], start.T_world_camera[fixed])
    assert np.median(np.abs(errors_px(CAMERA, found, seen))) < np.median(np.abs(errors_px(CAMERA, start, seen)))


@settings(max_examples=10)
@given(seeds)
def test_wrong_matches_hardly_matter(seed):
    truth, seen = made(seed, noise_px=0.1)
    rng = np.random.default_rng(seed)
    wrong = rng.choice(len(seen.uvr_px), len(seen.uvr_px) // 10, replace=False)
    seen.uvr_px[wrong] += rng.uniform(20, 60, (len(wrong), 3))
    found = adjust(CAMERA, displaced(truth, seed), seen, np.arange(4) == 0, 0.3, steps=30)
    assert np.linalg.norm((found.T_world_camera - truth.T_world_camera)[:, :3, 3], axis=1).max() < 0.02


@settings(max_examples=10)
@given(seeds)
def test_one_camera_is_placed_among_known_points(seed):
    truth, seen = made(seed)
    start = displaced(truth, seed).T_world_camera[3]
    T = adjust_pose(CAMERA, start, truth.points_world, seen.uvr_px[seen.cameras == 3], 0.5, steps=20)
    np.testing.assert_allclose(T, truth.T_world_camera[3], atol=1e-5)


def test_the_derivatives_are_those_of_the_residuals():
    bundle, seen = made(3)
    # So wide a noise leaves all weights at 1.
    sigma_px = 1e3
    start = displaced(bundle, 3)
    residual, by_pose, by_point = _linearised(CAMERA, start, seen, sigma_px)
    for axis in range(6):
        step = np.zeros((4, 6))
        step[:, axis] = 1e-5
        moved = start._replace(T_world_camera=_moved(start.T_world_camera, step))
        slope = (_linearised(CAMERA, moved, seen, sigma_px)[0] - residual) / 1e-5
        np.testing.assert_allclose(by_pose[..., axis], slope, rtol=2e-2, atol=1e-3)
    for axis in range(3):
        moved = start._replace(points_world=start.points_world + 1e-5 * np.eye(3)[axis])
        slope = (_linearised(CAMERA, moved, seen, sigma_px)[0] - residual) / 1e-5
        np.testing.assert_allclose(by_point[..., axis], slope, rtol=2e-2, atol=1e-3)
