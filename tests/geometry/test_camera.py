from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import reference
from hypothesis import given
from hypothesis import strategies as st
from strategies import HEIGHT_PX, WIDTH_PX, cameras, disparities, poses, rngs

from jaxmap.geometry import camera as kernels
from jaxmap.types import make_stereo_camera

to_points = jax.jit(kernels.disparity_to_points)
to_pixels = jax.jit(kernels.points_to_pixels)
transform = jax.jit(kernels.transform_points)


@given(cameras(), rngs())
def test_points_equal_the_twin(camera, rng):
    disparity = disparities(rng, low_px=2.5)
    points, valid = to_points(camera, disparity)
    expected, expected_valid = reference.disparity_to_points(camera, disparity)
    np.testing.assert_array_equal(valid, expected_valid)
    np.testing.assert_allclose(points, expected, rtol=1e-5, atol=1e-5)


@given(cameras(), rngs())
def test_points_project_back_to_their_pixels(camera, rng):
    disparity = disparities(rng, low_px=2.5)
    points, valid = to_points(camera, disparity)
    u_px, v_px, back_px, in_front = to_pixels(camera, points)
    rows, columns = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    assert np.all(in_front)
    keep = np.asarray(valid)
    np.testing.assert_allclose(np.asarray(u_px)[keep], columns[keep], atol=1e-4)
    np.testing.assert_allclose(np.asarray(v_px)[keep], rows[keep], atol=1e-4)
    np.testing.assert_allclose(np.asarray(back_px)[keep], disparity[keep], rtol=1e-5, atol=1e-4)


@given(cameras(), rngs())
def test_pixels_equal_the_twin(camera, rng):
    points = rng.uniform(-4, 4, (64, 3)).astype(np.float32)
    points[np.abs(points[:, 2]) < 0.2, 2] = 0.0
    numbers, expected = to_pixels(camera, points), reference.points_to_pixels(camera, points)
    in_front = np.asarray(numbers[3])
    np.testing.assert_array_equal(in_front, expected[3])
    for ours, theirs in zip(numbers[:3], expected[:3], strict=True):
        np.testing.assert_allclose(np.asarray(ours)[in_front], theirs[in_front], rtol=1e-5, atol=2e-3)


@given(cameras(), st.floats(0.1, 50), st.floats(0.05, 3))
def test_depth_sigma_equals_the_twin_and_has_an_inverse(camera, depth_m, sigma_px):
    sigma_m = kernels.depth_sigma(camera, jnp.float32(depth_m), sigma_px)
    np.testing.assert_allclose(sigma_m, reference.depth_sigma(camera, depth_m, sigma_px), rtol=1e-5)
    np.testing.assert_allclose(kernels.depth_at_sigma(camera, float(sigma_m), sigma_px), depth_m, rtol=1e-4)


@given(cameras(), st.floats(3.0, 20.0))
def test_depth_sigma_is_the_slope_of_depth(camera, disparity_px):
    depth = lambda d: kernels.disparity_to_depth(camera, d)[0]  # noqa: E731
    slope = jax.grad(depth)(jnp.float32(disparity_px))
    np.testing.assert_allclose(-slope, kernels.depth_sigma(camera, depth(jnp.float32(disparity_px)), 1.0), rtol=1e-4)


@given(poses(), rngs())
def test_transform_equals_the_twin_and_has_an_inverse(T_a_b, rng):
    points_b = rng.uniform(-5, 5, (64, 3)).astype(np.float32)
    points_a = transform(T_a_b, points_b)
    np.testing.assert_allclose(points_a, reference.transform_points(T_a_b, points_b), atol=1e-5)
    np.testing.assert_allclose(transform(T_a_b.inverse(), points_a), points_b, atol=1e-5)


@given(cameras(), st.floats(1.0, 9.0), rngs())
def test_frustum_holds_every_point_in_range(camera, max_depth_m, rng):
    corners = np.asarray(kernels.frustum_corners(camera, max_depth_m))
    depth_m = rng.uniform(0.1, max_depth_m, (HEIGHT_PX, WIDTH_PX))
    disparity = float(camera.baseline_m) * float(camera.fx_px) / depth_m - float(camera.doffs_px)
    points, _ = reference.disparity_to_points(camera, disparity)
    assert np.all(points >= corners.min(axis=0) - 1e-4)
    assert np.all(points <= corners.max(axis=0) + 1e-4)


def test_offset_of_principal_points_moves_zero_disparity_off_infinity():
    camera = make_stereo_camera(
        fx_px=100, cx_px=10, cy_px=10, baseline_m=0.2, doffs_px=4.0, width_px=WIDTH_PX, height_px=HEIGHT_PX
    )
    depth_m, valid = kernels.disparity_to_depth(camera, jnp.array([0.0, -4.0, -5.0, 1.0]))
    np.testing.assert_array_equal(valid, [True, False, False, True])
    np.testing.assert_allclose(depth_m, [5.0, 1.0, 1.0, 4.0], rtol=1e-6)


def test_no_gradient_is_nan_where_disparity_means_nothing():
    camera = make_stereo_camera(fx_px=30, cx_px=15, cy_px=11, baseline_m=0.2, width_px=WIDTH_PX, height_px=HEIGHT_PX)
    for hole in (np.nan, 0.0, -1.0, np.inf, -np.inf):
        disparity = jnp.full((HEIGHT_PX, WIDTH_PX), hole)
        gradient = jax.grad(lambda *arguments: to_points(*arguments)[0].sum(), argnums=(0, 1))(camera, disparity)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient)), hole


def test_gradients_are_finite_behind_and_on_the_camera_plane():
    camera = make_stereo_camera(fx_px=30, cx_px=15, cy_px=11, baseline_m=0.2, width_px=WIDTH_PX, height_px=HEIGHT_PX)
    points = jnp.array([[1.0, 1.0, 0.0], [1.0, 1.0, -2.0], [0.0, 0.0, 3.0]])
    gradient = jax.grad(lambda p: sum(jnp.sum(x) for x in to_pixels(camera, p)[:3]))(points)
    assert np.isfinite(gradient).all()


def test_points_are_metric_in_a_case_done_by_hand():
    camera = make_stereo_camera(
        fx_px=100, fy_px=50, cx_px=10, cy_px=20, baseline_m=0.5, width_px=WIDTH_PX, height_px=HEIGHT_PX
    )
    points, _ = to_points(camera, np.full((HEIGHT_PX, WIDTH_PX), 25.0, np.float32))
    # Z = 0.5 * 100 / 25 = 2 m; ten pixels right of the centre, 20 rows above it.
    np.testing.assert_allclose(points[0, 20], [0.2, -0.8, 2.0], rtol=1e-6)
    T_world_camera = jaxlie.SE3.from_rotation_and_translation(
        jaxlie.SO3.from_rpy_radians(-np.pi / 2, 0.0, 0.0), jnp.array([0.0, 0.0, 1.1])
    )
    # A camera that looks along world y: z forward becomes +y, y down becomes -z.
    np.testing.assert_allclose(transform(T_world_camera, points)[0, 20], [0.2, 2.0, 1.9], atol=1e-6)
