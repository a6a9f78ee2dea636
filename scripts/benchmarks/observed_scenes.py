"""Observations of a made-up traverse: small frames of bumpy ground, as if they had been perceived."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxmap.mapping.observations import (
    Observation,
    ObservationAttributes,
    open_observations,
    write_attributes,
    write_observation,
)
from jaxmap.runs.config import PerceiveConfig, config_tree

HEIGHT_PX, WIDTH_PX = 30, 40
CAMERA = dict(fx_px=30.0, fy_px=30.0, cx_px=19.5, cy_px=14.5, baseline_m=0.3, doffs_px=0.0)
SIZE = dict(width_px=float(WIDTH_PX), height_px=float(HEIGHT_PX))
FARTHEST_M, VOXEL_M = 6.0, 0.1
MAP = ("--grid.voxel-size-m", str(VOXEL_M), "--depth.max-m", str(FARTHEST_M))
"""Options of a map of such a traverse: a view is as wide as a tile, so that there are many regions."""


def poses_along(rng: np.random.Generator, count: int, step_m: float = 1.7) -> np.ndarray:
    """Cameras on a winding path, a metre above the ground, that look down a little and to all sides."""
    heading = np.cumsum(rng.normal(0, 0.2, count))
    place = np.cumsum(step_m * np.stack([np.cos(heading), np.sin(heading), 0 * heading], axis=1), axis=0)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, angle, at in zip(poses, heading + rng.normal(0, 0.3, count), place, strict=True):
        forward = np.array([np.cos(angle) * 0.95, np.sin(angle) * 0.95, -0.31])
        forward /= np.linalg.norm(forward)
        right = np.array([np.sin(angle), -np.cos(angle), 0.0])
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = at + np.array([0.0, 0.0, 1.0])
    return poses


def disparities(rng: np.random.Generator, count: int) -> np.ndarray:
    """Ground with bumps, some of it unknown."""
    row = np.arange(HEIGHT_PX)[None, :, None] - 4.0
    disparity_px = np.maximum(row, 0.5) * 0.3 + rng.normal(0, 0.05, (count, HEIGHT_PX, WIDTH_PX)) + 1.2
    disparity_px[rng.random(disparity_px.shape) < 0.1] = np.nan
    return disparity_px.astype(np.float32)


def write_traverse(out: Path, count: int, seed: int = 0, labeller: str = "plane", step_m: float = 1.7) -> np.ndarray:
    """Writes observations as `jaxmap perceive --out OUT` would, and returns the poses."""
    rng, folder = np.random.default_rng(seed), out / "observations.zarr"
    poses, seen = poses_along(rng, count, step_m), disparities(rng, count)
    settings = config_tree(PerceiveConfig(labeller=labeller))
    attributes = ObservationAttributes(
        sequence="made up",
        name="traverse",
        dataset="folder",
        camera=CAMERA | SIZE,
        settings=settings,
        labeller=labeller,
        frames=count,
        complete=True,
    )
    write_attributes(folder, attributes)
    for index in range(count):
        write_observation(folder, Observation(f"f{index:05d}", 10.0 + index, poses[index], seen[index]), None)
    assert len(open_observations(folder).frames) == count
    return poses
