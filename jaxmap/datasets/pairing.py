"""Left and right images that belong together by the times at which they were taken."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int64


def nearest_pairs(
    left_ns: Int64[np.ndarray, "L"], right_ns: Int64[np.ndarray, "R"], tolerance_ns: int
) -> tuple[Int64[np.ndarray, "P"], Int64[np.ndarray, "P"], int]:
    """The pairs of images that are each other's nearest in time.

    Args:
        left_ns: increasing times of the left images, at least one.
        right_ns: likewise of the right ones.
        tolerance_ns: images farther apart make no pair.

    Returns:
        Indices of the left and of the right images, and how far the nearest two are apart in ns.
    """
    partner = _nearest(right_ns, left_ns)
    gap_ns = np.abs(right_ns[partner] - left_ns)
    mutual = _nearest(left_ns, right_ns)[partner] == np.arange(len(left_ns))
    paired = np.flatnonzero(mutual & (gap_ns <= tolerance_ns))
    return paired, partner[paired], int(gap_ns.min())


def _nearest(knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The index of the nearest of the sorted knots, for each value."""
    after = np.searchsorted(knots, values).clip(0, len(knots) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(values - knots[before]) <= np.abs(knots[after] - values), before, after)
