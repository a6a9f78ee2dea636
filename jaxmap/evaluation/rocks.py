"""Rocks one by one: which of the truth's a map has found, by their size and by how near a camera came."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from jaxmap.datasets.label_raster import TARGET
from jaxmap.evaluation.truth_cells import TruthCells, cell_counts

SIZE_EDGES_M = (0.0, 0.1, 0.2, 0.3, 0.5, 1.0, np.inf)
RANGE_EDGES_M = (0.0, 2.0, 4.0, 6.0, 8.0, 12.0, 20.0, np.inf)


class Rocks(NamedTuple):
    """Rocks of the truth that lie in the domain by half of their area at least.

    `diameter_m` is that of the disc of the same area; `range_m` how near a camera came to the nearest of their cells
    (infinite where that is not known); `found_share` is how much of their area lies in cells called rock.
    """

    diameter_m: Float64[np.ndarray, "N"]
    range_m: Float64[np.ndarray, "N"]
    found_share: Float64[np.ndarray, "N"]


def find_rocks(
    truth: TruthCells,
    cell_size_m: float,
    called: Bool[np.ndarray, "I J"],
    domain: Bool[np.ndarray, "I J"],
    range_m: Float[np.ndarray, "I J"],
) -> Rocks:
    """Takes the truth apart into connected rocks (corners connect), at its own resolution.

    Args:
        truth: in cells.
        cell_size_m: of a cell.
        called: cells that the map calls rock.
        domain: cells that are asked for.
        range_m: how near a camera came to each cell (`view_range`).
    """
    from scipy.ndimage import find_objects, label

    labelled: Any = label(truth.fine == TARGET, np.ones((3, 3), bool))
    numbers: np.ndarray = labelled[0]
    sample_m2 = (cell_size_m / truth.per_cell) ** 2
    rows = []
    for number, box in enumerate(find_objects(numbers), start=1):
        corner = tuple(slice(s.start // truth.per_cell, -(-s.stop // truth.per_cell)) for s in box)
        fine = tuple(slice(s.start * truth.per_cell, s.stop * truth.per_cell) for s in corner)
        area = cell_counts(numbers[fine] == number, truth.per_cell)
        inside = area * domain[corner]
        if 2 * inside.sum() < area.sum():
            continue
        share = (inside * called[corner]).sum() / inside.sum()
        nearest_m = float(range_m[corner][(inside > 0)].min())
        rows.append((2 * np.sqrt(area.sum() * sample_m2 / np.pi), nearest_m, share))
    table = np.array(rows, np.float64).reshape(-1, 3)
    return Rocks(table[:, 0], table[:, 1], table[:, 2])


def rock_table(rocks: Rocks, found_share: float = 0.5) -> dict[str, Any]:
    """How many rocks there are and how many of them are missed, in all, by size and by range.

    A rock is found where at least `found_share` of its area lies in cells called rock.
    """
    found = rocks.found_share >= found_share - 1e-9
    return {
        "count": len(found),
        "missed": int((~found).sum()),
        "found_share": found_share,
        "by_diameter_m": _binned(rocks.diameter_m, found, SIZE_EDGES_M),
        "by_range_m": _binned(rocks.range_m, found, RANGE_EDGES_M),
    }


def _binned(values: np.ndarray, found: np.ndarray, edges: Sequence[float]) -> list[dict[str, Any]]:
    rows = []
    for low, high in pairwise(edges):
        here = (values >= low) & ((values < high) | (high == np.inf))
        if here.any():
            upper = float(high) if np.isfinite(high) else None
            rows.append({"from": low, "to": upper, "count": int(here.sum()), "missed": int((here & ~found).sum())})
    return rows
