"""Hazards of terrains whose hazards are known, and against a slow twin."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_hazards

from jaxmap.planning.hazards import Hazards, Heights, disc_of, grown, measure_hazards, shares

pytestmark = pytest.mark.slow
CELL_M, RADIUS_M, GAP_M, SHAPE = (0.1, 0.1), 0.45, 0.125, (36, 32)
X, Y = (0.1 * np.arange(count) for count in SHAPE)
X, Y = np.meshgrid(X, Y, indexing="ij")


def measured(height_m: np.ndarray, *, sigma_m: float | np.ndarray = 0.0, known: np.ndarray | None = None) -> Hazards:
    known = np.ones(height_m.shape, bool) if known is None else known
    sigma_m = np.broadcast_to(np.float32(sigma_m), height_m.shape)
    heights = Heights(jnp.asarray(height_m, jnp.float32), jnp.asarray(sigma_m), jnp.asarray(known))
    return jax.tree.map(np.asarray, measure_hazards(heights, CELL_M, RADIUS_M, GAP_M))


def rough(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(0, 0.1, SHAPE), rng.uniform(0.01, 0.03, SHAPE), rng.random(SHAPE) < 0.8


@pytest.mark.parametrize(("a", "b", "c"), [(0.0, 0.0, 0.0), (0.3, -0.2, 30.0), (-0.05, 1.0, -400.0)])
def test_a_plane_has_its_slope_and_no_other_hazard(a, b, c):
    hazards, high = measured(a * X + b * Y + c), abs(c) / 1e6
    # In the corners of the map there is too little of the disc.
    hazards = Hazards(*(values[2:-2, 2:-2] for values in hazards))
    np.testing.assert_allclose(hazards.slope_deg, np.degrees(np.arctan(np.hypot(a, b))), atol=1e-3 + 100 * high)
    np.testing.assert_allclose([hazards.step_m, hazards.roughness_m], 0, atol=1e-5 + high)


@pytest.mark.parametrize("tilt", [0.0, 0.2])
@pytest.mark.parametrize("across", [X, Y, (X + Y) / np.sqrt(2)], ids=["x", "y", "diagonal"])
def test_the_edge_of_a_step_has_its_height(across, tilt):
    edge = 1.62
    hazards = measured(np.where(across > edge, 0.3, 0.0) + tilt * X)
    near, far = np.abs(across - edge) < 0.3, np.abs(across - edge) > 1.4
    inner = np.zeros(SHAPE, bool)
    inner[11:-11, 11:-11] = True
    np.testing.assert_allclose(hazards.step_m[near & inner], 0.3, atol=2e-3)
    np.testing.assert_allclose(hazards.step_m[far & inner], 0.0, atol=1e-4)


def test_a_sphere_has_the_slope_of_its_flank_and_little_else():
    radius_m = 6.0
    away_m = np.hypot(X - X.mean(), Y - Y.mean())
    hazards = measured(np.sqrt(radius_m**2 - away_m**2))
    inner = (slice(5, -5), slice(5, -5))
    np.testing.assert_allclose(hazards.slope_deg[inner], np.degrees(np.arcsin(away_m / radius_m))[inner], atol=0.3)
    # A plane through a cap of radius r about its middle is off by r^2 / (4 sqrt(3) R), root mean square.
    middle = hazards.roughness_m[17:19, 15:17]
    np.testing.assert_allclose(middle, RADIUS_M**2 / (4 * np.sqrt(3) * radius_m), rtol=0.2)
    assert hazards.step_m[inner].max() < 0.03


def test_hazards_move_and_turn_with_the_ground():
    height_m, sigma_m, known = rough(0)
    hazards = measured(height_m, sigma_m=sigma_m, known=known)
    turned = measured(np.rot90(height_m), sigma_m=np.rot90(sigma_m), known=np.rot90(known))
    for one, other in zip(hazards, turned, strict=True):
        np.testing.assert_allclose(np.rot90(one), other, atol=2e-4)
    moved = measured(np.pad(height_m, 3), sigma_m=np.pad(sigma_m, 3), known=np.pad(known, 3))
    for one, other in zip(hazards, moved, strict=True):
        np.testing.assert_allclose(one, other[3:-3, 3:-3], atol=1e-5)
    for one, other in zip(hazards, measured(height_m + 5, sigma_m=sigma_m, known=known), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-3)


def test_unknown_stays_unknown():
    known = np.ones(SHAPE, bool)
    known[:18] = False
    hazards = measured(np.where(known, 0.0, np.nan), known=known)
    for values in hazards:
        assert np.isnan(values[:14]).all() and np.isfinite(values[19:, 5:-5]).all()
    line = np.zeros(SHAPE, bool)
    line[18] = True
    assert np.isnan(measured(np.zeros(SHAPE), known=line).slope_deg).all(), "there is no plane through a line"


def test_the_slow_twin_agrees():
    height_m, sigma_m, known = rough(1)
    hazards = measured(height_m, sigma_m=sigma_m, known=known)
    expected = reference_hazards.hazards(height_m, sigma_m, known, CELL_M, RADIUS_M, GAP_M, 0.5)
    for values, twin in zip(hazards, expected, strict=True):
        np.testing.assert_array_equal(np.isnan(values), np.isnan(twin))
        np.testing.assert_allclose(values, twin, atol=3e-4)


def test_sigmas_are_those_of_noise():
    rng = np.random.default_rng(2)
    drawn = [measured(rng.normal(0, 0.02, SHAPE), sigma_m=0.02) for _ in range(20)]
    inner = (slice(None), slice(6, -6), slice(6, -6))
    # Of slope in two directions each has the sigma: its length follows Rayleigh's distribution.
    slopes = np.array([one.slope_deg for one in drawn])[inner]
    np.testing.assert_allclose(np.sqrt(np.mean(slopes**2) / 2), drawn[0].slope_sigma_deg[18, 16], rtol=0.1)
    roughness = np.array([one.roughness_m for one in drawn])[inner]
    np.testing.assert_allclose(roughness.std(axis=0).mean(), drawn[0].roughness_sigma_m[18, 16], rtol=0.15)


def test_discs_gather_what_lies_in_them():
    disc = disc_of(0.2, CELL_M)
    assert len(disc.cells) == 13
    one = jnp.zeros(SHAPE).at[10, 10].set(1.0)
    np.testing.assert_array_equal(np.asarray(grown(one, disc, 0.0)).sum(), 13)
    np.testing.assert_allclose(np.asarray(shares(one, disc)).max(), 1 / 13, rtol=1e-6)
    assert np.asarray(grown(one, disc, 1.0))[0, 0] == 1.0
