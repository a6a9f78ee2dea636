"""Slow, readable NumPy twins of the kernels of hazards and of the heights of columns."""

from __future__ import annotations

import numpy as np


def hazards(height_m, sigma_m, known, cell_m, radius_m, gap_m, least_share):
    """`planning.hazards.measure_hazards`, cell by cell: step, slope, roughness and their sigmas."""
    shape = height_m.shape
    reach = [int(radius_m / size + 1e-3) for size in cell_m]
    offsets = [
        (i, j)
        for i in range(-reach[0], reach[0] + 1)
        for j in range(-reach[1], reach[1] + 1)
        if np.hypot(i * cell_m[0], j * cell_m[1]) <= radius_m * 1.001
    ]
    planes = {}
    for cell in np.ndindex(shape):
        there = [(i, j) for i, j in offsets if inside(cell, (i, j), shape) and known[cell[0] + i, cell[1] + j]]
        if len(there) < max(least_share * len(offsets), 4):
            continue
        xy = np.array(there) * cell_m
        z = np.array([height_m[cell[0] + i, cell[1] + j] for i, j in there])
        spread = np.linalg.det(np.cov(xy.T, bias=True)) if len(xy) > 1 else 0.0
        if spread <= (1e-3 * radius_m**2) ** 2:
            continue
        (a, b, c), *_ = np.linalg.lstsq(np.column_stack([xy, np.ones(len(xy))]), z, rcond=None)
        off_m = (z - xy @ (a, b) - c) / np.sqrt(1 + a * a + b * b)
        variance = np.mean([sigma_m[cell[0] + i, cell[1] + j] ** 2 for i, j in there])
        planes[cell] = (a, b, np.sqrt(np.mean(off_m**2)), variance, len(there), spread * len(there) ** 2)
    found = {cell: jump(cell, height_m, sigma_m, known, planes, reach, cell_m, gap_m) for cell in np.ndindex(shape)}
    out = np.full((6, *shape), np.nan)
    for cell, (a, b, roughness, variance, count, determinant) in planes.items():
        around = [found[cell[0] + i, cell[1] + j] for i, j in offsets if inside(cell, (i, j), shape)]
        step, noise = max([(0.0, 0.0), *around], key=lambda pair: pair[0])
        slope = np.degrees(np.arctan(np.hypot(a, b)))
        slope_sigma = np.degrees(np.sqrt(variance / np.sqrt(determinant)) / (1 + a * a + b * b))
        rough_sigma = np.sqrt(variance / (2 * max(count - 3, 1)))
        out[:, *cell] = step, slope, roughness, noise, slope_sigma, rough_sigma
    return out


def jump(cell, height_m, sigma_m, known, planes, reach, cell_m, gap_m):
    """The greatest jump from a cell to one a gap away, less its sigma, and that sigma; (-1, 0) where there is none."""
    gap, best = [max(1, round(gap_m / size)) for size in cell_m], (-1.0, 0.0)
    for way in [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]:
        ahead = (way[0] * gap[0], way[1] * gap[1])
        end = (cell[0] + ahead[0], cell[1] + ahead[1])
        if not (inside(cell, ahead, height_m.shape) and known[cell] and known[end]):
            continue
        aside = [round(way[axis] / np.hypot(*way) * reach[axis]) for axis in (0, 1)]
        beyond, behind = (end[0] + aside[0], end[1] + aside[1]), (cell[0] - aside[0], cell[1] - aside[1])
        sides = [planes[place] for place in (beyond, behind) if place in planes]
        sides = sides or [planes[place] for place in (cell,) if place in planes]
        rise = height_m[end] - height_m[cell]
        left = [abs(rise - ahead[0] * cell_m[0] * a - ahead[1] * cell_m[1] * b) for a, b, *_ in sides]
        sigma = np.hypot(sigma_m[end], sigma_m[cell])
        if left and min(left) - sigma > best[0]:
            best = (min(left) - sigma, sigma)
    return best


def inside(cell, offset, shape):
    """Whether a cell so far from another lies on the map."""
    return all(0 <= c + o < n for c, o, n in zip(cell, offset, shape, strict=True))


def heights(points, sigma_m, keep, lower, cell_m, shape):
    """`fusion.surface.gather_heights`, column by column: count, weight, mean height and sum of squares about it."""
    out = np.zeros((4, *shape[:2]))
    index = np.floor((points - lower) / cell_m).astype(int)
    there = keep & ((index >= 0) & (index < shape)).all(axis=1)
    for x, y in np.ndindex(shape[:2]):
        own = there & (index[:, 0] == x) & (index[:, 1] == y)
        if own.any():
            z, weight = points[own, 2].astype(np.float64), 1 / (sigma_m[own].astype(np.float64) ** 2 + 0.01**2)
            mean = (weight * z).sum() / weight.sum()
            out[:, x, y] = own.sum(), weight.sum(), mean, (weight * (z - mean) ** 2).sum()
    return out
