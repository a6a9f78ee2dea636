"""What one frame sees of the grid: its window, how much each pixel counts, and what lies free."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from jaxmap.fusion.carve import carve
from jaxmap.fusion.params import FusionParams, FusionRule
from jaxmap.fusion.sensor_model import range_weight
from jaxmap.geometry.grid import Window, view_window
from jaxmap.types import GridSpec, StereoCamera


class View(NamedTuple):
    """The part of the grid that a frame can touch, the weights of its pixels, and the voxels it saw through, if any."""

    window: Window
    weights: Float[Array, "N"]
    free: Bool[Array, "X Y Z"] | None


class Reach(NamedTuple):
    """How far frames reach: the depths that are mapped, in metres, and the voxels of a window that holds any view."""

    depth_range_m: tuple[float, float]
    window_shape: tuple[int, int, int]


def view_of(
    grid: GridSpec,
    camera: StereoCamera,
    T_world_camera: jaxlie.SE3,
    depth_m: Float[Array, "H W"],
    valid: Bool[Array, "H W"],
    params: FusionParams,
    rule: FusionRule,
    reach: Reach,
) -> View:
    """Looks at the grid from a pose, with the depths that were measured there (real where `valid`)."""
    window = view_window(grid, camera, T_world_camera, reach.depth_range_m[1], reach.window_shape)
    weights = jnp.ones(depth_m.size, depth_m.dtype)
    if rule.range_weighting:
        weights = range_weight(camera, window.grid, depth_m.reshape(-1), params)
    free = None
    if rule.carve:
        free = jax.lax.cond(
            # Nothing is fused across a conditional: as a part of what reads it, carving would be computed anew for
            # each of its readers.
            valid.any(),
            lambda: carve(camera, T_world_camera, depth_m, valid, grid, params, reach.depth_range_m, window),
            lambda: jnp.zeros(window.grid.shape, bool),
        )
    return View(window, weights, free)
