"""A small search for how ground truth and map lie to each other: shift and heading."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from jaxmap.evaluation.truth_cells import Alignment

MAX_SHIFT_M, MAX_HEADING_RAD = 0.5, float(np.deg2rad(2.0))
_SHIFT_STEPS, _HEADING_STEPS, _REFINEMENTS = 4, 2, 4
_LEAST_GAIN = 1e-6

Shares = Callable[[Alignment], tuple[Float64[np.ndarray, "I J"], Bool[np.ndarray, "I J"]]]
"""The share of the class in each cell, and the cells that are labelled, when the truth is moved."""


class Registration(NamedTuple):
    """The best motion found, and the overlap before and after it (`soft_iou`)."""

    alignment: Alignment
    overlap_before: float
    overlap: float


def soft_iou(
    map_share: Float[np.ndarray, "I J"], truth_share: Float[np.ndarray, "I J"], counted: Bool[np.ndarray, "I J"]
) -> float:
    """Intersection over union of shares of cells, `sum min / sum max` (Ruzicka 1958): IoU where they are 0 or 1.

    It moves with every sample, where the IoU of cells moves in jumps.
    """
    low = np.minimum(map_share, truth_share)[counted].sum()
    high = np.maximum(map_share, truth_share)[counted].sum()
    return float(low / high) if high > 0 else 0.0


def register(
    map_share: Float[np.ndarray, "I J"],
    counted: Bool[np.ndarray, "I J"],
    shares: Shares,
    pivot_m: tuple[float, float],
) -> Registration:
    """Moves the truth within +-0.5 m and +-2 degrees to where it overlaps the map best, coarse to fine.

    A motion must gain; among equals the one that was tried first, no motion before all, stays.

    Args:
        map_share: how much of each cell the map calls by the class.
        counted: cells that count, where the truth labels them.
        shares: gives the truth when it is moved.
        pivot_m: what it turns about: x and y, world.
    """

    def overlap(state: np.ndarray) -> float:
        truth_share, labelled = shares(_alignment(state, pivot_m))
        return soft_iou(map_share, truth_share, counted & labelled)

    best = np.zeros(3)
    before = best_overlap = overlap(best)
    reach = np.array([MAX_SHIFT_M, MAX_SHIFT_M, MAX_HEADING_RAD])
    steps = np.array([_SHIFT_STEPS, _SHIFT_STEPS, _HEADING_STEPS])
    for level in range(_REFINEMENTS + 1):
        step = reach / steps / 2**level
        around = [range(-count, count + 1) for count in (steps if level == 0 else (1, 1, 1))]
        middle = best
        for offset in sorted(itertools.product(*around), key=lambda steps: float(np.square(steps).sum())):
            state = middle + np.array(offset) * step
            if (np.abs(state) > reach + 1e-9).any() or not any(offset):
                continue
            if (reached := overlap(state)) > best_overlap + _LEAST_GAIN:
                best, best_overlap = state, reached
    return Registration(_alignment(best, pivot_m), before, best_overlap)


def _alignment(state: np.ndarray, pivot_m: tuple[float, float]) -> Alignment:
    return Alignment((float(state[0]), float(state[1])), float(state[2]), pivot_m)
