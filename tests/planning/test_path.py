"""Paths over costs: against free space, around walls, and where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from jaxmap.planning.path import NoPathError, Terrain, find_path, length_m, sampled, segment_costs, straightened

SHAPE = (60, 50)


def terrain(drivable: np.ndarray | None = None, cost: np.ndarray | None = None) -> Terrain:
    drivable = np.ones(SHAPE, bool) if drivable is None else drivable
    cost = np.ones(SHAPE) if cost is None else cost
    return Terrain(cost, drivable, np.array([10.0, -4.0]), np.array([0.1, 0.2]))


def test_over_free_ground_the_path_is_straight():
    start, goal = np.array([3, 4]), np.array([55, 30])
    cells, cost = find_path(terrain(), start, goal)
    points_m = straightened(terrain(), cells)
    np.testing.assert_allclose(points_m, terrain().centre_of(np.stack([start, goal])))
    assert length_m(points_m) <= cost + 1e-9


def test_a_path_goes_around_a_wall_and_never_through_it():
    drivable = np.ones(SHAPE, bool)
    drivable[30, :45] = False
    ground = terrain(drivable)
    cells, cost = find_path(ground, np.array([5, 5]), np.array([55, 5]))
    assert drivable[tuple(cells.T)].all()
    np.testing.assert_allclose(segment_costs(ground, ground.centre_of(cells)).sum(), cost)
    points_m = straightened(ground, cells)
    places_m = sampled(points_m, 0.02)
    assert drivable[tuple(ground.cell_of(places_m).T)].all()
    assert length_m(points_m) <= cost < 30
    assert np.linalg.norm(np.diff(places_m, axis=0), axis=1).max() <= 0.02 + 1e-9


def test_dear_ground_is_worth_a_detour_and_no_more():
    cost = np.ones(SHAPE)
    cost[30, :40] = 20.0
    cells, _ = find_path(terrain(cost=cost), np.array([5, 5]), np.array([55, 5]))
    assert cells[:, 1].max() < 40, "a strip of 0.1 m is crossed sooner than walked around"
    cost[20:40, :40] = 20.0
    cells, _ = find_path(terrain(cost=cost), np.array([5, 35]), np.array([55, 35]))
    assert cells[:, 1].max() >= 40


def test_without_a_path_the_nearest_place_is_named():
    drivable = np.ones(SHAPE, bool)
    drivable[30] = False
    with pytest.raises(NoPathError) as caught:
        find_path(terrain(drivable), np.array([5, 5]), np.array([40, 7]))
    np.testing.assert_allclose(caught.value.nearest_m, terrain().centre_of(np.array([29, 7])))


def test_a_start_that_is_the_goal_is_a_path():
    cells, cost = find_path(terrain(), np.array([5, 5]), np.array([5, 5]))
    assert len(cells) == 1 and cost == 0
    assert len(straightened(terrain(), cells)) == 1 and len(sampled(terrain().centre_of(cells), 0.1)) == 1
