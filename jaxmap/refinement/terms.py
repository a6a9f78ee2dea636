"""Residuals of matches and of heights, and their derivatives by everything that made them."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmap.fusion.splat import sample_columns
from jaxmap.refinement.rig import PER_FRAME, SHARED, Rig
from jaxmap.refinement.views import Pinhole
from jaxmap.types import GridSpec

CHUNK = 4096
"""Residuals are computed so many at a time, so that one program serves any number of them."""


class Setting(NamedTuple):
    """The rig and camera as the residuals take them, float32."""

    R_world_nominal: Float[Array, "N 3 3"]
    t_world_nominal: Float[Array, "N 3"]
    R_nominal_camera: Float[Array, "3 3"]
    t_nominal_camera: Float[Array, "3"]
    baseline_m: Float[Array, ""]
    doffs_px: Float[Array, ""]
    focal_px: Float[Array, "2"]
    centre_px: Float[Array, "2"]


def make_setting(rig: Rig, camera: Pinhole, origin_m: np.ndarray) -> Setting:
    """A rig in float32, its positions relative to an origin nearby."""
    single = [
        rig.T_world_nominal[:, :3, :3],
        rig.T_world_nominal[:, :3, 3] - origin_m,
        rig.T_nominal_camera[:3, :3],
        rig.T_nominal_camera[:3, 3],
        camera.baseline_m * np.exp(rig.log_baseline_scale),
        camera.doffs_px + rig.offset_px,
        [camera.fx_px, camera.fy_px],
        [camera.cx_px, camera.cy_px],
    ]
    return Setting(*(jnp.asarray(value, jnp.float32) for value in single))


class Linearised(NamedTuple):
    """Residuals and their derivatives, float64.

    Attributes:
        residual: (M, R).
        by_frames: (M, R, F, 6), by the numbers of the F frames of a term.
        by_shared: (M, R, 8).
        by_disparity: (M, R), by the disparity that its point was made of.
    """

    residual: np.ndarray
    by_frames: np.ndarray
    by_shared: np.ndarray
    by_disparity: np.ndarray


def _world_from_camera(setting: Setting, frame: Int[Array, ""], own: Array, shared: Array) -> jaxlie.SE3:
    """T_world_camera of a frame after a step of its own numbers and the shared ones."""
    nominal = _moved(setting.R_world_nominal[frame], setting.t_world_nominal[frame], own)
    return nominal @ _moved(setting.R_nominal_camera, setting.t_nominal_camera, shared[:6])


def _moved(R: Array, t: Array, step: Array) -> jaxlie.SE3:
    rotation = jaxlie.SO3.from_matrix(R) @ jaxlie.SO3.exp(step[3:6])
    return jaxlie.SE3.from_rotation_and_translation(rotation, t + step[:3])


def _point(setting: Setting, seen_px: Float[Array, "3"], shared: Array, more_px: Array) -> Float[Array, "3"]:
    """The point of column, row and disparity in the camera frame."""
    shifted = seen_px[2] + more_px + setting.doffs_px + shared[7]
    depth = setting.baseline_m * jnp.exp(shared[6]) * setting.focal_px[0] / shifted
    across = (seen_px[:2] - setting.centre_px) / setting.focal_px * depth
    return jnp.append(across, depth)


def _match_residual(step: Float[Array, "21"], setting: Setting, frames: Int[Array, "2"], seen: Float[Array, "2 3"]):
    """Column, row and disparity of a point as one frame tells it and the other sees it."""
    own, shared, more_px = step[:12].reshape(2, PER_FRAME), step[12:20], step[20]
    source, target = (_world_from_camera(setting, frames[place], own[place], shared) for place in (0, 1))
    point = target.inverse() @ (source @ _point(setting, seen[0], shared, more_px))
    depth = jnp.maximum(point[2], 0.05)
    column_row = point[:2] / depth * setting.focal_px + setting.centre_px
    disparity = setting.baseline_m * jnp.exp(shared[6]) * setting.focal_px[0] / depth
    return jnp.append(column_row, disparity - setting.doffs_px - shared[7]) - seen[1]


class Surface(NamedTuple):
    """Heights over the ground: a grid one voxel high, and in its columns the height and 1 where it is known, else 0."""

    grid: GridSpec
    fields: Float[Array, "2 X Y"]


def _surface_residual(
    step: Float[Array, "15"], setting: Setting, frames: Int[Array, "1"], seen: Float[Array, "1 3"], surface: Surface
):
    """Height of a point above a surface; nothing where the surface is not known."""
    own, shared, more_px = step[:PER_FRAME], step[6:14], step[14]
    point = _world_from_camera(setting, frames[0], own, shared) @ _point(setting, seen[0], shared, more_px)
    # Sampled at the grid's own height, which holds whatever the point's is.
    place = point.at[2].set(surface.grid.origin_m[2] + 0.5 * surface.grid.voxel_size_m[2])
    height, known = sample_columns(surface.grid, surface.fields, place[None])[:, 0]
    return jnp.where(known > 0.99, point[2] - height, 0.0)[None]


@jax.jit
def _matches_at(setting: Setting, frames: Int[Array, "M 2"], seen: Float[Array, "M 2 3"]):
    def one(frames, seen):
        zero = jnp.zeros(2 * PER_FRAME + SHARED + 1)
        residual = _match_residual(zero, setting, frames, seen)
        return residual, jax.jacfwd(_match_residual)(zero, setting, frames, seen)

    return jax.vmap(one)(frames, seen)


@jax.jit
def _surface_at(setting: Setting, frames: Int[Array, "M 1"], seen: Float[Array, "M 1 3"], surface: Surface):
    def one(frames, seen):
        zero = jnp.zeros(PER_FRAME + SHARED + 1)
        residual = _surface_residual(zero, setting, frames, seen, surface)
        return residual, jax.jacfwd(_surface_residual)(zero, setting, frames, seen, surface)

    return jax.vmap(one)(frames, seen)


def linearise(setting: Setting, frames: np.ndarray, seen: np.ndarray, surface: Surface | None = None) -> Linearised:
    """Residuals of matches, or of points over a surface, with their derivatives.

    Args:
        setting: the rig and camera.
        frames: (M, 2) source and target of matches, or (M, 1).
        seen: (M, 2, 3) column, row and disparity in both, or (M, 1, 3).
        surface: the surface that points lie on.
    """
    count, places = frames.shape
    residuals, slopes = [], []
    for first in range(0, count, CHUNK):
        rows = np.arange(first, first + CHUNK).clip(max=count - 1)
        part = jnp.asarray(frames[rows], jnp.int32), jnp.asarray(seen[rows], jnp.float32)
        found = _matches_at(setting, *part) if surface is None else _surface_at(setting, *part, surface)
        residual, slope = (np.asarray(one, np.float64)[: count - first] for one in found)
        residuals.append(residual)
        slopes.append(slope)
    rows = 3 if surface is None else 1
    residual = np.concatenate(residuals) if residuals else np.zeros((0, rows))
    slope = np.concatenate(slopes) if slopes else np.zeros((0, rows, PER_FRAME * places + SHARED + 1))
    own = PER_FRAME * places
    return Linearised(
        residual,
        slope[..., :own].reshape(count, rows, places, PER_FRAME),
        slope[..., own : own + SHARED],
        slope[..., -1],
    )
