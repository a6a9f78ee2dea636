"""Which disparities occur in which rows of a pair, so that no others are searched.

A rover's camera looks along the ground: each part of the image holds a fraction of all disparities, and what is not
searched is no false match either. Small images say which (`stereo.coarse`): from the least that they show in a band of
rows to the greatest that they show there or anywhere below. What stands on the ground has its disparity, and may be too
thin for small images. Within these bounds the full images are matched as ever.
"""

from __future__ import annotations

from itertools import accumulate, pairwise

import numpy as np

from jaxmap.stereo.coarse import Coarse
from jaxmap.stereo.match import OVERLAP_ROWS, Band, Matcher

STEP_ROWS = 32
"""Bands begin and end at multiples of about this."""
MARGIN_PX = 1
"""What small images may be off, in their pixels."""
LEAST_KNOWN = 0.5
"""Where small images match less than this share of the pixels, they do not tell what there is."""

_FIXED_COST, _FIXED_ROWS = 30, 40
"""What OpenCV spends on a row whatever is searched there, in disparities; and the rows that a band costs beside its
own: those it shares with the one above, and those between the four parts that OpenCV makes of it."""


def search_bands(coarse: Coarse, matcher: Matcher, height_px: int) -> tuple[Band, ...]:
    """Bands of rows, from the top, that together hold all, and the disparities to be searched in each.

    Of all ways to join neighbouring rows the one that costs least is taken: rows that a band needs beside its own ones
    are searched twice.

    Args:
        coarse: what small images show.
        matcher: searches no more than it would without bands.
        height_px: of the full images.
    """
    edges = np.linspace(0, height_px, max(round(height_px / STEP_ROWS), 1) + 1).astype(int).tolist()
    bounds = [_bounds(coarse, first, end) for first, end in pairwise(edges)]
    limits_px = [*accumulate((limit_px for _, limit_px in reversed(bounds)), max)][::-1]
    # For each edge: what the rows above it cost at least, and the bands that do so.
    best: list[tuple[float, tuple[Band, ...]]] = [(0.0, ())]
    for last, end in enumerate(edges[1:]):
        ways = []
        least_px = np.inf
        for start in range(last, -1, -1):
            least_px = min(least_px, bounds[start][0])
            band = matcher.band(edges[start], end, least_px, limits_px[start])
            cost, above = best[start]
            ways.append((cost + (end - edges[start] + _FIXED_ROWS) * (_FIXED_COST + band.disparities), (*above, band)))
        best.append(min(ways))
    return best[-1][1]


def _bounds(coarse: Coarse, first: int, end: int) -> tuple[float, float]:
    """The least disparity of some rows, and the first beyond the greatest; endless where they are unknown."""
    rows = slice(max(first - OVERLAP_ROWS, 0) // coarse.shrink, -(-(end + OVERLAP_ROWS) // coarse.shrink))
    there = coarse.disparity_px[rows]
    known = there[np.isfinite(there)]
    if known.size < LEAST_KNOWN * there.size or not known.size:
        return -np.inf, np.inf
    margin_px = MARGIN_PX * coarse.shrink
    return float(known.min()) - margin_px, float(known.max()) + margin_px + 1
