"""A small search for how ground truth and map lie to each other: shift and heading."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from jaxmap.evaluation.truth_cells import Alignment

MAX_SHIFT_M, MAX_HEADING_RAD = 0.5, float(np.deg2rad(2.0))
_SHIFT_STEPS, _HEADING_STEPS, _REFINEMENTS = 4, 2, 4
_LEAST_GAIN = 1e-6


def soft_iou(
    map_share: Float[np.ndarray, "*s"], truth_share: Float[np.ndarray, "*s"], counted: Bool[np.ndarray, "*s"]
) -> float:
    """Intersection over union of shares of cells, `sum min / sum max` (Ruzicka 1958): IoU where they are 0 or 1.

    It moves with every sample of the truth, where the IoU of cells moves in jumps.
    """
    low = np.minimum(map_share, truth_share)[counted].sum()
    high = np.maximum(map_share, truth_share)[counted].sum()
    return float(low / high) if high > 0 else 0.0


def register(overlap: Callable[[Alignment], float], pivot_m: tuple[float, float]) -> Alignment:
    """The motion of the truth, within +-0.5 m and +-2 degrees, at which it overlaps the map best; coarse to fine.

    A motion must gain: of equals the smallest is kept, no motion before all.

    Args:
        overlap: how well the truth fits the map when it is moved; the more the better.
        pivot_m: what the truth turns about: x and y, world.
    """
    best = np.zeros(3)
    best_overlap = overlap(Alignment(pivot_m=pivot_m))
    reach = np.array([MAX_SHIFT_M, MAX_SHIFT_M, MAX_HEADING_RAD])
    steps = np.array([_SHIFT_STEPS, _SHIFT_STEPS, _HEADING_STEPS])
    for level in range(_REFINEMENTS + 1):
        around = [range(-count, count + 1) for count in (steps if level == 0 else (1, 1, 1))]
        offsets = sorted(itertools.product(*around), key=lambda offset: float(np.square(offset).sum()))
        middle = best
        for offset in offsets[1:]:
            state = middle + np.array(offset) * reach / steps / 2**level
            if (np.abs(state) > reach + 1e-9).any():
                continue
            alignment = Alignment((float(state[0]), float(state[1])), float(state[2]), pivot_m)
            if (reached := overlap(alignment)) > best_overlap + _LEAST_GAIN:
                best, best_overlap = state, reached
    return Alignment((float(best[0]), float(best[1])), float(best[2]), pivot_m)
