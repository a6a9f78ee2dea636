"""Slow, readable twins of the simulator's kernels, one number at a time."""

from __future__ import annotations

import itertools
import math

import numpy as np


def mix(state: int) -> int:
    """One round of the 32-bit hash."""
    state = ((state ^ (state >> 16)) * 0x7FEB352D) & 0xFFFFFFFF
    return state ^ (state >> 15)


def gradient_noise(point: list[float], seed: int) -> float:
    """Gradient noise at one point: the corners' slopes, blended by a fade of fifth degree."""
    primes = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D)
    cell = [math.floor(value) for value in point]
    offset = [value - floor for value, floor in zip(point, cell, strict=True)]
    fade = [t**3 * (t * (6 * t - 15) + 10) for t in offset]
    total = 0.0
    for corner in itertools.product((0, 1), repeat=len(point)):
        state, weight = seed, 1.0
        for axis, side in enumerate(corner):
            state = mix(state ^ ((((cell[axis] + side) & 0xFFFFFFFF) * primes[axis]) & 0xFFFFFFFF))
            weight *= fade[axis] if side else 1 - fade[axis]
        slope = 0.0
        for axis, side in enumerate(corner):
            state = mix(state)
            slope += ((state >> 8) * 2.0**-23 - 1) * (offset[axis] - side)
        total += weight * slope
    return 1.65 * total


def sky_irradiance(sky: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Irradiance of the map of the sky on a plane that faces `normal`; below, the horizon's row goes on."""
    rows, columns = sky.shape[:2]
    total = np.zeros(3)
    bands = [(r, math.pi / 2 * (r / rows) ** 2, math.pi / 2 * ((r + 1) / rows) ** 2) for r in range(rows)]
    bands += [(0, -math.pi / 2 * (k + 1) / 60, -math.pi / 2 * k / 60) for k in range(60)]
    for row, low, high in bands:
        for column in range(columns):
            azimuth = math.pi * (2 * (column + 0.5) / columns - 1)
            elevation = (low + high) / 2
            direction = (
                math.cos(elevation) * math.cos(azimuth),
                math.cos(elevation) * math.sin(azimuth),
                math.sin(elevation),
            )
            solid_angle = (math.sin(high) - math.sin(low)) * 2 * math.pi / columns
            total += sky[row, column] * max(float(np.dot(direction, normal)), 0.0) * solid_angle
    return total
