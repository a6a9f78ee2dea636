"""The grain of sand and stone: textures that repeat without a seam, looked up at the points that are hit."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32

from jaxmap.simulation.noise import seamless_noise
from jaxmap.simulation.recipe import SandRecipe, StoneRecipe

GRAIN_PERIOD_M, MOTTLE_PERIOD_M = 0.9, 5.3
"""Edges of the two tiles of sand; their ratio is far from a whole number, so that no pattern shows."""

STONE_PERIODS_M = (0.31, 0.083)
"""Edges of the block of stone at its two scales."""


class Textures(NamedTuple):
    """Repeating textures; reflectance is multiplied by one plus their first channels.

    Attributes:
        grain: (H, W, 5): red, green, blue, slope to the east, slope to the north.
        mottle: (H, W, 3): red, green, blue.
        stone: (D, H, W, 4): brightness, and the slope along x, y and z.
    """

    grain: Float32[np.ndarray, "H W 5"]
    mottle: Float32[np.ndarray, "P Q 3"]
    stone: Float32[np.ndarray, "D D D 4"]


def make_textures(sand: SandRecipe, stone: StoneRecipe, size: int = 1024) -> Textures:
    """The textures that the recipes describe; `size` is the edge of the grain tile in texels."""
    return Textures(_grain(sand, size), _mottle(sand, size // 2), _stone(stone))


def _grain(sand: SandRecipe, size: int) -> Float32[np.ndarray, "H W 5"]:
    fine = seamless_noise((size, size), sand.seed, slope=0.0, finest=1.5)
    lumps = seamless_noise((size, size), sand.seed + 1, slope=sand.grain_slope, finest=3.5, coarsest=size / 12)
    tint = seamless_noise((size, size), sand.seed + 2, slope=0.3, finest=2.0)
    height = 0.6 * fine + lumps
    albedo = sand.grain_contrast * (0.4 * fine + lumps)
    albedo += _specks(size, sand)
    colour = sand.grain_tint * tint
    gain = np.float32(sand.grain_relief)
    slopes = [gain * (np.roll(height, 1, axis) - np.roll(height, -1, axis)) / 2 for axis in (1, 0)]
    return np.stack([albedo + colour, albedo, albedo - colour, *slopes], axis=-1).astype(np.float32)


def _specks(size: int, sand: SandRecipe) -> np.ndarray:
    """Grit and bits of shell: single dark and bright grains of a few millimetres."""
    rng = np.random.default_rng([sand.seed, 0x5EC5])
    layer = np.zeros((size, size), np.float32)
    count = int(sand.specks_per_m2 * GRAIN_PERIOD_M**2)
    texels_per_m = size / GRAIN_PERIOD_M
    for _ in range(count):
        radius = max(0.6, rng.uniform(0.0008, 0.0035) * texels_per_m)
        value = rng.uniform(0.15, 0.8) if rng.random() < sand.speck_brightness else -rng.uniform(0.15, 0.6)
        x, y = rng.uniform(radius + 1, size - radius - 1, 2)
        axes = (max(1, round(radius)), max(1, round(radius * rng.uniform(0.5, 1.0))))
        cv2.ellipse(layer, (round(x), round(y)), axes, rng.uniform(0, 180), 0, 360, value, -1)
    return layer


def _mottle(sand: SandRecipe, size: int) -> Float32[np.ndarray, "H W 3"]:
    value = seamless_noise((size, size), sand.seed + 5, slope=sand.mottle_slope, finest=2.0, coarsest=size / 24)
    tint = seamless_noise((size, size), sand.seed + 6, slope=1.2, finest=2.0, coarsest=size / 24)
    contrast, colour = sand.mottle_contrast * value, 0.1 * sand.mottle_contrast * tint
    return np.stack([contrast + colour, contrast, contrast - colour], axis=-1).astype(np.float32)


def _stone(stone: StoneRecipe) -> Float32[np.ndarray, "D D D 4"]:
    size = 64
    value = seamless_noise((size, size, size), stone.seed, slope=stone.texture_slope, finest=1.5, coarsest=32)
    height = seamless_noise((size, size, size), stone.seed + 1, slope=stone.texture_slope, finest=2.0)
    slopes = [np.float32(stone.relief) * (np.roll(height, 1, axis) - np.roll(height, -1, axis)) for axis in (2, 1, 0)]
    return np.stack([np.float32(stone.contrast) * value, *slopes], axis=-1).astype(np.float32)
