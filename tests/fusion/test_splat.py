"""The soft splat: its laws, its twin, and its gradient."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_splat
from hypothesis import given
from strategies import BAD_NUMBERS, CLASSES, GRID_SHAPE, POINTS, grids, points_in, rngs

from jaxmap.fusion import integrate, splat
from jaxmap.geometry.grid import voxel_centres
from jaxmap.types import GridSpec, PointLabels

count_points = jax.jit(integrate.count_points, static_argnames="class_count")
inside_grid = jax.jit(splat.inside_grid)
KINDS = {
    "voxels": (jax.jit(splat.splat_trilinear), jax.jit(splat.sample_trilinear), (0, 1, 2)),
    "columns": (jax.jit(splat.splat_columns), jax.jit(splat.sample_columns), (0, 1)),
}
ALL = np.ones(POINTS, bool)


def kinds():
    return pytest.mark.parametrize("kind", KINDS)


@kinds()
@given(grids(), rngs())
def test_splat_equals_the_twin(kind, grid, rng):
    soft, _, axes = KINDS[kind]
    points, values, keep = points_in(grid, rng), rng.normal(size=(2, POINTS)), rng.random(POINTS) < 0.8
    ours = soft(grid, points, values.astype(np.float32), keep)
    np.testing.assert_allclose(ours, reference_splat.splat(grid, points, values, keep, axes), atol=1e-5)


@kinds()
@given(grids(), rngs())
def test_the_shares_of_a_point_in_the_grid_sum_to_one(kind, grid, rng):
    points = points_in(grid, rng)
    total = KINDS[kind][0](grid, points, np.ones((1, POINTS), np.float32), ALL).sum()
    np.testing.assert_allclose(total, np.asarray(inside_grid(grid, points)).sum(), rtol=1e-5)


@given(grids(), rngs())
def test_points_at_voxel_centres_are_splatted_as_by_the_hard_soft(grid, rng):
    centres = np.asarray(voxel_centres(grid)).reshape(-1, 3)
    points = centres[rng.integers(0, len(centres), POINTS)]
    weights = rng.integers(1, 5, POINTS).astype(np.float32)
    labels = PointLabels(keep=jnp.asarray(ALL), labels=jnp.zeros(POINTS, jnp.int32))
    hard = count_points(grid, points, labels, weights, class_count=len(CLASSES))[0]
    np.testing.assert_array_equal(KINDS["voxels"][0](grid, points, weights[None], ALL)[0], hard)


@kinds()
@given(grids(), rngs())
def test_sampling_is_the_transpose_of_splatting(kind, grid, rng):
    soft, sample, axes = KINDS[kind]
    points, values = points_in(grid, rng), rng.normal(size=(1, POINTS)).astype(np.float32)
    field = rng.normal(size=(1, *(GRID_SHAPE[axis] for axis in axes))).astype(np.float32)
    left = (np.asarray(soft(grid, points, values, ALL), np.float64) * field).sum()
    right = (np.asarray(sample(grid, field, points), np.float64) * values).sum()
    np.testing.assert_allclose(left, right, atol=1e-4)


@pytest.mark.slow
@kinds()
@pytest.mark.parametrize("bad", BAD_NUMBERS)
def test_points_and_values_that_are_no_numbers_are_left_out(kind, bad):
    rng = np.random.default_rng(3)
    grid = GridSpec(jnp.zeros(3), jnp.ones(3), GRID_SHAPE)
    points, values = points_in(grid, rng), rng.normal(size=(2, POINTS)).astype(np.float32)
    spoilt, shorter = points.copy(), ALL.copy()
    spoilt[::3, 1], shorter[::3] = bad, False
    soft = KINDS[kind][0]
    np.testing.assert_array_equal(soft(grid, spoilt, values, ALL), soft(grid, points, values, shorter))
    if not np.isfinite(bad):
        worthless = values.copy()
        worthless[1, ::3] = bad
        np.testing.assert_array_equal(soft(grid, points, worthless, ALL), soft(grid, points, values, shorter))
    gradient = jax.grad(lambda points: (soft(grid, points, values, ALL) ** 2).sum())(jnp.asarray(spoilt))
    assert np.isfinite(gradient).all()
    assert not np.asarray(gradient)[::3].any()


@pytest.mark.slow
@kinds()
@given(grids(), rngs())
def test_gradients_to_points_equal_finite_differences(kind, grid, rng):
    soft, _, axes = KINDS[kind]
    with jax.enable_x64(True):
        exact = GridSpec(
            jnp.asarray(grid.origin_m, jnp.float64), jnp.asarray(grid.voxel_size_m, jnp.float64), grid.shape
        )
        values = jnp.asarray(rng.normal(size=(2, POINTS)))
        field = jnp.asarray(rng.normal(size=(2, *(GRID_SHAPE[axis] for axis in axes))))

        def score(points):
            return (jnp.tanh(soft(exact, points, values, ALL)) * field).sum()

        # Clear of centres, where the shares have a kink, and of faces of the grid, where points come and go.
        points = jnp.asarray(points_in(grid, rng), jnp.float64) + 0.01 * exact.voxel_size_m
        direction = jnp.asarray(rng.normal(size=points.shape))
        slope = (score(points + 1e-7 * direction) - score(points - 1e-7 * direction)) / 2e-7
        np.testing.assert_allclose((jax.grad(score)(points) * direction).sum(), slope, rtol=1e-5, atol=1e-6)
