"""Heights of columns: their statistics against a slow twin, how they add up, and what is read from them."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_hazards

from jaxmap.errors import JaxmapError
from jaxmap.fusion.params import make_fusion_params
from jaxmap.fusion.surface import add_heights, combine, gather_heights, over_layers, read_surface
from jaxmap.mapping.store import MapAttributes, load_map, save_map
from jaxmap.types import VoxelMap, make_grid, make_voxel_map

pytestmark = pytest.mark.slow
LOWER, CELL_M, SHAPE = np.array([0.0, 0.0, -1.0]), np.array([0.1, 0.1, 0.2]), (12, 9, 10)
GRID = make_grid(LOWER.tolist(), (LOWER + CELL_M * SHAPE).tolist(), CELL_M.tolist())


within = jax.jit(gather_heights)


def gather(grid, points, sigma_m, keep):
    """Heights of a whole grid."""
    return within(grid, grid, points, sigma_m, keep)


def drawn(seed: int, count: int = 3000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    points = rng.uniform(LOWER - 0.05, LOWER + CELL_M * SHAPE + 0.05, (count, 3)).astype(np.float32)
    return points, rng.uniform(0.005, 0.1, count).astype(np.float32), rng.random(count) < 0.8


def assert_close(one, other) -> None:
    np.testing.assert_allclose(one, other, rtol=2e-4, atol=2e-4)


def test_statistics_equal_the_twin():
    points, sigma_m, keep = drawn(0)
    assert_close(
        over_layers(gather(GRID, points, sigma_m, keep)),
        reference_hazards.heights(points, sigma_m, keep, LOWER, CELL_M, SHAPE),
    )


def test_statistics_of_parts_are_those_of_all_in_any_order():
    points, sigma_m, keep = drawn(1)
    part = np.arange(len(points)) % 3
    parts = [gather(GRID, points, sigma_m, keep & (part == number)) for number in range(3)]
    whole = gather(GRID, points, sigma_m, keep)
    assert_close(combine(combine(parts[0], parts[1]), parts[2]), whole)
    assert_close(combine(parts[2], combine(parts[1], parts[0])), whole)
    np.testing.assert_array_equal(combine(whole, jnp.zeros_like(whole)), whole)
    np.testing.assert_array_equal(combine(jnp.zeros_like(whole), whole), whole)
    np.testing.assert_array_equal(combine(np.asarray(parts[0]), np.asarray(parts[1])), combine(parts[0], parts[1]))


def test_points_that_are_no_points_leave_nothing():
    points, sigma_m, keep = drawn(2)
    spoilt = np.concatenate([points, [[np.nan, 0.5, 0], [0.5, 0.5, np.nan], [0.5, 0.5, 99], [0.5, 0.5, 0]]])
    more = gather(
        GRID,
        spoilt.astype(np.float32),
        np.concatenate([sigma_m, [0.1, 0.1, 0.1, np.nan]]).astype(np.float32),
        np.concatenate([keep, np.ones(4, bool)]),
    )
    assert_close(more, gather(GRID, points, sigma_m, keep))


@pytest.mark.parametrize("height", [10, 40, 64])
@pytest.mark.parametrize("first", [0, 5, 15])
def test_a_window_holds_what_the_whole_grid_does(height, first):
    tall = replace(GRID, first=jnp.array([0, 0, first - 16]), shape=(*SHAPE[:2], height))
    rng = np.random.default_rng(3)
    lattice = rng.uniform(0, 1, (3000, 3)) * [*SHAPE[:2], height] + np.asarray(tall.first)
    points = (np.asarray(GRID.lattice_m) + lattice * CELL_M).astype(np.float32)
    sigma_m, all_of_them = np.full(3000, 0.02, np.float32), np.ones(3000, bool)
    so_far = gather(tall, points[::-1] + np.float32(0.01), sigma_m, all_of_them)
    before = replace(make_voxel_map(tall, (), surface=True), surface=so_far)
    for offset, levels in ((0, height), (height - 2, 2), (height // 2, 3), (1, height - 1)):
        window = replace(tall, first=tall.first + jnp.array([3, 2, offset]), shape=(5, 5, levels))
        level = np.floor(lattice - np.asarray(window.first))
        inside = ((level >= 0) & (level < window.shape)).all(axis=1)
        after = add_heights(before, within(tall, window, points, sigma_m, all_of_them), window)
        assert_close(after, combine(so_far, gather(tall, points, sigma_m, inside)))


def flat_map(height_m: float, count: int, noise_m: float = 0.01) -> VoxelMap:
    """Level ground, every column of it seen by so many points."""
    rng = np.random.default_rng(5)
    grid = make_grid([0, 0, height_m - 1.01], [0.8, 0.8, height_m + 0.99], [0.1, 0.1, 0.2])
    x, y = np.meshgrid(np.arange(8) * 0.1 + 0.05, np.arange(8) * 0.1 + 0.05)
    places = np.stack([x.ravel(), y.ravel(), np.full(64, height_m)], axis=-1).repeat(count, axis=0)
    places[:, 2] += rng.normal(0, noise_m, len(places))
    heights = gather(grid, jnp.asarray(places, jnp.float32), jnp.full(len(places), 0.01), jnp.ones(len(places), bool))
    log_odds = jnp.zeros((1, 8, 8, 10)).at[0, :, :, 5].set(2.0)
    return replace(make_voxel_map(grid, ()), log_odds=log_odds, surface=heights)


@pytest.mark.parametrize("height_m", [0.0, 300.0])
def test_heights_are_far_finer_than_voxels_however_high_the_ground(height_m):
    surface = read_surface(flat_map(height_m, 200), make_fusion_params(()))
    assert surface.known.all()
    np.testing.assert_allclose(surface.height_m, height_m, atol=0.003)
    assert (np.asarray(surface.sigma_m) < 0.015).all()
    coarse = read_surface(replace(flat_map(height_m, 200), surface=None), make_fusion_params(()))
    np.testing.assert_allclose(coarse.sigma_m, 0.2 / np.sqrt(12), rtol=1e-5)


def test_a_height_of_few_points_is_known_with_those_of_its_neighbours_alone():
    sparse = flat_map(0.0, 2)
    assert not read_surface(sparse, make_fusion_params(())).known.any()
    assert read_surface(sparse, make_fusion_params(()), reach=2).known.all()


def test_a_height_apart_from_what_is_occupied_is_not_known():
    ground = flat_map(0.0, 200)
    higher = jnp.asarray(ground.surface).at[2].add(1.0)
    assert not read_surface(replace(ground, surface=higher), make_fusion_params(())).known.any()
    assert not read_surface(replace(ground, log_odds=-ground.log_odds), make_fusion_params(())).known.any()


def test_heights_are_stored_and_damage_to_them_is_found(tmp_path):
    ground = flat_map(0.0, 20)
    save_map(tmp_path / "map.zarr", ground, MapAttributes())
    read, _ = load_map(tmp_path / "map.zarr")
    np.testing.assert_array_equal(read.surface, ground.surface)
    with pytest.raises(JaxmapError, match="not finite"):
        save_map(
            tmp_path / "map.zarr", replace(ground, surface=jnp.full_like(ground.surface, jnp.nan)), MapAttributes()
        )
