from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import reference
from hypothesis import given
from hypothesis import strategies as st
from strategies import BAD_NUMBERS, GRID_SHAPE, HEIGHT_PX, WIDTH_PX, cameras, grids, points_in, poses, rngs

from jaxmap.geometry import grid as kernels
from jaxmap.geometry.camera import frustum_corners, transform_points
from jaxmap.types import make_grid, make_stereo_camera

to_voxel = jax.jit(kernels.world_to_voxel)
to_flat = jax.jit(kernels.flat_voxel_index)
see = jax.jit(kernels.view_window, static_argnames="shape")


@given(grids(), rngs())
def test_indices_equal_the_twin(grid, rng):
    points = points_in(grid, rng)
    points[:8, 0] = rng.choice(BAD_NUMBERS, 8)
    index, inside = to_voxel(grid, points)
    expected, expected_inside = reference.world_to_voxel(grid, points)
    np.testing.assert_array_equal(inside, expected_inside)
    np.testing.assert_array_equal(index, expected)


@given(grids())
def test_every_centre_lies_in_its_own_voxel(grid):
    centres = kernels.voxel_centres(grid)
    np.testing.assert_allclose(centres, reference.voxel_centres(grid), rtol=1e-6)
    index, inside = kernels.world_to_voxel(grid, centres)
    assert np.all(inside)
    np.testing.assert_array_equal(index, np.moveaxis(np.indices(GRID_SHAPE), 0, -1))


def test_a_voxel_owns_its_lower_faces_and_not_its_upper_ones():
    grid = make_grid([0, 0, 0], [2, 2, 2], 0.5)
    index, inside = kernels.world_to_voxel(grid, jnp.array([[0.0, 0.5, 1.0], [2.0, 0.0, 0.0], [-1e-6, 0.0, 0.0]]))
    np.testing.assert_array_equal(inside, [True, False, False])
    np.testing.assert_array_equal(index[0], [0, 1, 2])


@pytest.mark.parametrize("bad", BAD_NUMBERS)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_points_that_are_no_place_get_the_index_past_the_end(bad, axis):
    grid = make_grid([-1, -1, -1], [1, 1, 1], 0.5)
    point = np.zeros((1, 3), np.float32)
    point[0, axis] = bad
    assert to_flat(grid, point, jnp.array([True]))[0] == 64


@given(grids(), rngs())
def test_flat_indices_are_row_major(grid, rng):
    points = points_in(grid, rng)
    keep = rng.random(len(points)) < 0.8
    flat = np.asarray(to_flat(grid, points, keep))
    index, inside = reference.world_to_voxel(grid, points)
    expected = np.where(inside & keep, np.ravel_multi_index(index.T, GRID_SHAPE), np.prod(GRID_SHAPE))
    np.testing.assert_array_equal(flat, expected)


@given(cameras(doffs=False), poses(reach_m=30.0), st.floats(0.5, 6.0), st.sampled_from([0.2, 0.3, (0.4, 0.2, 0.1)]))
def test_view_window_holds_every_voxel_the_camera_can_reach(camera, T_world_camera, max_depth_m, size_m):
    grid = make_grid([-12, -10, -2], [12, 10, 2], size_m)
    shape = kernels.window_shape(grid, camera, max_depth_m)
    window = kernels.view_window(grid, camera, T_world_camera, max_depth_m, shape)
    start, stop = np.asarray(window.first), np.asarray(window.first) + shape
    assert np.all(start >= 0)
    assert np.all(stop <= grid.shape)
    assert window.shape == shape
    np.testing.assert_allclose(
        window.origin_m, reference.f64(grid.origin_m) + start * reference.f64(grid.voxel_size_m), atol=1e-5
    )
    rng = np.random.default_rng(0)
    depth_m = rng.uniform(0.05, max_depth_m, (HEIGHT_PX, WIDTH_PX))
    disparity = float(camera.baseline_m) * float(camera.fx_px) / depth_m
    points_camera, _ = reference.disparity_to_points(camera, disparity)
    points_world = reference.transform_points(T_world_camera, points_camera.reshape(-1, 3))
    index, inside = reference.world_to_voxel(grid, points_world)
    assert np.all((index[inside] >= start) & (index[inside] < stop))


@given(cameras(doffs=False), st.lists(poses(reach_m=8.0), min_size=1, max_size=3), st.floats(0.5, 6.0))
def test_a_window_for_known_poses_holds_their_views_and_is_no_larger_than_one_for_any_pose(camera, known, max_depth_m):
    grid = make_grid([-20, -20, -12], [20, 20, 12], (0.4, 0.2, 0.3))
    matrices = np.stack([reference.pose_matrix(pose) for pose in known])
    shape = kernels.window_shape(grid, camera, max_depth_m, matrices)
    assert np.all(np.array(shape) <= kernels.window_shape(grid, camera, max_depth_m))
    corners = frustum_corners(camera, max_depth_m)
    for pose in known:
        start = np.asarray(kernels.view_window(grid, camera, pose, max_depth_m, shape).first)
        # By the kernel, in float32: points are put into voxels by the same rounding that places the window.
        index, inside = map(np.asarray, to_voxel(grid, transform_points(pose, corners)))
        assert np.all((index[inside] >= start) & (index[inside] < start + shape))


def test_view_window_of_a_pose_that_is_no_place_stays_in_the_grid():
    camera = make_stereo_camera(fx_px=30, cx_px=15, cy_px=11, baseline_m=0.2, width_px=32, height_px=24)
    grid = make_grid([-10, -10, -2], [10, 10, 2], 0.5)
    shape = kernels.window_shape(grid, camera, 2.0)
    for bad in BAD_NUMBERS:
        pose = jaxlie.SE3.from_translation(jnp.array([bad, 0.0, 0.0]))
        start = np.asarray(see(grid, camera, pose, 2.0, shape=shape).first)
        assert np.all(start >= 0)
        assert np.all(start + shape <= grid.shape)


def test_window_is_no_larger_than_the_grid():
    camera = make_stereo_camera(fx_px=30, cx_px=15, cy_px=11, baseline_m=0.2, width_px=32, height_px=24)
    grid = make_grid([0, 0, 0], [1, 30, 1], 0.5)
    x, y, z = kernels.window_shape(grid, camera, 3.0)
    assert (x, z) == (2, 2)
    assert 6 < y < 60


@given(st.integers(1, 900), st.sampled_from([0.05, 0.1, 0.2, 0.25, 0.3]))
def test_a_span_of_n_voxels_makes_n_voxels(count, size_m):
    grid = make_grid([0, 0, 0], [count * size_m, size_m, size_m], size_m)
    assert grid.shape == (count, 1, 1)


@given(st.floats(-50, 50), st.floats(0.1, 40), st.floats(0.05, 2))
def test_grid_spans_its_bounds(lower_m, span_m, size_m):
    upper_m = lower_m + span_m
    grid = make_grid([lower_m] * 3, [upper_m] * 3, size_m)
    reached = lower_m + grid.shape[0] * size_m
    assert reached >= upper_m - 1e-5 * size_m
    assert reached < upper_m + size_m
