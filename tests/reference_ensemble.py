"""Slow and readable twins of the ensemble, in float64 NumPy."""

from __future__ import annotations

import numpy as np
import reference
from reference import f64

from jaxmap.types import VoxelMap


def noise_of_blocks(blocks, corner, shape: tuple[int, int], block_px: int) -> np.ndarray:
    """Each pixel takes the number of its block."""
    noise = np.empty(shape)
    for row, column in np.ndindex(*shape):
        noise[row, column] = blocks[(row + corner[0]) // block_px, (column + corner[1]) // block_px]
    return noise


def doubted(probabilities, temperature: float, bias) -> np.ndarray:
    """Softmax of logits that were divided by a temperature and biased; what lacks to 1 is one more class."""
    probabilities = f64(probabilities)
    rest = 1 - probabilities.sum(axis=-1, keepdims=True)
    shares = np.concatenate([probabilities, np.where(rest > 1e-5, rest, 0.0)], axis=-1)
    logits = np.log(shares.clip(1e-30)) / temperature + np.append(f64(bias), 0.0)
    powers = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return (powers / powers.sum(axis=-1, keepdims=True))[..., :-1]


def layers(voxel_map, params, rule, target: str) -> tuple[np.ndarray, np.ndarray]:
    """Share of the maps that call a column by the class, of those that saw it; and where the map itself does not."""
    index = voxel_map.classes.index(target)
    _, label, _, observed = reference.top_down(voxel_map, params, rule)
    calls, seen = (label == index).astype(float), np.ones(label.shape)
    others = np.zeros((len(voxel_map.classes), *voxel_map.grid.shape))
    for member in f64(voxel_map.members):
        channels = others.copy()
        channels[index] = member[1]
        whole = VoxelMap(np.concatenate([member[:1], channels]), 0, voxel_map.grid, voxel_map.classes)
        _, label_m, _, observed_m = reference.top_down(whole, params, rule)
        calls += label_m == index
        seen += observed_m
    probability = np.where(observed, calls / seen, np.nan)
    return probability, np.where(label == index, 0.0, probability)
