"""What people, rovers and the wind have left in the sand: footprints, wheel tracks, drifts against rocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float32

from jaxmap.simulation.draw import Draw
from jaxmap.simulation.recipe import ReliefRecipe
from jaxmap.simulation.rocks import Rock

CELL_M = 0.01
"""Cells of the raster that marks are drawn on."""

_SUBPIXEL_BITS = 4
_GAUGE_M, _WHEEL_WIDTH_M, _GROUSER_M = 0.62, 0.12, 0.075


class Marks(NamedTuple):
    """A raster of what is added to the height of the ground (metres), and of how much it is disturbed (0 to 1)."""

    lower_m: Float[np.ndarray, "2"]
    height_m: Float32[np.ndarray, "R C"]
    disturbed: Float32[np.ndarray, "R C"]

    def at(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Added height and disturbance at world x and y; zero outside the raster."""
        # OpenCV takes images of at most 32767 rows.
        column = np.reshape((x - self.lower_m[0]) / CELL_M - 0.5, (1, -1)).astype(np.float32)
        row = np.reshape((y - self.lower_m[1]) / CELL_M - 0.5, (1, -1)).astype(np.float32)
        results = []
        for layer in (self.height_m, self.disturbed):
            parts = [
                cv2.remap(layer, column[:, i : i + 16384], row[:, i : i + 16384], cv2.INTER_LINEAR)
                for i in range(0, column.size, 16384)
            ]
            results.append(np.concatenate(parts, axis=1).reshape(np.shape(x)))
        return results[0], results[1]


def make_marks(
    relief: ReliefRecipe, rocks: Sequence[Rock], lower_m: Float[np.ndarray, "2"], upper_m: Float[np.ndarray, "2"]
) -> Marks:
    """Draws all marks between two corners of the world."""
    draw = Draw(relief.seed, "marks")
    columns, rows = (int(np.ceil((upper - lower) / CELL_M)) for lower, upper in zip(lower_m, upper_m, strict=True))
    pressed = np.zeros((rows, columns), np.uint8)
    for _ in range(relief.walks):
        _walk(pressed, lower_m, upper_m, draw)
    deep = draw.uniform(0.008, 0.03)
    height = _impression(pressed, deep)
    wheels = np.zeros_like(pressed)
    bars = np.zeros_like(pressed)
    for _ in range(relief.tracks):
        _track(wheels, bars, lower_m, upper_m, draw)
    height += _impression(wheels, draw.uniform(0.008, 0.025))
    height -= draw.uniform(0.003, 0.008) * _blurred(bars, 0.008)
    disturbed = np.maximum(_blurred(pressed, 0.02), _blurred(wheels, 0.02))
    _heap_drifts(height, rocks, relief.drift, lower_m)
    return Marks(lower_m, height, disturbed)


def _blurred(mask: np.ndarray, radius_m: float) -> np.ndarray:
    if not mask.any():
        return np.zeros(mask.shape, np.float32)
    return cv2.GaussianBlur(mask.astype(np.float32), (0, 0), radius_m / CELL_M)


def _impression(mask: np.ndarray, deep_m: float) -> np.ndarray:
    """Pressed in where the mask is, and a rim of what gave way around it."""
    floor = _blurred(mask, 0.009)
    rim = np.maximum(_blurred(mask, 0.035) - floor, 0)
    return deep_m * (0.7 * rim - floor)


def _cells(points: np.ndarray, lower_m: np.ndarray) -> np.ndarray:
    """Fixed-point pixels, as OpenCV's drawing takes them."""
    return np.round(((points - lower_m) / CELL_M - 0.5) * 2**_SUBPIXEL_BITS).astype(np.int32)


def _curve(lower_m: np.ndarray, upper_m: np.ndarray, step_m: float, draw: Draw) -> tuple[np.ndarray, np.ndarray]:
    """Points of a line that wanders through the middle of the area, and its heading at each."""
    middle = lower_m + (upper_m - lower_m) * draw.rng.uniform(0.3, 0.7, 2)
    count = int(1.2 * np.linalg.norm(upper_m - lower_m) / step_m)
    turns = cv2.GaussianBlur(draw.rng.normal(0, 1, (1, count)), (0, 0), 2.0 / step_m)[0]
    heading = draw.uniform(0, 2 * np.pi) + np.cumsum(turns) * step_m * draw.uniform(0.0, 4.0)
    points = np.cumsum(step_m * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    return points - points[count // 2] + middle, heading


def _walk(mask: np.ndarray, lower_m: np.ndarray, upper_m: np.ndarray, draw: Draw) -> None:
    points, headings = _curve(lower_m, upper_m, draw.uniform(0.55, 0.8), draw)
    size = draw.uniform(0.85, 1.15)
    for index, (point, heading) in enumerate(zip(points, headings, strict=True)):
        side = 0.09 if index % 2 else -0.09
        turn = heading + draw.rng.normal(0, 0.08) - 0.12 * np.sign(side)
        along, left = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
        foot = point + side * left + draw.rng.normal(0, 0.02, 2)
        for offset, length, width in ((0.05, 0.085, 0.05), (-0.085, 0.045, 0.036)):
            centre = _cells(foot + offset * size * along, lower_m)
            axes = np.round(np.array([length, width]) * size / CELL_M * 2**_SUBPIXEL_BITS).astype(int)
            angle = float(np.rad2deg(turn))
            cv2.ellipse(mask, _pair(centre), _pair(axes), angle, 0, 360, 1, -1, shift=_SUBPIXEL_BITS)


def _track(wheels: np.ndarray, bars: np.ndarray, lower_m: np.ndarray, upper_m: np.ndarray, draw: Draw) -> None:
    points, headings = _curve(lower_m, upper_m, _GROUSER_M, draw)
    left = np.stack([-np.sin(headings), np.cos(headings)], axis=1)
    for side in (-0.5, 0.5):
        line = points + side * _GAUGE_M * left
        thick = round(_WHEEL_WIDTH_M / CELL_M)
        cv2.polylines(wheels, [_cells(line, lower_m)], False, 1, thick, shift=_SUBPIXEL_BITS)
        ends = _cells(line + _WHEEL_WIDTH_M / 2 * left, lower_m), _cells(line - _WHEEL_WIDTH_M / 2 * left, lower_m)
        for start, end in zip(*ends, strict=True):
            cv2.line(bars, _pair(start), _pair(end), 1, 2, shift=_SUBPIXEL_BITS)


def _pair(values: np.ndarray) -> tuple[int, int]:
    return int(values[0]), int(values[1])


def _heap_drifts(height: np.ndarray, rocks: Sequence[Rock], drift: float, lower_m: np.ndarray) -> None:
    """Sand against the foot of rocks, falling off over half of their width."""
    for rock in rocks:
        reach = 1.6 * rock.diameter_m
        first = np.floor((np.array([rock.x_m, rock.y_m]) - reach - lower_m) / CELL_M).astype(int)
        count = int(2 * reach / CELL_M) + 2
        columns = np.arange(max(first[0], 0), min(first[0] + count, height.shape[1]))
        rows = np.arange(max(first[1], 0), min(first[1] + count, height.shape[0]))
        if not columns.size or not rows.size:
            continue
        x = lower_m[0] + (columns + 0.5) * CELL_M - rock.x_m
        y = lower_m[1] + (rows + 0.5) * CELL_M - rock.y_m
        beyond = np.maximum(np.hypot(x[None, :], y[:, None]) / (0.5 * rock.diameter_m) - 0.9, 0)
        heap = drift * rock.height_m * (1 - rock.burial) * np.exp(-((beyond / 0.7) ** 2))
        window = np.ix_(rows, columns)
        height[window] = np.maximum(height[window], height[window] * 0.3 + heap)
