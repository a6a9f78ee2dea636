"""Semi-global matching, slowly: one pixel after the other, in NumPy."""

from __future__ import annotations

import itertools

import numpy as np

DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
"""Steps (rows, columns) along the paths; four have the first four."""


def at(image: np.ndarray, v: int, u: int) -> float:
    """A pixel, or the nearest one in the image."""
    height, width = image.shape
    return float(image[min(max(v, 0), height - 1), min(max(u, 0), width - 1)])


def census_cost(left: np.ndarray, right: np.ndarray, disparities: range, window_px: tuple[int, int]) -> np.ndarray:
    """Neighbours that are darker than the centre in one image alone, (H, W, D); all outside the right image."""
    rows, columns = (range(-(size // 2), size // 2 + 1) for size in window_px)
    around = [step for step in itertools.product(rows, columns) if step != (0, 0)]

    def darker(image: np.ndarray, v: int, u: int) -> list[bool]:
        return [at(image, v + dv, u + du) < image[v, u] for dv, du in around]

    height, width = left.shape
    cost = np.full((height, width, len(disparities)), len(around))
    for v, u, (place, disparity) in itertools.product(range(height), range(width), enumerate(disparities)):
        if 0 <= u - disparity < width:
            codes = darker(left, v, u), darker(right, v, u - disparity)
            cost[v, u, place] = sum(a != b for a, b in zip(*codes, strict=True))
    return cost


def mean_census_costs(
    left: np.ndarray, right: np.ndarray, disparities: range, window_px: tuple[int, int], block: int, steps: int
) -> np.ndarray:
    """The same in so many steps, each the mean over a block, rounded half up; what lies outside is as its nearest."""
    height, width = left.shape
    reach, bits = block // 2, window_px[0] * window_px[1] - 1
    # As wide as any match goes, so that nothing is outside yet.
    margin = max(abs(disparities[0]), abs(disparities[-1])) + 1

    def codes(image: np.ndarray) -> np.ndarray:
        rows, columns = (size // 2 for size in window_px)
        around = np.pad(image, ((rows, rows), (columns, columns)), "edge")
        near = np.lib.stride_tricks.sliding_window_view(around, window_px)
        return (near < image[..., None, None]).reshape(height, width, -1)

    there = np.pad(codes(right), ((0, 0), (margin, margin), (0, 0)), "edge")
    costs = np.stack(
        [(codes(left) != there[:, margin - d : margin - d + width]).sum(-1) * (steps // bits) for d in disparities], -1
    )
    around = np.pad(costs, ((reach, reach), (reach, reach), (0, 0)), "edge")
    sums = np.lib.stride_tricks.sliding_window_view(around, (block, block), (0, 1)).sum((-1, -2))
    means = (sums + block**2 // 2) // block**2
    column = np.arange(width)[:, None] - np.array(disparities)
    return np.where((column >= 0) & (column < width), means, steps)


def birchfield_tomasi_cost(left: np.ndarray, right: np.ndarray, disparities: range, cap: int) -> np.ndarray:
    """Of truncated gradients and of quarters of grey levels, (H, W, D); the largest outside the right image."""

    def gradient(image: np.ndarray) -> np.ndarray:
        slopes = np.zeros(image.shape)
        for v, u in np.ndindex(*image.shape):
            slope = sum(
                weight * (at(image, v + dv, u + 1) - at(image, v + dv, u - 1))
                for dv, weight in ((-1, 1), (0, 2), (1, 1))
            )
            slopes[v, u] = min(max(slope, -cap), cap) + cap
        return slopes

    def one_way(here: np.ndarray, there: np.ndarray, v: int, u: int, other: int) -> float:
        around = [at(there, v, other), *((at(there, v, other) + at(there, v, other + step)) / 2 for step in (-1, 1))]
        return max(here[v, u] - max(around), min(around) - here[v, u], 0)

    pairs = [(gradient(left), gradient(right)), (left / 4, right / 4)]
    height, width = left.shape
    cost = np.full((height, width, len(disparities)), 2 * cap + 255 / 4)
    for v, u, (place, disparity) in itertools.product(range(height), range(width), enumerate(disparities)):
        other = u - disparity
        if 0 <= other < width:
            cost[v, u, place] = sum(min(one_way(a, b, v, u, other), one_way(b, a, v, other, u)) for a, b in pairs)
    return cost


def aggregate(volume: np.ndarray, p1: float, p2: float, paths: int) -> np.ndarray:
    """Sum of the costs of the cheapest paths, by the recurrence as Hirschmueller wrote it."""
    height, width, count = volume.shape
    total = np.zeros(volume.shape)
    for dv, du in DIRECTIONS[:paths]:
        end = np.zeros(volume.shape)
        for v in range(height)[:: -1 if dv < 0 else 1]:
            for u in range(width)[:: -1 if du < 0 else 1]:
                end[v, u] = volume[v, u]
                if not (0 <= v - dv < height and 0 <= u - du < width):
                    continue
                before = end[v - dv, u - du]
                for d in range(count):
                    steps = [before[d], before.min() + p2]
                    steps += [before[k] + p1 for k in (d - 1, d + 1) if 0 <= k < count]
                    end[v, u, d] += min(steps) - before.min()
        total += end
    return total


def winners(total: np.ndarray) -> tuple[np.ndarray, ...]:
    """Of each pixel the cheapest place, its cost, the least cost that is not beside it, and the two that are."""
    last = total.shape[2] - 1
    place = total.argmin(2)
    apart = np.abs(np.arange(last + 1) - place[..., None]) > 1
    second = np.where(apart, total, np.iinfo(np.uint16).max).min(2)
    costs = [np.take_along_axis(total, np.clip(place + step, 0, last)[..., None], 2)[..., 0] for step in (0, -1, 1)]
    return place, costs[0], second, *costs[1:]


def select(total: np.ndarray, first: int, uniqueness: float, left_right: float) -> np.ndarray:
    """Disparities, NaN where the winner is not unique or the right image disagrees."""
    height, width, count = total.shape
    disparity_px = np.full((height, width), np.nan)
    other_costs: dict[tuple[int, int], list[tuple[float, int]]] = {}
    for v, u in np.ndindex(height, width):
        best = int(total[v, u].argmin())
        other_costs.setdefault((v, u - first - best), []).append((total[v, u, best], best))
    for v, u in np.ndindex(height, width):
        costs = total[v, u]
        best = int(costs.argmin())
        other = u - first - best
        far = [costs[d] for d in range(count) if abs(d - best) > 1]
        if not 0 <= other < width or (far and min(far) * (1 - uniqueness) <= costs[best]):
            continue
        if left_right >= 0 and abs(min(other_costs[v, other])[1] - best) > left_right:
            continue
        offset = 0.0
        if 0 < best < count - 1:
            before, after = costs[best - 1], costs[best + 1]
            bend = before + after - 2 * costs[best]
            offset = (before - after) / (2 * bend) if bend > 0 else 0.0
        disparity_px[v, u] = first + best + offset
    return disparity_px


def drop_blobs(disparity_px: np.ndarray, step_px: float, most_px: int) -> np.ndarray:
    """Flood fill from each pixel; NaN where it reaches few."""
    kept, done = disparity_px.copy(), np.isnan(disparity_px)
    for start in np.ndindex(*disparity_px.shape):
        if done[start]:
            continue
        blob, front = {start}, [start]
        while front:
            v, u = front.pop()
            for near in ((v + 1, u), (v - 1, u), (v, u + 1), (v, u - 1)):
                if near in blob or not all(0 <= i < n for i, n in zip(near, disparity_px.shape, strict=True)):
                    continue
                if abs(disparity_px[near] - disparity_px[v, u]) <= step_px:
                    blob.add(near)
                    front.append(near)
        for pixel in blob:
            done[pixel] = True
            if len(blob) <= most_px:
                kept[pixel] = np.nan
    return kept


def drop_edges(disparity_px: np.ndarray, step_px: float, window_px: int) -> np.ndarray:
    """NaN where known disparities in the window differ by more."""
    half = window_px // 2
    kept = disparity_px.copy()
    for v, u in np.ndindex(*disparity_px.shape):
        near = disparity_px[max(v - half, 0) : v + half + 1, max(u - half, 0) : u + half + 1]
        if np.isfinite(near).any() and np.nanmax(near) - np.nanmin(near) > step_px:
            kept[v, u] = np.nan
    return kept
