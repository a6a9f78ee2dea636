"""The cheapest path over a cost map, and what it is like."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxmap.errors import JaxmapError

_SAMPLES_PER_CELL = 2
_FARTHEST_CUT = 400
"""Cells that one straight piece may replace."""


class Terrain(NamedTuple):
    """What a path is sought over; x is the first axis, y the second.

    Attributes:
        cost: of a metre, positive.
        drivable: where the rover's centre may be.
        origin_m: lower corner of the cells, world.
        cell_m: their size.
    """

    cost: Float[np.ndarray, "X Y"]
    drivable: Bool[np.ndarray, "X Y"]
    origin_m: Float[np.ndarray, "2"]
    cell_m: Float[np.ndarray, "2"]

    def cell_of(self, place_m: Float[np.ndarray, "*s 2"]) -> Int[np.ndarray, "*s 2"]:
        """The cell that a place lies in, be it in the map or beyond it."""
        return np.floor((place_m - self.origin_m) / self.cell_m + 1e-9).astype(int)

    def centre_of(self, cell: Int[np.ndarray, "*s 2"]) -> Float[np.ndarray, "*s 2"]:
        """The middle of a cell."""
        return self.origin_m + (np.asarray(cell) + 0.5) * self.cell_m

    def holds(self, cell: Int[np.ndarray, "2"]) -> bool:
        """Whether the map has the cell."""
        return bool(((cell >= 0) & (cell < self.cost.shape)).all())

    def nearest(self, place_m: Float[np.ndarray, "2"], free: Bool[np.ndarray, "X Y"]) -> Float[np.ndarray, "2"] | None:
        """The middle of the free cell that is nearest to a place; None where no cell is free."""
        places_m = self.centre_of(np.argwhere(free))
        if not len(places_m):
            return None
        return places_m[np.argmin(np.linalg.norm(places_m - place_m, axis=1))]


class NoPathError(JaxmapError):
    """There is no path to the goal.

    `nearest_m` is the place nearest to the goal that can be reached.
    """

    def __init__(self, nearest_m: Float[np.ndarray, "2"]) -> None:
        self.nearest_m = nearest_m
        super().__init__("there is no path from start to goal")


def find_path(
    terrain: Terrain, start: Int[np.ndarray, "2"], goal: Int[np.ndarray, "2"]
) -> tuple[Int[np.ndarray, "N 2"], float]:
    """The cheapest path between two drivable cells, by Dijkstra's algorithm on cells and their diagonals.

    Returns:
        The cells that it leads over, and its cost in metres of level driving, `cost.path_cost` of the cells.

    Raises:
        NoPathError: there is none.
    """
    from skimage.graph import MCP_Geometric

    costs = np.where(terrain.drivable, terrain.cost.astype(np.float64), -1.0)
    search: Any = MCP_Geometric(costs, sampling=tuple(terrain.cell_m))
    reached, _ = search.find_costs([tuple(start)], [tuple(goal)])
    if not np.isfinite(reached[tuple(goal)]):
        nearest_m = terrain.nearest(terrain.centre_of(goal), np.isfinite(reached))
        assert nearest_m is not None
        raise NoPathError(nearest_m)
    return np.array(search.traceback(tuple(goal))), float(reached[tuple(goal)])


def straightened(terrain: Terrain, cells: Int[np.ndarray, "N 2"]) -> Float[np.ndarray, "M 2"]:
    """The same path with straight pieces wherever they cost no more, as places of the world.

    Steps along cells and diagonals alone are up to 8 % longer than they need be.
    """
    places_m, ends, at = terrain.centre_of(cells), [0], 0
    so_far = np.concatenate([[0.0], np.cumsum(segment_costs(terrain, places_m))])
    while at < len(cells) - 1:
        after = range(min(len(cells) - 1, at + _FARTHEST_CUT), at, -1)
        cheaper = (j for j in after if _straight_cost(terrain, places_m[at], places_m[j]) <= so_far[j] - so_far[at])
        at = next(cheaper, at + 1)
        ends.append(at)
    return places_m[ends]


def sampled(points_m: Float[np.ndarray, "M 2"], step_m: float) -> Float[np.ndarray, "S 2"]:
    """Places along a path, its corners among them, no farther apart than a step."""
    pieces = [
        np.linspace(start, end, max(1, int(np.ceil(np.linalg.norm(end - start) / step_m))), endpoint=False)
        for start, end in itertools.pairwise(points_m)
    ]
    return np.concatenate([*pieces, points_m[-1:]])


def length_m(points_m: Float[np.ndarray, "M 2"]) -> float:
    """Length of a path."""
    return float(np.linalg.norm(np.diff(points_m, axis=0), axis=1).sum())


def segment_costs(terrain: Terrain, places_m: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N-1"]:
    """The cost between neighbouring places: the mean cost of their cells over the distance."""
    i, j = terrain.cell_of(places_m).T
    at = np.where(terrain.drivable[i, j], terrain.cost[i, j], np.inf)
    return np.linalg.norm(np.diff(places_m, axis=0), axis=1) * (at[1:] + at[:-1]) / 2


def _straight_cost(terrain: Terrain, start_m: np.ndarray, end_m: np.ndarray) -> float:
    step_m = float(terrain.cell_m.min()) / _SAMPLES_PER_CELL
    return float(segment_costs(terrain, sampled(np.stack([start_m, end_m]), step_m)).sum())
