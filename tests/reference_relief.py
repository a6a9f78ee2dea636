"""The slow, readable twin of `jaxmap.geometry.relief` and `jaxmap.geometry.ground`, in float64."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from reference import f64
from scipy import ndimage

from jaxmap.geometry.options import GroundOptions
from jaxmap.types import StereoCamera

STRIDE = 4


class Twin(NamedTuple):
    """As `Relief`."""

    height_m: np.ndarray
    sigma_m: np.ndarray
    slope: np.ndarray
    roughness_m: np.ndarray
    step_m: np.ndarray
    depth_m: np.ndarray
    known: np.ndarray
    floating: np.ndarray
    found: bool


def relief(camera: StereoCamera, up_camera, disparity_px, disparity_sigma_px: float, options: GroundOptions) -> Twin:
    """Pixel by pixel, cell by cell."""
    blocks_px = block_means(f64(disparity_px))
    R = level_rotation(f64(up_camera))
    fx, fy, cx, cy, baseline_m, doffs_px = (
        float(getattr(camera, name)) for name in ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m", "doffs_px")
    )
    v, u = np.mgrid[: blocks_px.shape[0], : blocks_px.shape[1]] * STRIDE + (STRIDE - 1) / 2
    valid = np.isfinite(blocks_px) & (blocks_px + doffs_px > 1e-6 * STRIDE)
    depth_m = np.where(valid, baseline_m * fx / np.where(valid, blocks_px + doffs_px, 1.0), 1.0)
    points = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1) * depth_m[..., None] @ R.T
    x, y, z = np.moveaxis(points, -1, 0)
    sigma_depth_m = depth_m**2 * disparity_sigma_px / (baseline_m * fx)
    sigma_z_m = np.abs(z) * sigma_depth_m / depth_m

    edge_m = max(options.cell_m, options.range_m / 160)
    rows = round(options.range_m / edge_m)
    columns = 2 * round(0.75 * rows)
    row, column = np.floor(x / edge_m).astype(int), np.floor(y / edge_m).astype(int) + columns // 2
    inside = valid & (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    row, column = np.where(inside, row, 0), np.where(inside, column, 0)
    focal_px = np.sqrt(fx * fy) / STRIDE

    def cells_of(inside: np.ndarray):
        """Mean x, y, z and sigma of the cells, and which were seen."""
        means, seen = np.zeros((4, rows, columns)), np.zeros((rows, columns), bool)
        for i in range(rows):
            for j in range(columns):
                here = inside & (row == i) & (column == j)
                mean = [values[here].mean() if here.any() else 0.0 for values in (x, y, z, sigma_z_m)]
                facing_px = (focal_px * edge_m) ** 2 / max(np.square(mean[:3]).sum(), 0.01)
                seen[i, j] = here.sum() > 0.1 * min(facing_px, 100)
                centre = [(i + 0.5) * edge_m, (j + 0.5 - columns // 2) * edge_m, 0.0]
                means[:, i, j] = mean if seen[i, j] else [*centre, mean[3]]
        return means, seen

    means, seen = cells_of(inside)
    plane = robust_plane(means[:, seen])
    above_m = z - height_at(plane, x, y)
    on_plane = inside & (np.abs(above_m) < 0.3)
    found = (
        seen.sum() >= 30
        and plane[0] < 0
        and np.hypot(plane[1], plane[2]) < 1.2
        and on_plane.sum() >= 0.3 * inside.sum()
    )
    floating = np.zeros_like(inside)
    for i, j in np.argwhere(valid & (above_m > 0.5)):
        columns_below = straight_below(
            points[i, j], R, (fx / STRIDE, fy / STRIDE), (u[0, 0] - cx, v[0, 0] - cy), inside.shape
        )
        farthest_m = [max((depth_m[at] for at in below if on_plane[at]), default=0.0) for below in columns_below]
        floating[i, j] = found and min(farthest_m) > depth_m[i, j] + 1 + 3 * sigma_depth_m[i, j]
    inside &= ~floating
    means, seen = cells_of(inside)
    cell_x, cell_y, cell_z, cell_sigma_m = means
    centre_x = np.broadcast_to((np.arange(rows)[:, None] + 0.5) * edge_m, seen.shape)
    centre_y = np.broadcast_to((np.arange(columns) + 0.5 - columns // 2) * edge_m, seen.shape)
    rest_m = np.where(seen, cell_z - height_at(plane, cell_x, cell_y), 0.0)

    mass, total_m = gaussian_sums(seen, 0.8), gaussian_sums(seen * rest_m, 0.8)
    present, smooth_m = mass > 0.05, total_m / np.maximum(mass, 1e-6)
    level_m = opened(smooth_m, present, max(1, round(options.rock_m / edge_m / 2)))
    surface = np.stack([level_m, np.zeros_like(level_m), np.zeros_like(level_m)])
    for _ in range(3):
        off_m = rest_m - height_at(surface, cell_x - centre_x, cell_y - centre_y)
        scale_m = 3 * (options.tolerance_m + 2 * cell_sigma_m)
        weight = seen * np.maximum(1 - (off_m / scale_m) ** 2, 0) ** 2
        surface = local_planes(weight, cell_x, cell_y, rest_m, centre_x, centre_y, options.smooth_m)
    off_m = rest_m - height_at(surface, cell_x - centre_x, cell_y - centre_y)
    squares = gaussian_sums(seen * np.minimum(off_m**2, 0.25), 2.5) / np.maximum(gaussian_sums(seen, 2.5), 1e-6)
    top_m = ndimage.maximum_filter(np.where(present, smooth_m, -np.inf), 5, mode="nearest")
    bottom_m = ndimage.minimum_filter(np.where(present, smooth_m, np.inf), 5, mode="nearest")
    step_m = np.where(top_m > bottom_m, top_m - bottom_m, 0.0)

    level_m = surface[0] + height_at(plane, centre_x, centre_y)
    slope_x, slope_y = surface[1] + plane[1], surface[2] + plane[2]
    at = row, column
    height_m = z - level_m[at] - slope_x[at] * (x - centre_x[at]) - slope_y[at] * (y - centre_y[at])
    sigma_m = np.abs(z - slope_x[at] * x - slope_y[at] * y) / depth_m * sigma_depth_m
    known = inside & seen[at] & found
    slope = surface_slope(blocks_px + doffs_px, u - cx, v - cy, fx, fy, R[2])
    values = (height_m, sigma_m, slope, np.sqrt(squares)[at], step_m[at], depth_m)
    return Twin(*(np.where(known, value, 0.0) for value in values), known, floating, bool(found))


def block_means(disparity_px: np.ndarray) -> np.ndarray:
    """Of squares of pixels, cut off at the edges; NaN where less than half of a whole square is known."""
    height, width = (-(-edge // STRIDE) for edge in disparity_px.shape)
    means = np.full((height, width), np.nan)
    for i in range(height):
        for j in range(width):
            block = disparity_px[STRIDE * i : STRIDE * (i + 1), STRIDE * j : STRIDE * (j + 1)]
            known = block[np.abs(block) < 1e5]
            if 2 * known.size >= STRIDE**2:
                means[i, j] = known.mean()
    return means


def level_rotation(up: np.ndarray) -> np.ndarray:
    """R_level_camera."""
    up = up / np.linalg.norm(up)
    ahead = np.array([0.0, -1.0, 0.0]) if abs(up[2]) > 0.999 else np.array([0.0, 0.0, 1.0])
    forward = ahead - (ahead @ up) * up
    forward /= np.linalg.norm(forward)
    return np.stack([forward, np.cross(up, forward), up])


def straight_below(point, R, focal_px, corner_px, shape) -> list[list[tuple[int, int]]]:
    """The blocks below a point: those of three columns of a level camera's image, from the point's row on."""
    height, width = shape
    level_px, middle, (x, y, z) = np.sqrt(focal_px[0] * focal_px[1]), (width - 1) / 2, point
    here = np.round(middle - y / x * level_px) if x > 0 else -1
    if not 0 <= here < width:
        return [[]]
    blocks = [[], [], []]
    for row in range(max(int(np.round(-z / x * level_px)), 0), height):
        for below, column in zip(blocks, np.clip([here - 1, here, here + 1], 0, width - 1), strict=True):
            ray = np.array([1.0, (middle - column) / level_px, -row / level_px]) @ R
            if ray[2] > 0:
                j = int(np.round(focal_px[0] * ray[0] / ray[2] - corner_px[0] / STRIDE))
                i = int(np.round(focal_px[1] * ray[1] / ray[2] - corner_px[1] / STRIDE))
                if 0 <= i < height and 0 <= j < width:
                    below.append((i, j))
    return blocks


def height_at(plane, x, y):
    """Of a plane: height at the origin, slopes along x and y."""
    return plane[0] + plane[1] * x + plane[2] * y


def robust_plane(means: np.ndarray) -> np.ndarray:
    """By reweighted least squares; `means` are x, y, z and sigma of the cells."""
    if means.shape[1] < 3:
        return np.zeros(3)
    x, y, z, sigma_m = means
    design, weight = np.stack([np.ones_like(x), x, y], axis=1), np.ones_like(x)
    for scale_m in (2.0, 1.0, 0.5, 0.3, 0.2, 0.15, 0.15, None):
        root = np.sqrt(weight)
        plane = np.linalg.lstsq(design * root[:, None], z * root, rcond=None)[0]
        if scale_m is not None:
            above_m = z - design @ plane
            weight = 1 / (1 + (above_m / (np.where(above_m > 0, 1, 2) * scale_m + 2 * sigma_m)) ** 2)
    return plane


def gaussian_sums(field: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian sums over cells; `sigma` in cells."""
    reach = max(field.shape)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    for axis in (0, 1):
        field = ndimage.correlate1d(f64(field), weights, axis, mode="constant")
    return field


def opened(heights_m: np.ndarray, present: np.ndarray, reach: int) -> np.ndarray:
    """Opening by a square of cells that are present."""
    size = 2 * reach + 1
    low_m = ndimage.minimum_filter(np.where(present, heights_m, np.inf), size, mode="nearest")
    high_m = ndimage.maximum_filter(np.where(np.isfinite(low_m), low_m, -np.inf), size, mode="nearest")
    return np.where(np.isfinite(high_m), high_m, 0.0)


def local_planes(weight, x, y, z, centre_x, centre_y, sigma_m: float) -> np.ndarray:
    """Height and slopes at each cell of the plane through its weighted surroundings, by ridge regression."""
    planes = np.zeros((3, *x.shape))
    for i, j in np.ndindex(x.shape):
        apart2 = (centre_x - centre_x[i, j]) ** 2 + (centre_y - centre_y[i, j]) ** 2
        share = weight * np.exp(-0.5 * apart2 / sigma_m**2)
        mass = share.sum()
        if mass < 1e-6:
            continue
        mean_x, mean_y, mean_z = ((share * values).sum() / mass for values in (x, y, z))
        dx, dy = x - mean_x, y - mean_y
        moments = np.array([[(share * a * b).sum() / mass for b in (dx, dy)] for a in (dx, dy)])
        along = [(share * a * (z - mean_z)).sum() / mass for a in (dx, dy)]
        slope_x, slope_y = np.linalg.solve(moments + 0.1**2 * np.eye(2), along)
        height_m = mean_z + slope_x * (centre_x[i, j] - mean_x) + slope_y * (centre_y[i, j] - mean_y)
        planes[:, i, j] = mass / (mass + 1e-3) * np.array([height_m, slope_x, slope_y])
    return planes


def surface_slope(shifted_px: np.ndarray, u: np.ndarray, v: np.ndarray, fx: float, fy: float, up: np.ndarray):
    """Tangent of the slope, from means of disparity over boxes of three by three blocks, two to each side."""
    height, width = shifted_px.shape
    known = np.isfinite(shifted_px)

    def box(i: int, j: int):
        """Mean u, v and disparity of the known blocks, and whether there are enough."""
        i, j = min(max(i, 0), height - 1), min(max(j, 0), width - 1)
        place = slice(max(i - 1, 0), i + 2), slice(max(j - 1, 0), j + 2)
        here = known[place]
        if not here.any():
            return np.zeros(3), False
        return np.array([image[place][here].mean() for image in (u, v, shifted_px)]), here.sum() > 4

    slope = np.zeros((height, width))
    for i, j in np.argwhere(known):
        equations = []
        for axis, (di, dj) in enumerate([(0, 2), (2, 0)]):
            (before, one), (after, other) = box(i - di, j - dj), box(i + di, j + dj)
            equations.append(after - before if one and other else np.array([axis == 0, axis == 1, 0.0], float))
        (du, dv, dd), (eu, ev, ed) = equations
        a, b = np.linalg.solve([[du, dv], [eu, ev]], [dd, ed])
        mean_u, mean_v, mean_d = box(i, j)[0]
        normal = np.array([a * fx, b * fy, mean_d - a * mean_u - b * mean_v])
        upright = normal @ up
        slope[i, j] = min(np.linalg.norm(np.cross(normal, up)) / max(abs(upright), 1e-9), 20.0)
    return slope
