"""What driving costs: bounds, what bars the rover, and gradients against finite differences."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmap.errors import UsageError
from jaxmap.planning.cost import CostMap, cost_map, path_cost
from jaxmap.planning.hazards import Hazards, Heights, measure_hazards
from jaxmap.planning.options import RoverOptions
from jaxmap.planning.path import Terrain, find_path

SHAPE, CELL_M = (30, 24), (0.1, 0.1)
ROVER = RoverOptions(radius_m=0.3, margin_m=0.1)


def costs_of(height_m: np.ndarray, rock: np.ndarray, seen: np.ndarray, rover: RoverOptions = ROVER) -> CostMap:
    heights = Heights(jnp.asarray(height_m, jnp.float32), jnp.full(SHAPE, 0.01), jnp.asarray(seen))
    hazards = measure_hazards(heights, CELL_M, rover.radius_m, rover.wheel_m)
    return cost_map(hazards, jnp.asarray(rock, jnp.float32), jnp.asarray(seen), CELL_M, rover)


@pytest.mark.slow
def test_level_ground_costs_its_length_and_rock_what_is_expected_of_it():
    seen, rock = np.ones(SHAPE, bool), np.zeros(SHAPE)
    costs = costs_of(np.zeros(SHAPE), rock, seen)
    np.testing.assert_allclose(costs.cost[5:-5, 5:-5], 1.0, rtol=1e-5)
    assert costs.drivable[5:-5, 5:-5].all() and not costs.drivable[0].any()
    rock[13:18, 10:15] = 0.3
    costs = costs_of(np.zeros(SHAPE), rock, seen)
    np.testing.assert_allclose(costs.cost[15, 12], 1 + 0.3 * ROVER.rock_cost, rtol=1e-5)
    assert costs.drivable[15, 12], "what may be rock costs, it does not bar the way"
    dearer = cost_map(
        NO_HAZARDS, jnp.asarray(rock, jnp.float32), jnp.asarray(seen), CELL_M, replace(ROVER, rock_cost=20)
    )
    np.testing.assert_allclose(dearer.cost[15, 12], 7.0, rtol=1e-5)


NO_HAZARDS = Hazards(*(jnp.full(SHAPE, jnp.nan) for _ in Hazards._fields))


@pytest.mark.slow
def test_steps_slopes_and_the_unseen_bar_the_rover():
    everywhere, none = np.ones(SHAPE, bool), np.zeros(SHAPE)
    step = np.zeros(SHAPE)
    step[15:] = 0.5
    costs = costs_of(step, none, everywhere)
    assert not costs.drivable[15, 12] and costs.goodness[15, 12] == 0 and costs.drivable[5, 12]
    slope = np.tan(np.radians(25)) * 0.1 * np.arange(30)[:, None] + none
    assert not costs_of(slope, none, everywhere).drivable.any()
    assert costs_of(slope, none, everywhere, replace(ROVER, max_slope_deg=40)).drivable.any()
    hidden = everywhere.copy()
    hidden[:, 12:] = False
    costs = costs_of(none, none, hidden)
    assert costs.drivable[15, 6] and not costs.drivable[15, 14:].any()
    assert (np.diff(np.asarray(costs.unknown[15, 5:20])) >= -1e-6).all()


@pytest.mark.slow
def test_the_cost_of_a_path_has_the_gradient_of_finite_differences():
    rng = np.random.default_rng(0)
    seen = rng.random(SHAPE) < 0.9
    rock = jnp.asarray(rng.uniform(0.05, 0.4, SHAPE), jnp.float32)
    height_m = jnp.asarray(rng.normal(0, 0.03, SHAPE), jnp.float32)
    cells = jnp.array([(i, 12) for i in range(6, 24)])
    # With dear rock, differences in single precision are too coarse.
    rover = replace(ROVER, rock_cost=10.0)

    def expected(rock, height_m):
        heights = Heights(height_m, jnp.full(SHAPE, 0.01), jnp.asarray(seen))
        hazards = measure_hazards(heights, CELL_M, rover.radius_m, rover.wheel_m)
        return path_cost(cost_map(hazards, rock, jnp.asarray(seen), CELL_M, rover).cost, cells, CELL_M)

    for number, (value, size) in enumerate(((rock, 1e-3), (height_m, 1e-4))):
        gradient = jax.grad(expected, argnums=number)(rock, height_m)
        assert np.isfinite(gradient).all() and np.abs(gradient).max() > 0
        for way in rng.normal(size=(3, *SHAPE)).astype(np.float32):
            ends = [[rock, height_m], [rock, height_m]]
            ends[0][number], ends[1][number] = value + size * way, value - size * way
            difference = float(expected(*ends[0]) - expected(*ends[1])) / (2 * size)
            np.testing.assert_allclose(float((gradient * way).sum()), difference, rtol=0.05, atol=0.05)


@pytest.mark.slow
def test_the_cheapest_path_has_the_gradient_of_its_own_cost():
    rng = np.random.default_rng(1)
    cost = rng.uniform(1, 3, SHAPE).astype(np.float32)

    def cheapest(cost):
        terrain = Terrain(cost, np.ones(SHAPE, bool), np.zeros(2), np.array(CELL_M))
        return find_path(terrain, np.array([2, 2]), np.array([27, 20]))

    cells, least = cheapest(cost)
    along = jax.jit(partial(path_cost, cells=jnp.asarray(cells), cell_m=CELL_M))
    np.testing.assert_allclose(along(jnp.asarray(cost)), least, rtol=1e-5)
    gradient, way = np.asarray(jax.grad(along)(jnp.asarray(cost))), rng.normal(size=SHAPE)
    difference = (cheapest(cost + 1e-4 * way)[1] - cheapest(cost - 1e-4 * way)[1]) / 2e-4
    np.testing.assert_allclose((gradient * way).sum(), difference, rtol=1e-2)


def test_a_rover_is_larger_than_its_wheels():
    with pytest.raises(UsageError, match=r"wheel_m 0\.5 and radius_m 0\.45.*smaller"):
        RoverOptions(wheel_m=0.5)
