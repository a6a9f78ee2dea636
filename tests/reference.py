"""Slow, readable twins of the kernels, in NumPy and float64: what the fast code is held against.

They take the same objects as the kernels and loop where the kernels scatter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

IGNORE = 255


def f64(value) -> np.ndarray:
    """Any array as float64."""
    return np.asarray(value, np.float64)


def pose_matrix(T) -> np.ndarray:
    """The 4x4 matrix of a jaxlie SE3, in float64 from its quaternion."""
    w, x, y, z, *t = f64(T.wxyz_xyz)
    w, x, y, z = np.array([w, x, y, z]) / np.linalg.norm([w, x, y, z])
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = t
    return matrix


def transform_points(T, points) -> np.ndarray:
    matrix = pose_matrix(T)
    return f64(points) @ matrix[:3, :3].T + matrix[:3, 3]


def disparity_to_points(camera, disparity_px) -> tuple[np.ndarray, np.ndarray]:
    disparity = f64(disparity_px)
    height, width = disparity.shape
    points, valid = np.zeros((height, width, 3)), np.zeros((height, width), bool)
    for v in range(height):
        for u in range(width):
            shifted = disparity[v, u] + float(camera.doffs_px)
            valid[v, u] = np.isfinite(shifted) and shifted > 0
            z = float(camera.baseline_m) * float(camera.fx_px) / shifted if valid[v, u] else 1.0
            x = (u - float(camera.cx_px)) * z / float(camera.fx_px)
            y = (v - float(camera.cy_px)) * z / float(camera.fy_px)
            points[v, u] = x, y, z
    return points, valid


def points_to_pixels(camera, points_camera) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    x, y, z = np.moveaxis(f64(points_camera), -1, 0)
    in_front = z > 0
    z = np.where(in_front, z, 1.0)
    u = float(camera.fx_px) * x / z + float(camera.cx_px)
    v = float(camera.fy_px) * y / z + float(camera.cy_px)
    return u, v, float(camera.baseline_m) * float(camera.fx_px) / z - float(camera.doffs_px), in_front


def depth_sigma(camera, depth_m, disparity_sigma_px) -> np.ndarray:
    return f64(depth_m) ** 2 * float(disparity_sigma_px) / (float(camera.baseline_m) * float(camera.fx_px))


def range_weight(camera, grid, depth_m, params) -> np.ndarray:
    voxel_m = f64(grid.voxel_size_m).mean()
    return 1 / (1 + (depth_sigma(camera, depth_m, params.disparity_sigma_px) / voxel_m) ** 2)


def scaled_points(grid, points_world) -> np.ndarray:
    """Points in units of voxels from the grid's origin."""
    return (f64(points_world) - f64(grid.origin_m)) / f64(grid.voxel_size_m)


def world_to_voxel(grid, points_world) -> tuple[np.ndarray, np.ndarray]:
    with np.errstate(invalid="ignore"):
        scaled = np.floor(scaled_points(grid, points_world))
        inside = ((scaled >= 0) & (scaled < np.array(grid.shape))).all(axis=-1)
        return np.where(inside[..., None], scaled, 0).astype(int), inside


def voxel_centres(grid) -> np.ndarray:
    return f64(grid.origin_m) + (np.moveaxis(np.indices(grid.shape), 0, -1) + 0.5) * f64(grid.voxel_size_m)


def kept(labels, left_out) -> np.ndarray:
    """Which points are fused: those whose likeliest label, "no class" being one, is none of those left out."""
    keep = np.array(labels.keep)
    for n in range(len(keep)):
        if labels.probabilities is None:
            keep[n] &= int(labels.labels[n]) not in left_out
        else:
            shares = [*f64(labels.probabilities[n]), 1 - f64(labels.probabilities[n]).sum()]
            best = max(share for index, share in enumerate(shares) if index not in left_out)
            keep[n] &= all(shares[index] <= best for index in left_out)
    return keep


def count_points(grid, points_world, labels, weights, class_count: int) -> np.ndarray:
    counts = np.zeros((class_count + 1, *grid.shape))
    index, inside = world_to_voxel(grid, points_world)
    weights = f64(weights)
    for n in range(len(weights)):
        if not (inside[n] and bool(labels.keep[n]) and np.isfinite(weights[n])):
            continue
        if labels.probabilities is not None:
            known = f64(labels.probabilities[n])
            shares = [*known, 1 - known.sum()]
        else:
            label = int(labels.labels[n])
            shares = np.eye(class_count + 1)[label if 0 <= label < class_count else class_count]
        counts[(slice(None), *index[n])] += np.array(shares) * weights[n]
    return counts


def frame_evidence(counts, free, params, rule) -> np.ndarray:
    """Paper eq. 3, voxel by voxel."""
    counts = f64(counts)
    class_count = len(counts) - 1
    increments, prior = f64(params.class_increments), f64(params.class_prior)
    out = np.zeros_like(counts)
    for voxel in np.ndindex(counts.shape[1:]):
        here = counts[(slice(None), *voxel)]
        points = here.sum()
        if rule.per_frame == "sum":
            amount, shares = points, here[:-1]
        elif rule.per_frame == "once":
            amount, shares = float(points > 0), (here[:-1] > 0).astype(float)
        elif rule.per_frame == "majority":
            ahead = [all(here[c] > here[other] for other in range(len(here)) if other != c) for c in range(class_count)]
            amount, shares = float(points > 0), np.array(ahead, float)
        else:
            full = max(points, float(params.full_evidence_points))
            amount, shares = points / full, here[:-1] / full
        out[(0, *voxel)] = amount * (float(params.occupancy_hit) - float(params.occupancy_prior))
        if free is not None and free[voxel] and points == 0:
            out[(0, *voxel)] += float(params.occupancy_miss) - float(params.occupancy_prior)
        for i in range(class_count):
            for j in range(class_count):
                out[(1 + j, *voxel)] += shares[i] * (increments[i, j] - prior[j])
    return out


def integrate(log_odds, grid, points_world, labels, weights, params, rule, free=None) -> np.ndarray:
    counts = count_points(grid, points_world, labels, weights, len(log_odds) - 1)
    return f64(log_odds) + frame_evidence(counts, free, params, rule)


class Carved(NamedTuple):
    """Voxels seen through, and those whose verdict no rounding can turn."""

    free: np.ndarray
    sure: np.ndarray


def carve(camera, T_world_camera, depth_m, valid, grid, params, depth_range_m=(0.0, np.inf)) -> Carved:
    depth_m, valid = f64(depth_m), np.asarray(valid)
    height, width = depth_m.shape
    inverse = np.linalg.inv(pose_matrix(T_world_camera))
    centres = voxel_centres(grid) @ inverse[:3, :3].T + inverse[:3, 3]
    u, v, _, _ = points_to_pixels(camera, centres)
    free, sure = np.zeros(grid.shape, bool), np.zeros(grid.shape, bool)
    half_diagonal = 0.5 * np.linalg.norm(f64(grid.voxel_size_m))
    tiny = 1e-3
    for voxel in np.ndindex(*grid.shape):
        z, column, row = centres[voxel][2], np.round(u[voxel]), np.round(v[voxel])
        near_edge = abs(abs(u[voxel] - column) - 0.5) < tiny or abs(abs(v[voxel] - row) - 0.5) < tiny
        sure[voxel] = abs(z) > tiny and min(abs(z - depth_range_m[0]), abs(z - depth_range_m[1])) > tiny
        if z <= 0 or not depth_range_m[0] <= z <= depth_range_m[1]:
            continue
        sure[voxel] &= not near_edge
        if not (0 <= column < width and 0 <= row < height and valid[int(row), int(column)]):
            continue
        measured = depth_m[int(row), int(column)]
        slack = measured - z - half_diagonal - 2 * depth_sigma(camera, measured, params.disparity_sigma_px)
        free[voxel] = slack > 0
        sure[voxel] &= abs(slack) > tiny
    return Carved(free, sure)


def sigmoid(x) -> np.ndarray:
    return 1 / (1 + np.exp(-f64(x)))


def occupied(voxel_map, params) -> np.ndarray:
    log_odds = f64(voxel_map.log_odds)
    touched = (log_odds != 0).any(axis=0)
    return touched & (sigmoid(log_odds[0] + float(params.occupancy_prior)) > float(params.occupancy_threshold))


def decide(evidence: Sequence[float], params, rule, classes) -> int:
    """The label of one cell that is known to be occupied, from its evidence (priors left out)."""
    posterior = f64(evidence) + f64(params.class_prior)
    priority = ("rock",) if rule.priority_classes is None else rule.priority_classes
    for name in priority:
        if name in classes and sigmoid(posterior[classes.index(name)]) > float(params.class_threshold):
            return classes.index(name)
    rivals = [c for c in range(len(classes)) if classes[c] not in priority and evidence[c] > 0]
    return max(rivals, key=lambda c: posterior[c], default=IGNORE)


def voxel_labels(voxel_map, params, rule) -> np.ndarray:
    solid = occupied(voxel_map, params)
    labels = np.full(solid.shape, IGNORE, np.uint8)
    for voxel in zip(*np.nonzero(solid), strict=True):
        evidence = f64(voxel_map.log_odds)[(slice(1, None), *voxel)]
        labels[voxel] = decide(evidence, params, rule, voxel_map.classes)
    return labels


def top_down(voxel_map, params, rule) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Probability, label, height and observed, column by column."""
    solid, heights = occupied(voxel_map, params), voxel_centres(voxel_map.grid)[..., 2]
    classes, (nx, ny, _) = voxel_map.classes, solid.shape
    probability = np.tile(sigmoid(params.class_prior)[:, None, None], (1, nx, ny))
    label, height = np.full((nx, ny), IGNORE, np.uint8), np.full((nx, ny), np.nan)
    for x, y in np.ndindex(nx, ny):
        filled = np.nonzero(solid[x, y])[0]
        if len(filled) == 0:
            continue
        evidence = f64(voxel_map.log_odds)[1:, x, y, filled]
        evidence = evidence.sum(axis=-1) if rule.column == "sum" else evidence.max(axis=-1)
        probability[:, x, y] = sigmoid(evidence + f64(params.class_prior))
        label[x, y] = decide(evidence, params, rule, classes)
        height[x, y] = heights[x, y, filled].max()
    return probability, label, height, solid.any(axis=-1)


def inlier_share(residuals, sigma_m: float, nu_m: float, rounds: int) -> tuple[float, np.ndarray, np.ndarray]:
    """gamma by expectation maximisation; also the inlier density and posterior of each residual."""
    density = np.exp(-0.5 * (residuals / sigma_m) ** 2) / (np.sqrt(2 * np.pi) * sigma_m)
    gamma = 0.5
    for _ in range(rounds):
        posterior = gamma * density / (gamma * density + (1 - gamma) / nu_m)
        gamma = float(np.clip(posterior.mean(), 1e-3, 1 - 1e-3))
    return gamma, density, gamma * density / (gamma * density + (1 - gamma) / nu_m)


def plane_cost(residuals, sigma_m: float, nu_m: float, rounds: int, cost: str) -> float:
    """Negative log-likelihood of the mixture (Torr and Zisserman 2000), or MSAC's truncated squares."""
    if cost == "msac":
        return float(np.minimum(residuals**2, (1.96 * sigma_m) ** 2).sum())
    gamma, density, _ = inlier_share(residuals, sigma_m, nu_m, rounds)
    return float(-np.log(gamma * density + (1 - gamma) / nu_m).sum())


def least_squares_plane(points, weights, up) -> tuple[np.ndarray, float]:
    mean = weights @ points / weights.sum()
    spread = (points - mean) * np.sqrt(weights)[:, None]
    normal = np.linalg.svd(spread, full_matrices=False)[2][-1]
    normal = normal * (1 if normal @ up >= 0 else -1)
    return normal, float(-normal @ mean)


def fit_plane(sample, triples, every, up, *, sigma_m, nu_m, rounds, cost, max_tilt_rad):
    """The best plane through any triple, refitted to the sample, then to all points; also the share of inliers."""
    sample, every, up = f64(sample), f64(every), f64(up)
    best = (np.inf, up, 0.0)
    for a, b, c in sample[np.asarray(triples)]:
        normal = np.cross(b - a, c - a)
        if np.linalg.norm(normal) < 1e-9:
            continue
        normal *= (1 if normal @ up >= 0 else -1) / np.linalg.norm(normal)
        if normal @ up < np.cos(max_tilt_rad):
            continue
        score = plane_cost((sample - a) @ normal, sigma_m, nu_m, rounds, cost)
        best = min(best, (score, normal, -normal @ a), key=lambda entry: entry[0])
    _, normal, offset = best
    share = 0.0
    for _ in range(5):
        share, _, weights = inlier_share(sample @ normal + offset, sigma_m, nu_m, rounds)
        normal, offset = least_squares_plane(sample, weights, up)
    for _ in range(2):
        _, density, _ = inlier_share(every @ normal + offset, sigma_m, nu_m, 0)
        normal, offset = least_squares_plane(every, share * density / (share * density + (1 - share) / nu_m), up)
    return normal, offset, share


def plane_labels(plane, points_world, valid, threshold_m, max_height_m, sand: int, rock: int):
    """Label and keep flag of each point from its distance to the plane."""
    off = np.abs(f64(points_world) @ f64(plane.normal) + float(plane.offset_m))
    if not bool(plane.found):
        return np.full(len(off), IGNORE), np.asarray(valid)
    return np.where(off > threshold_m, rock, sand), np.asarray(valid) & (off <= max_height_m)


class Stepped(NamedTuple):
    """The map after a frame, and the voxels whose verdict no rounding can turn."""

    log_odds: np.ndarray
    sure: np.ndarray


def step(log_odds, grid, frame, camera, params, rule, depth_range_m, label, left_out=()) -> Stepped:
    """One frame into the map; `label` is `(points_world, valid) -> PointLabels`."""
    points_camera, valid = disparity_to_points(camera, frame.disparity_px)
    depth_m = points_camera[..., 2]
    in_range = (valid & (depth_m >= depth_range_m[0]) & (depth_m <= depth_range_m[1])).reshape(-1)
    points_world = transform_points(frame.T_world_camera, points_camera.reshape(-1, 3))
    labels = label(points_world, in_range)
    labels = labels._replace(keep=kept(labels, left_out))
    weights = np.ones(depth_m.size)
    if rule.range_weighting:
        weights = range_weight(camera, grid, depth_m.reshape(-1), params)
    free, sure = None, np.ones(grid.shape, bool)
    if rule.carve:
        free, sure = carve(camera, frame.T_world_camera, depth_m, valid, grid, params, depth_range_m)
    scaled = scaled_points(grid, points_world)
    near_face = np.abs(scaled - np.round(scaled)).min(axis=-1) < 1e-4
    for place in np.floor(scaled[in_range & near_face]).astype(int):
        low, high = np.maximum(place - 1, 0), np.maximum(place + 2, 0)
        sure[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = False
    return Stepped(integrate(log_odds, grid, points_world, labels, weights, params, rule, free), sure)
