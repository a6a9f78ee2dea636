from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import reference
from hypothesis import given
from hypothesis import strategies as st
from strategies import HEIGHT_PX, WIDTH_PX, cameras, poses, rngs

from jaxmap.fusion import carve as kernels
from jaxmap.fusion.params import make_fusion_params
from jaxmap.types import GridSpec, make_grid, make_stereo_camera

see_through = jax.jit(kernels.carve, static_argnames="depth_range_m")
CAMERA = make_stereo_camera(fx_px=30, cx_px=15.5, cy_px=11.5, baseline_m=0.2, width_px=WIDTH_PX, height_px=HEIGHT_PX)
SHARP = make_fusion_params((), disparity_sigma_px=1e-4)


@st.composite
def views(draw: st.DrawFn) -> tuple[GridSpec, jaxlie.SE3, np.ndarray, np.ndarray]:
    """A grid about a camera, and a depth image with holes."""
    size_m = [draw(st.sampled_from([0.2, 0.4, 0.7])) for _ in range(3)]
    grid = GridSpec(jnp.asarray([-2.5, -2.5, -1.5]), jnp.asarray(size_m), (8, 7, 5))
    rng = draw(rngs())
    depth_m = rng.uniform(0.5, 6.0, (HEIGHT_PX, WIDTH_PX)).astype(np.float32)
    return grid, draw(poses(reach_m=1.5)), depth_m, rng.random(depth_m.shape) < 0.9


@given(cameras(), views(), st.sampled_from([0.01, 0.5]), st.sampled_from([(0.0, float("inf")), (0.4, 3.0)]))
def test_free_space_equals_the_twin(camera, view, sigma_px, depth_range_m):
    grid, pose, depth_m, valid = view
    params = make_fusion_params((), disparity_sigma_px=sigma_px)
    free = np.asarray(see_through(camera, pose, depth_m, valid, grid, params, depth_range_m=depth_range_m))
    expected = reference.carve(camera, pose, depth_m, valid, grid, params, depth_range_m)
    np.testing.assert_array_equal(free[expected.sure], expected.free[expected.sure])


@given(cameras(), views(), st.tuples(*[st.integers(0, 3)] * 3))
def test_through_a_window_the_same_voxels_are_free_bit_for_bit(camera, view, start):
    grid, pose, depth_m, valid = view
    whole = np.asarray(see_through(camera, pose, depth_m, valid, grid, SHARP))
    shape = (5, 4, 2)
    part = replace(grid, first=jnp.asarray(start, jnp.int32), shape=shape)
    free = np.asarray(see_through(camera, pose, depth_m, valid, part, SHARP))
    box = tuple(slice(s, s + n) for s, n in zip(start, shape, strict=True))
    np.testing.assert_array_equal(free, whole[box])


@given(cameras(), views())
def test_no_voxel_that_is_out_of_view_or_not_before_its_surface_is_freed(camera, view):
    grid, pose, depth_m, valid = view
    free = np.asarray(see_through(camera, pose, depth_m, valid, grid, SHARP))
    centres = reference.transform_points(pose.inverse(), reference.voxel_centres(grid))[free]
    u_px, v_px, _, _ = reference.points_to_pixels(camera, centres)
    column, row = np.rint(u_px).astype(int), np.rint(v_px).astype(int)
    assert np.all(centres[:, 2] > 0)
    assert np.all((u_px >= -0.51) & (u_px <= WIDTH_PX - 0.49) & (v_px >= -0.51) & (v_px <= HEIGHT_PX - 0.49))
    column, row = column.clip(0, WIDTH_PX - 1), row.clip(0, HEIGHT_PX - 1)
    assert np.all(valid[row, column])
    # The whole voxel, not only its centre, is nearer than the surface.
    half_diagonal = 0.5 * np.linalg.norm(reference.f64(grid.voxel_size_m))
    assert np.all(centres[:, 2] + half_diagonal <= depth_m[row, column] + 1e-4)


@given(cameras(), views())
def test_no_voxel_that_holds_the_surface_seen_at_its_pixel_is_freed(camera, view):
    grid, pose, depth_m, valid = view
    free = np.asarray(see_through(camera, pose, depth_m, valid, grid, SHARP))
    disparity = reference.f64(camera.baseline_m) * float(camera.fx_px) / depth_m - float(camera.doffs_px)
    points = reference.transform_points(pose, reference.disparity_to_points(camera, disparity)[0])
    index, inside = reference.world_to_voxel(grid, points)
    centres = reference.transform_points(pose.inverse(), reference.voxel_centres(grid))
    u_px, v_px, _, _ = reference.points_to_pixels(camera, centres)
    rows, columns = np.nonzero(inside & valid)
    for row, column in zip(rows, columns, strict=True):
        voxel = tuple(index[row, column])
        if np.rint(u_px[voxel]) == column and np.rint(v_px[voxel]) == row:
            assert not free[voxel]


@given(st.floats(2.0, 6.0), st.sampled_from([1e-4, 0.2, 0.5]))
def test_before_a_fronto_parallel_wall_all_in_view_is_free_up_to_the_margin(wall_m, sigma_px):
    # Camera and world axes coincide: the grid's third axis is depth.
    grid = make_grid([-0.5, -0.4, 0.0], [0.5, 0.4, 7.0], 0.1)
    params = make_fusion_params((), disparity_sigma_px=sigma_px)
    depth_m, valid = np.full((HEIGHT_PX, WIDTH_PX), wall_m, np.float32), np.ones((HEIGHT_PX, WIDTH_PX), bool)
    free = np.asarray(see_through(CAMERA, jaxlie.SE3.identity(), depth_m, valid, grid, params))
    centres = reference.voxel_centres(grid)
    margin_m = 0.05 * np.sqrt(3) + 2 * reference.depth_sigma(CAMERA, wall_m, sigma_px)
    x, y, z = np.moveaxis(centres, -1, 0)
    in_view = (np.abs(x / z * 30) < 15.99) & (np.abs(y / z * 30) < 11.99)
    out_of_view = (np.abs(x / z * 30) > 16.01) | (np.abs(y / z * 30) > 12.01)
    assert free[in_view & (z < wall_m - margin_m - 1e-3)].all()
    assert not free[out_of_view | (z > wall_m - margin_m + 1e-3)].any()


def test_where_nothing_was_measured_nothing_is_free():
    grid = make_grid([-2, -2, -2], [2, 2, 4], 0.5)
    depth_m = np.full((HEIGHT_PX, WIDTH_PX), 5.0, np.float32)
    nowhere = np.zeros(depth_m.shape, bool)
    assert not np.asarray(see_through(CAMERA, jaxlie.SE3.identity(), depth_m, nowhere, grid, SHARP)).any()
    assert not np.asarray(see_through(CAMERA, jaxlie.SE3.identity(), depth_m * np.nan, ~nowhere, grid, SHARP)).any()


def test_a_measurement_at_infinity_frees_nothing_by_chance():
    grid = make_grid([-2, -2, -2], [2, 2, 4], 0.5)
    depth_m, valid = np.full((HEIGHT_PX, WIDTH_PX), np.inf, np.float32), np.ones((HEIGHT_PX, WIDTH_PX), bool)
    assert not np.asarray(see_through(CAMERA, jaxlie.SE3.identity(), depth_m, valid, grid, SHARP)).any()
