"""Residuals of matches and of heights, with their derivatives by the rig's parameters and the disparity."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmap.fusion.splat import sample_columns
from jaxmap.refinement.rig import PER_FRAME, SHARED, Rig
from jaxmap.types import GridSpec, Pinhole

CHUNK = 4096
"""Residuals are computed in chunks of one size, so that one compiled program serves any number of them."""


class DeviceRig(NamedTuple):
    """The rig and the camera on the device, float32."""

    R_world_nominal: Float[Array, "N 3 3"]
    t_world_nominal: Float[Array, "N 3"]
    R_nominal_camera: Float[Array, "3 3"]
    t_nominal_camera: Float[Array, "3"]
    baseline_m: Float[Array, ""]
    doffs_px: Float[Array, ""]
    focal_px: Float[Array, "2"]
    centre_px: Float[Array, "2"]


def make_device_rig(rig: Rig, camera: Pinhole, origin_m: np.ndarray) -> DeviceRig:
    """Copies a rig to the device in float32, its positions relative to an origin nearby."""
    values = [
        rig.T_world_nominal[:, :3, :3],
        rig.T_world_nominal[:, :3, 3] - origin_m,
        rig.T_nominal_camera[:3, :3],
        rig.T_nominal_camera[:3, 3],
        camera.baseline_m * np.exp(rig.log_baseline_scale),
        camera.doffs_px + rig.offset_px,
        [camera.fx_px, camera.fy_px],
        [camera.cx_px, camera.cy_px],
    ]
    return DeviceRig(*(jnp.asarray(value, jnp.float32) for value in values))


class Linearised(NamedTuple):
    """Residuals and their derivatives, float64.

    Attributes:
        residual: (M, R).
        by_frames: (M, R, F, 6), by the parameters of the F frames of a term.
        by_shared: (M, R, 8).
        by_disparity: (M, R), by the disparity of its point.
    """

    residual: np.ndarray
    by_frames: np.ndarray
    by_shared: np.ndarray
    by_disparity: np.ndarray


def _world_from_camera(rig: DeviceRig, frame: Int[Array, ""], own: Array, shared: Array) -> jaxlie.SE3:
    """T_world_camera of a frame after a step of its own parameters and the shared ones."""
    nominal = _moved(rig.R_world_nominal[frame], rig.t_world_nominal[frame], own)
    return nominal @ _moved(rig.R_nominal_camera, rig.t_nominal_camera, shared[:6])


def _moved(R: Array, t: Array, step: Array) -> jaxlie.SE3:
    rotation = jaxlie.SO3.from_matrix(R) @ jaxlie.SO3.exp(step[3:6])
    return jaxlie.SE3.from_rotation_and_translation(rotation, t + step[:3])


def _point(rig: DeviceRig, uvd_px: Float[Array, "3"], shared: Array, error_px: Array) -> Float[Array, "3"]:
    """The point of column, row and disparity in the camera frame."""
    shifted = uvd_px[2] + error_px + rig.doffs_px + shared[7]
    depth = rig.baseline_m * jnp.exp(shared[6]) * rig.focal_px[0] / shifted
    across = (uvd_px[:2] - rig.centre_px) / rig.focal_px * depth
    return jnp.append(across, depth)


def _match_residual(
    step: Float[Array, "21"], rig: DeviceRig, frames: Int[Array, "2"], uvd_px: Float[Array, "2 3"]
) -> Array:
    """Column, row and disparity of a point of the source, projected into the target, less those observed there."""
    own, shared, error_px = step[:12].reshape(2, PER_FRAME), step[12:20], step[20]
    source, target = (_world_from_camera(rig, frames[place], own[place], shared) for place in (0, 1))
    point = target.inverse() @ (source @ _point(rig, uvd_px[0], shared, error_px))
    depth = jnp.maximum(point[2], 0.05)
    column_row = point[:2] / depth * rig.focal_px + rig.centre_px
    disparity = rig.baseline_m * jnp.exp(shared[6]) * rig.focal_px[0] / depth
    return jnp.append(column_row, disparity - rig.doffs_px - shared[7]) - uvd_px[1]


class HeightField(NamedTuple):
    """Heights of the ground: a grid one voxel high, and per column the height, and 1 where it is known, else 0."""

    grid: GridSpec
    values: Float[Array, "2 X Y"]


def _height_residual(
    step: Float[Array, "15"], rig: DeviceRig, frames: Int[Array, "1"], uvd_px: Float[Array, "1 3"], field: HeightField
) -> Array:
    """Height of a point above the ground; 0 where the ground is unknown."""
    own, shared, error_px = step[:PER_FRAME], step[6:14], step[14]
    point = _world_from_camera(rig, frames[0], own, shared) @ _point(rig, uvd_px[0], shared, error_px)
    # Sampled at the height of the grid, so that points above or below it are not outside.
    place = point.at[2].set(field.grid.origin_m[2] + 0.5 * field.grid.voxel_size_m[2])
    height, known = sample_columns(field.grid, field.values, place[None])[:, 0]
    return jnp.where(known > 0.99, point[2] - height, 0.0)[None]


@partial(jax.jit, static_argnums=0)
def _with_derivatives(
    residual: Callable[..., Array],
    rig: DeviceRig,
    frames: Int[Array, "M F"],
    uvd_px: Float[Array, "M F 3"],
    *field: HeightField,
) -> tuple[Float[Array, "M R"], Float[Array, "M R K"]]:
    def one(frames: Array, uvd_px: Array) -> tuple[Array, Array]:
        zero = jnp.zeros(PER_FRAME * len(frames) + SHARED + 1)
        value = residual(zero, rig, frames, uvd_px, *field)
        return value, jax.jacfwd(residual)(zero, rig, frames, uvd_px, *field)

    return jax.vmap(one)(frames, uvd_px)


def linearise(rig: DeviceRig, frames: np.ndarray, uvd_px: np.ndarray, field: HeightField | None = None) -> Linearised:
    """Residuals of matches, or of heights above the ground, with their derivatives.

    Args:
        rig: the rig and camera.
        frames: (M, 2) source and target of matches, or (M, 1).
        uvd_px: (M, 2, 3) column, row and disparity in both, or (M, 1, 3).
        field: the ground, for heights.
    """
    count, places = frames.shape
    residuals, slopes = [], []
    for first in range(0, count, CHUNK):
        rows = np.arange(first, first + CHUNK).clip(max=count - 1)
        part = jnp.asarray(frames[rows], jnp.int32), jnp.asarray(uvd_px[rows], jnp.float32)
        if field is None:
            found = _with_derivatives(_match_residual, rig, *part)
        else:
            found = _with_derivatives(_height_residual, rig, *part, field)
        residual, slope = (np.asarray(one, np.float64)[: count - first] for one in found)
        residuals.append(residual)
        slopes.append(slope)
    rows = 3 if field is None else 1
    residual = np.concatenate(residuals) if residuals else np.zeros((0, rows))
    slope = np.concatenate(slopes) if slopes else np.zeros((0, rows, PER_FRAME * places + SHARED + 1))
    own = PER_FRAME * places
    return Linearised(
        residual,
        slope[..., :own].reshape(count, rows, places, PER_FRAME),
        slope[..., own : own + SHARED],
        slope[..., -1],
    )
