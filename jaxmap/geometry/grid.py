"""Where points lie in a voxel grid, and the part of a grid that a camera can see."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmap.geometry.camera import frustum_corners, transform_points
from jaxmap.types import GridSpec, StereoCamera


def world_to_voxel(grid: GridSpec, points_world: Float[Array, "*s 3"]) -> tuple[Int[Array, "*s 3"], Bool[Array, "*s"]]:
    """Voxel indices of points in the grid, `floor((p - lattice) / size) - first`.

    Returns:
        index: int32; 0 where not inside.
        inside: the point is finite and in the grid.
    """
    scaled = jnp.floor((points_world - grid.lattice_m) / grid.voxel_size_m) - grid.first
    # Tested on floats: a NaN or a huge number cast to int32 would be a valid index.
    inside = jnp.all((scaled >= 0) & (scaled < jnp.array(grid.shape, jnp.float32)), axis=-1)
    return jnp.where(inside[..., None], scaled, 0.0).astype(jnp.int32), inside


def exact_corner(grid: GridSpec) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Origin and voxel size as the short decimals that their float32 stand for, float64: 0.2, not 0.20000000298.

    Georeferences are read by people, and cells of 0.2 m must hold voxels of 0.05 m exactly.
    """
    lattice_m, size_m = (
        np.array([float(str(number)) for number in np.asarray(numbers, np.float32)])
        for numbers in (grid.lattice_m, grid.voxel_size_m)
    )
    return np.round(lattice_m + np.asarray(grid.first) * size_m, 9), size_m


def flat_voxel_index(grid: GridSpec, points_world: Float[Array, "*s 3"], keep: Bool[Array, "*s"]) -> Int[Array, "*s"]:
    """Flat (row-major) voxel indices in the grid; points outside or not kept get its number of voxels.

    That number is one past the end: a scatter with `mode="drop"` leaves them out exactly, where -1
    would wrap round to the last voxel.
    """
    flat, inside = jnp.zeros((), jnp.int32), keep
    # Axis by axis, because XLA does not vectorise over a last axis of three.
    for axis in range(3):
        scaled = jnp.floor((points_world[..., axis] - grid.lattice_m[axis]) / grid.voxel_size_m[axis])
        # Found on the lattice and then moved: a point on a face falls into one voxel, whatever the grid.
        scaled = scaled - grid.first[axis]
        # Tested on floats: a NaN or a huge number cast to int32 would be a valid index.
        inside = inside & (scaled >= 0) & (scaled < grid.shape[axis])
        flat = flat * grid.shape[axis] + scaled.astype(jnp.int32)
    return jnp.where(inside, flat, int(np.prod(grid.shape)))


def voxel_centres(grid: GridSpec) -> Float[Array, "X Y Z 3"]:
    """World positions of the voxel centres, in metres."""
    # Counted along the lattice: a voxel's centre is the same number in any grid.
    axes = [
        grid.lattice_m[i] + (grid.first[i] + jnp.arange(grid.shape[i]) + 0.5) * grid.voxel_size_m[i] for i in range(3)
    ]
    return jnp.stack(jnp.meshgrid(*axes, indexing="ij"), axis=-1)


def window_shape(
    grid: GridSpec,
    camera: StereoCamera,
    max_depth_m: float,
    T_world_camera: Float[np.ndarray, "N 4 4"] | None = None,
) -> tuple[int, int, int]:
    """Voxels along each axis that hold the view of the camera: from each of the poses, or however it is turned.

    The view is the pyramid from the camera to `max_depth_m`. Where the poses are not known, its greatest diameter
    bounds its extent in every direction. Host side, static.
    """
    corners = np.asarray(frustum_corners(camera, max_depth_m), np.float64)
    if T_world_camera is None:
        extent_m = np.full(3, np.linalg.norm(corners[:, None] - corners[None], axis=-1).max())
    else:
        # Turned only: where a camera stands does not change how far it sees to each side.
        extent_m = np.ptp(np.einsum("nij,kj->nki", T_world_camera[:, :3, :3], corners), axis=1).max(axis=0)
    # One voxel for a start that is not aligned, one more for rounding.
    needed = np.ceil(extent_m / np.asarray(grid.voxel_size_m, np.float64)).astype(int) + 2
    x, y, z = (min(int(n), s) for n, s in zip(needed, grid.shape, strict=True))
    return x, y, z


def view_window(
    grid: GridSpec,
    camera: StereoCamera,
    T_world_camera: jaxlie.SE3,
    max_depth_m: Float[Array, ""] | float,
    shape: tuple[int, int, int],
) -> GridSpec:
    """The window of the grid, of a static `shape`, that holds all that the camera can see of it."""
    with jax.named_scope("view_window"):
        corners = transform_points(T_world_camera, frustum_corners(camera, max_depth_m))
        first = jnp.floor((corners.min(axis=0) - grid.lattice_m) / grid.voxel_size_m)
        last = grid.first + jnp.array(grid.shape, jnp.float32) - jnp.array(shape, jnp.float32)
        # Clipped as floats: far outside the grid the cast would wrap round.
        return replace(grid, first=jnp.clip(first, grid.first, last).astype(jnp.int32), shape=shape)
