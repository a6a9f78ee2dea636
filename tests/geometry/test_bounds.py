"""The automatic range and bounds hold all that can be mapped, and the advice on memory fits."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import pose
from strategies import rngs

from jaxmap.errors import JaxmapError
from jaxmap.geometry.bounds import check_memory, grid_around_views, map_bytes, usable_depth
from jaxmap.types import make_grid, make_stereo_camera

CAMERA = make_stereo_camera(fx_px=140.0, cx_px=70.0, cy_px=63.0, baseline_m=0.12, width_px=160, height_px=120)
GIB = 2**30


def turned(rng: np.random.Generator, count: int) -> np.ndarray:
    """Poses that look everywhere."""
    T = np.tile(np.eye(4), (count, 1, 1))
    for matrix in T:
        Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        matrix[:3, :3] = Q * np.sign(np.linalg.det(Q))
        matrix[:3, 3] = rng.uniform(-20, 20, 3)
    return T


@given(rngs(), st.floats(0.5, 30), st.floats(0.05, 0.5))
def test_the_grid_holds_every_point_in_range_of_every_pose(rng, max_depth_m, size_m):
    T = turned(rng, 3)
    below_m, above_m = rng.uniform(0.5, 5, 2)
    grid = grid_around_views(CAMERA, T, max_depth_m, size_m, (below_m, above_m))
    lower = np.asarray(grid.origin_m, np.float64)
    upper = lower + np.array(grid.shape) * np.asarray(grid.voxel_size_m, np.float64)
    u_px, v_px = rng.uniform(-0.5, 159.5, 200), rng.uniform(-0.5, 119.5, 200)
    depth_m = rng.uniform(0, max_depth_m, 200)
    points = np.stack([(u_px - 70) / 140 * depth_m, (v_px - 63) / 140 * depth_m, depth_m], axis=1)
    world = np.einsum("nij,kj->nki", T[:, :3, :3], points) + T[:, None, :3, 3]
    heights = T[:, 2, 3]
    wanted = (world[..., 2] >= heights.min() - below_m) & (world[..., 2] <= heights.max() + above_m)
    slack = 1e-4
    assert ((world >= lower - slack) & (world <= upper + slack)).all(axis=-1)[wanted].all()


@given(rngs(), st.floats(0.05, 0.5))
def test_the_grid_lies_on_whole_voxels_and_is_no_larger_than_needed(rng, size_m):
    T = turned(rng, 2)
    grid = grid_around_views(CAMERA, T, 4.0, size_m, (3.0, 2.0))
    lower = np.asarray(grid.origin_m, np.float64)
    np.testing.assert_allclose(lower / size_m, np.rint(lower / size_m), atol=1e-3)
    height_m = T[:, 2, 3].max() - T[:, 2, 3].min() + 5.0
    assert grid.shape[2] * size_m <= height_m + 2 * size_m + 1e-3
    reach_m = 4.0 * np.sqrt(1 + (90 / 140) ** 2 + (63.5 / 140) ** 2)
    span_m = np.ptp(T[:, :2, 3], axis=0) + 2 * reach_m
    assert (np.array(grid.shape[:2]) * size_m <= span_m + 2 * size_m).all()


def test_voxels_may_be_flat():
    T = np.stack([pose(index) for index in range(3)])
    grid = grid_around_views(CAMERA, T, 4.0, (0.2, 0.1, 0.05), (3.0, 2.0))
    np.testing.assert_allclose(grid.voxel_size_m, [0.2, 0.1, 0.05])


@given(st.floats(0.05, 2), st.floats(0.1, 2))
def test_depth_noise_reaches_the_limit_at_the_usable_depth(max_sigma_m, sigma_px):
    depth_m = usable_depth(CAMERA, max_sigma_m, sigma_px)
    np.testing.assert_allclose(depth_m * 10, np.rint(depth_m * 10), atol=1e-6)

    def sigma_at(depth_m: float) -> float:
        return depth_m**2 * sigma_px / (0.12 * 140)

    assert sigma_at(depth_m) <= max_sigma_m * (1 + 1e-5)
    assert sigma_at(depth_m + 0.1) > max_sigma_m * (1 - 1e-5)


@given(
    st.tuples(st.floats(10, 200), st.floats(10, 200), st.floats(2, 10)),
    st.floats(0.02, 0.1) | st.tuples(*[st.floats(0.02, 0.1)] * 3),
    st.integers(0, 5),
    st.floats(1e-3, 1e-1),
)
def test_the_advised_voxel_size_fits(span_m, size_m, classes, limit_gib):
    grid = make_grid((0, 0, 0), span_m, size_m)
    try:
        check_memory(grid, classes, limit_gib)
    except JaxmapError as error:
        assert map_bytes(grid, classes) > limit_gib * GIB
        advised = [float(edge) for edge in re.search(r"voxel-size-m ([0-9. e+-]+)\)", str(error)).group(1).split()]
        check_memory(make_grid((0, 0, 0), span_m, advised if len(advised) == 3 else advised[0]), classes, limit_gib)
    else:
        assert map_bytes(grid, classes) <= limit_gib * GIB


def test_the_advice_is_followed_to_the_end_on_a_real_site():
    grid = make_grid((-40, -40, -3), (40, 40, 2), 0.05)
    with pytest.raises(JaxmapError, match=r"voxel-size-m 0\.1\)") as caught:
        check_memory(grid, 3, 0.5)
    assert "3.8 GiB" in str(caught.value)
    check_memory(make_grid((-40, -40, -3), (40, 40, 2), 0.1), 3, 0.5)


def test_no_count_of_voxels_is_too_large_to_be_refused():
    grid = make_grid((0, 0, 0), (5, 5, 2), 1e-6)
    assert map_bytes(grid, 3) == 16 * 5_000_000 * 5_000_000 * 2_000_000
    with pytest.raises(JaxmapError, match="GiB"):
        check_memory(grid, 3, 2.0)


def test_a_limit_that_no_map_fits_is_told_too():
    with pytest.raises(JaxmapError, match="over the limit"):
        check_memory(make_grid((0, 0, 0), (5, 5, 2), 0.1), 3, 1e-6, members=1024)


def test_one_channel_of_float32_for_occupancy_and_each_class():
    assert map_bytes(make_grid((0, 0, 0), (1, 2, 3), 1.0), 3) == 4 * 4 * 6
