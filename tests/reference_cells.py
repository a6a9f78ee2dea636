"""Slow, readable twins of the scoring of maps: loops over cells, columns and pixels in plain Python."""

from __future__ import annotations

import numpy as np


def overlap(low: float, high: float, other_low: float, other_high: float) -> float:
    """Length that two intervals share."""
    return max(0.0, min(high, other_high) - max(low, other_low))


def map_cells(is_class, probability, observed, origin_m, voxel_m, cells, prior):
    """Observed, share and probability of each cell, column by column."""
    seen, share, mean = np.zeros(cells.shape, bool), np.zeros(cells.shape), np.zeros(cells.shape)
    for i, j in np.ndindex(*cells.shape):
        x, y = cells.origin_m[0] + i * cells.size_m, cells.origin_m[1] + j * cells.size_m
        rock_m2 = known_m2 = weighted = 0.0
        for a, b in np.ndindex(*observed.shape):
            left, low = origin_m[0] + a * voxel_m[0], origin_m[1] + b * voxel_m[1]
            area_m2 = overlap(left, left + voxel_m[0], x, x + cells.size_m)
            area_m2 *= overlap(low, low + voxel_m[1], y, y + cells.size_m)
            if area_m2 > 1e-9 and observed[a, b]:
                known_m2 += area_m2
                rock_m2 += area_m2 * is_class[a, b]
                weighted += area_m2 * probability[a, b]
        whole_m2 = cells.size_m**2
        seen[i, j], share[i, j] = known_m2 > 0, rock_m2 / whole_m2
        mean[i, j] = (weighted + (whole_m2 - known_m2) * prior) / whole_m2
    return seen, share, mean


def truth_share(labels, west, north, pixel_m, cells, unlabelled=0, target=2):
    """Exact share of the target in the labelled area of each cell, for a north-up raster; NaN without any."""
    share = np.full(cells.shape, np.nan)
    for i, j in np.ndindex(*cells.shape):
        x, y = cells.origin_m[0] + i * cells.size_m, cells.origin_m[1] + j * cells.size_m
        target_m2 = labelled_m2 = 0.0
        for row, column in np.ndindex(*labels.shape):
            left, high = west + column * pixel_m, north - row * pixel_m
            area_m2 = overlap(left, left + pixel_m, x, x + cells.size_m)
            area_m2 *= overlap(high - pixel_m, high, y, y + cells.size_m)
            labelled_m2 += area_m2 * (labels[row, column] != unlabelled)
            target_m2 += area_m2 * (labels[row, column] == target)
        if labelled_m2 > 1e-9:
            share[i, j] = target_m2 / labelled_m2
    return share


def confusion(called, truth, counted):
    """TP, FP, FN, TN, cell by cell."""
    counts = dict(tp=0, fp=0, fn=0, tn=0)
    for place in np.ndindex(*called.shape):
        if counted[place]:
            first = "t" if called[place] == truth[place] else "f"
            counts[first + ("p" if called[place] else "n")] += 1
    return counts


def calibration(probability, truth, counted, bins=15):
    """NLL, Brier and ECE, cell by cell."""
    nll = brier = 0.0
    said, true, total = np.zeros(bins), np.zeros(bins), 0
    for place in np.ndindex(*truth.shape):
        if not counted[place]:
            continue
        p, y = float(probability[place]), bool(truth[place])
        safe = min(max(p, 1e-6), 1 - 1e-6)
        nll -= np.log(safe if y else 1 - safe)
        brier += (p - y) ** 2
        slot = min(int(p * bins), bins - 1)
        said[slot] += p
        true[slot] += y
        total += 1
    return nll / total, brier / total, np.abs(said - true).sum() / total


def view_range(cells, ground_m, views, max_range_m):
    """Nearest camera that has each cell's centre in its image, cell by cell and pose by pose."""
    nearest = np.full(cells.shape, np.inf)
    for i, j in np.ndindex(*cells.shape):
        x = cells.origin_m[0] + (i + 0.5) * cells.size_m
        y = cells.origin_m[1] + (j + 0.5) * cells.size_m
        for T in views.T_world_camera:
            offset = np.array([x, y, ground_m[i, j]]) - T[:3, 3]
            right, down, ahead = T[:3, :3].T @ offset
            distance = float(np.linalg.norm(offset))
            if ahead <= 0 or distance > max_range_m:
                continue
            u = views.focal_px[0] * right / ahead + views.centre_px[0]
            v = views.focal_px[1] * down / ahead + views.centre_px[1]
            if -0.5 <= u < views.size_px[0] - 0.5 and -0.5 <= v < views.size_px[1] - 0.5:
                nearest[i, j] = min(nearest[i, j], distance)
    return nearest
