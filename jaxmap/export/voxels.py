"""The occupied voxels of a map, as plain arrays on the host."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams
from jaxmap.fusion.query import occupied, voxel_labels
from jaxmap.labels import IGNORE
from jaxmap.types import VoxelMap


class OccupiedVoxels(NamedTuple):
    """Occupied voxels in row-major order of their index.

    `label` is a class index or `IGNORE`; `probability` is that of the label's class, and that of
    occupancy where the label is `IGNORE`. Centres are metres in the world, relative to the site's origin.
    """

    index: Int[np.ndarray, "N 3"]  # pyright: ignore[reportIncompatibleMethodOverride]
    centres_world: Float[np.ndarray, "N 3"]
    label: UInt8[np.ndarray, "N"]
    probability: Float[np.ndarray, "N"]
    voxel_size_m: Float[np.ndarray, "3"]


def occupied_voxels(voxel_map: VoxelMap, params: FusionParams, rule: FusionRule) -> OccupiedVoxels:
    """All voxels that are occupied under `params`, with the labels that `rule` gives them."""
    index = np.argwhere(np.asarray(jax.jit(occupied)(voxel_map, params))).astype(np.int32)
    at = tuple(index.T)
    label = np.asarray(voxel_labels(voxel_map, params, rule))[at]
    unlabelled = label == IGNORE
    channel = np.where(unlabelled, 0, label.astype(np.intp) + 1)
    prior = np.append(np.asarray(params.occupancy_prior), np.asarray(params.class_prior)).astype(np.float32)
    log_odds = np.asarray(voxel_map.log_odds)[(channel, *at)] + prior[channel]
    grid = voxel_map.grid
    size_m = np.asarray(grid.voxel_size_m)
    # Counted along the lattice: a voxel's centre is the same number in any block of the map.
    centres = (
        np.asarray(grid.lattice_m) + (index + np.asarray(grid.first) + np.float32(0.5)).astype(np.float32) * size_m
    )
    return OccupiedVoxels(
        index=index,
        centres_world=centres.astype(np.float32),
        label=label,
        probability=_sigmoid(log_odds),
        voxel_size_m=size_m,
    )


def _sigmoid(log_odds: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    # By tanh: no overflow at either end.
    return (0.5 + 0.5 * np.tanh(0.5 * log_odds)).astype(np.float32)
