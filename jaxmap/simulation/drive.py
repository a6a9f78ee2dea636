"""The rover's drive: a curved path over the ground, when it is where, and how it leans."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import CubicSpline

from jaxmap.simulation.camera_rig import CAMERA_HEIGHT_M, T_BODY_LEFT_POSITION_M
from jaxmap.simulation.recipe import DriveRecipe
from jaxmap.simulation.rock_shapes import Height

STANDSTILL_S = 4.0
"""The recording starts so long before the rover does: enough to level the inertial unit."""

WHEEL_BASE_M, WHEEL_TRACK_M = 0.6, 0.62

_RAMP_S, _KNOT_M = 2.0, 0.05
_BODY_HEIGHT_M = CAMERA_HEIGHT_M - T_BODY_LEFT_POSITION_M[2]


class Path(NamedTuple):
    """A line on the ground.

    Attributes:
        arc_m: distance driven at each point, `_KNOT_M` apart.
        points_m: x and y.
        heading_rad: from east by north, without jumps.
    """

    arc_m: Float64[np.ndarray, "P"]
    points_m: Float64[np.ndarray, "P 2"]
    heading_rad: Float64[np.ndarray, "P"]


def make_path(recipe: DriveRecipe, length_m: float) -> Path:
    """The path of the rover's middle, which passes the world's origin half way."""
    rng = np.random.default_rng([recipe.seed, 0xD41E])
    arc = np.arange(0.0, length_m + 2 * _KNOT_M, _KNOT_M)
    knots = np.linspace(0, arc[-1], max(2, int(arc[-1] / 2.5) + 1))
    bends = recipe.bend_per_m + recipe.wander_per_m * rng.standard_normal(len(knots))
    curvature = CubicSpline(knots, bends)(arc) if len(knots) > 3 else np.interp(arc, knots, bends)
    heading = np.deg2rad(recipe.heading_deg) + np.cumsum(curvature) * _KNOT_M
    steps = _KNOT_M * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    points = np.concatenate([[[0, 0]], np.cumsum(steps, axis=0)[:-1]])
    return Path(arc, points - points[len(points) // 2], heading)


class Drive:
    """The rover's poses at any time of a recording.

    Args:
        recipe: speed and start.
        path: where it drives.
        length_m: how far.
        ground_m: the ground it drives over.
    """

    def __init__(self, recipe: DriveRecipe, path: Path, length_m: float, ground_m: Height) -> None:
        self.recipe, self.path, self.length_m = recipe, path, length_m
        self.duration_s = 2 * STANDSTILL_S + length_m / recipe.speed_m_s + 2 * _RAMP_S
        time = np.arange(0.0, self.duration_s, 0.01)
        moving_s = length_m / recipe.speed_m_s
        rising = _smooth((time - STANDSTILL_S) / _RAMP_S)
        falling = _smooth((time - STANDSTILL_S - moving_s) / _RAMP_S)
        # Both ramps cost the same time, so the whole length is driven.
        driven = np.concatenate([[0], np.cumsum(recipe.speed_m_s * (rising - falling))[:-1] * 0.01])
        self._arc = CubicSpline(time, driven * (length_m / driven[-1]))
        x, y, z, pitch, roll = _attitude(path, ground_m)
        self._place = CubicSpline(path.arc_m, np.stack([x, y, z, path.heading_rad, pitch, roll], axis=1))

    def arc_m(self, time_s: Float64[np.ndarray, "N"]) -> Float64[np.ndarray, "N"]:
        """Distance driven, at seconds since the start of the recording."""
        return self._arc(np.clip(time_s, 0.0, self.duration_s - 0.01))

    def times_at(self, arc_m: Float64[np.ndarray, "N"]) -> Float64[np.ndarray, "N"]:
        """When the rover has driven so far, to a millisecond."""
        time = np.arange(0.0, self.duration_s - 0.01, 0.001)
        return np.round(np.interp(arc_m, np.maximum.accumulate(self._arc(time)), time), 3)

    def curvature_per_m(self, time_s: Float64[np.ndarray, "N"]) -> Float64[np.ndarray, "N"]:
        """Curvature of the path where the rover is, positive to the left."""
        return self._place(self.arc_m(time_s), 1)[:, 3]

    def T_world_body(self, time_s: Float64[np.ndarray, "N"]) -> Float64[np.ndarray, "N 4 4"]:
        """Poses of the body (x backward, y right, z up) in the world."""
        x, y, z, heading, pitch, roll = self._place(self.arc_m(time_s)).T
        zero = np.zeros_like(x)
        forward = np.stack([np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), np.sin(pitch)], axis=1)
        level_right = np.stack([np.sin(heading), -np.cos(heading), zero], axis=1)
        level_up = np.cross(level_right, forward)
        right = np.cos(roll)[:, None] * level_right - np.sin(roll)[:, None] * level_up
        T = np.tile(np.eye(4), (len(x), 1, 1))
        T[:, :3, 0], T[:, :3, 1], T[:, :3, 2] = -forward, right, np.cross(right, forward)
        T[:, :3, 3] = np.stack([x, y, z], axis=1) + _BODY_HEIGHT_M * T[:, :3, 2]
        return T


def _attitude(path: Path, ground_m: Height) -> tuple[np.ndarray, ...]:
    """Place of the middle on the ground, pitch (nose up) and roll (right side down) from where the wheels stand."""
    forward = np.stack([np.cos(path.heading_rad), np.sin(path.heading_rad)], axis=1)
    right = np.stack([np.sin(path.heading_rad), -np.cos(path.heading_rad)], axis=1)
    heights = {}
    for ahead in (-1, 0, 1):
        for side in (-1, 1):
            wheel = path.points_m + ahead * WHEEL_BASE_M / 2 * forward + side * WHEEL_TRACK_M / 2 * right
            heights[ahead, side] = ground_m(wheel[:, 0], wheel[:, 1]).astype(np.float64)
    z = np.mean(list(heights.values()), axis=0)
    rise = (heights[1, 1] + heights[1, -1] - heights[-1, 1] - heights[-1, -1]) / 2
    drop = np.mean([heights[ahead, -1] - heights[ahead, 1] for ahead in (-1, 0, 1)], axis=0)
    pitch, roll = np.arctan2(rise, WHEEL_BASE_M), np.arctan2(drop, WHEEL_TRACK_M)
    return path.points_m[:, 0], path.points_m[:, 1], z, pitch, roll


def _smooth(share: np.ndarray) -> np.ndarray:
    """From 0 to 1, smooth to the second derivative."""
    t = np.clip(share, 0, 1)
    return t**3 * (t * (6 * t - 15) + 10)
