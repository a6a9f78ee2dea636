"""Rovers with known poses, and the matches their cameras would give: no images, only numbers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxmap.refinement.matching import MatchTable
from jaxmap.refinement.residuals import linearise, make_device_rig
from jaxmap.refinement.rig import Rig
from jaxmap.refinement.solver import ResidualTerm
from jaxmap.types import Pinhole

CAMERA = Pinhole(fx_px=400.0, fy_px=410.0, cx_px=255.0, cy_px=190.0, baseline_m=0.12, doffs_px=0.5)
WIDTH_PX, HEIGHT_PX = 512, 384
HEIGHT_M = 1.1


def track(frames: int = 8, step_m: float = 0.5) -> np.ndarray:
    """T_world_camera of a camera 1.1 m above the ground, pitched down by 18 degrees, on a wavy course."""
    T = np.tile(np.eye(4), (frames, 1, 1))
    level = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float)
    for index in range(frames):
        angles = [0.1 * np.sin(index), np.radians(18) + 0.03 * np.sin(2 * index), 0.02 * np.cos(index)]
        T[index, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix() @ level
        T[index, :3, 3] = [step_m * index, 0.1 * np.sin(index), HEIGHT_M + ground_height(step_m * index, 0.0)]
    return T


def ground_height(x, y):
    """Rolling ground."""
    return 0.08 * np.sin(1.3 * x + 0.4) + 0.05 * np.cos(1.7 * y) + 0.03 * np.sin(3.1 * x - 2.3 * y)


def uvd_px(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Column, row and disparity of world points in a camera, NaN where it does not see them."""
    x, y, z = ((points - T[:3, 3]) @ T[:3, :3]).T
    ahead = np.where(z > 0.5, z, np.nan)
    column, row = CAMERA.fx_px * x / ahead + CAMERA.cx_px, CAMERA.fy_px * y / ahead + CAMERA.cy_px
    inside = (column > 0) & (column < WIDTH_PX) & (row > 0) & (row < HEIGHT_PX)
    disparity = CAMERA.fx_px * CAMERA.baseline_m / ahead - CAMERA.doffs_px
    return np.where(inside[:, None], np.stack([column, row, disparity], axis=-1), np.nan)


def ground_points(count: int, rng: np.random.Generator, length_m: float = 10.0) -> np.ndarray:
    x, y = rng.uniform(0.5, length_m, count), rng.uniform(-2.5, 2.5, count)
    return np.stack([x, y, ground_height(x, y)], axis=-1)


def matches_of(T: np.ndarray, rng: np.random.Generator, noise_px: float = 0.0, count: int = 1500) -> MatchTable:
    """Points that frames up to three apart both see."""
    points = ground_points(count, rng)
    seen = [uvd_px(one, points) for one in T]
    frames, pairs, rows = [], [], []
    for source in range(1, len(T)):
        for target in range(max(0, source - 3), source):
            both = np.isfinite(seen[source]).all(axis=1) & np.isfinite(seen[target]).all(axis=1)
            chosen = np.flatnonzero(both)[:60]
            if len(chosen):
                frames += [(source, target)] * len(chosen)
                pairs += [len(set(pairs))] * len(chosen)
                rows.append(np.stack([seen[source][chosen], seen[target][chosen]], axis=1))
    pixels = np.concatenate(rows)
    return MatchTable(np.array(frames), pixels + noise_px * rng.normal(size=pixels.shape), np.array(pairs))


def match_term(matches: MatchTable, sigma_px: float = 0.25) -> ResidualTerm:
    def at(rig: Rig):
        return linearise(make_device_rig(rig, CAMERA, np.zeros(3)), matches.frames, matches.uvd_px)

    return ResidualTerm(at, matches.frames, np.full(3, sigma_px), sigma_px, matches.pairs, 30.0)


class PoseErrors(NamedTuple):
    position_m: np.ndarray
    angle_deg: np.ndarray


def pose_errors(T: np.ndarray, T_true: np.ndarray) -> PoseErrors:
    turn = Rotation.from_matrix(T_true[:, :3, :3].transpose(0, 2, 1) @ T[:, :3, :3]).magnitude()
    return PoseErrors(np.linalg.norm(T[:, :3, 3] - T_true[:, :3, 3], axis=1), np.degrees(turn))


def disturbed(T: np.ndarray, rng: np.random.Generator, position_m: float, angle_deg: float) -> np.ndarray:
    """Each pose moved and turned by so much, in a direction of its own."""
    way, axis = (rng.normal(size=(len(T), 3)) for _ in range(2))
    moved = T.copy()
    moved[:, :3, 3] += position_m * way / np.linalg.norm(way, axis=1, keepdims=True)
    turn = np.radians(angle_deg) * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    moved[:, :3, :3] = moved[:, :3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    return moved
