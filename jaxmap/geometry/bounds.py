"""How large a map must be: the range a camera is good for, and the box that its views fill."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, Int

from jaxmap.errors import JaxmapError
from jaxmap.geometry.camera import depth_at_sigma, frustum_corners
from jaxmap.types import GridSpec, StereoCamera, make_grid


def usable_depth(camera: StereoCamera, max_sigma_m: float, disparity_sigma_px: float) -> float:
    """The depth where depth noise reaches `max_sigma_m`, in whole decimetres, in metres."""
    return float(np.floor(float(depth_at_sigma(camera, max_sigma_m, disparity_sigma_px)) * 10) / 10)


def grid_around_views(
    camera: StereoCamera,
    T_world_camera: np.ndarray,
    max_depth_m: float,
    voxel_size_m: float | tuple[float, float, float],
    below_above_camera_m: tuple[float, float],
    lattice_m: Float[np.ndarray, "3"] | None = None,
) -> GridSpec:
    """The smallest grid, aligned to whole voxels, that holds what the cameras can see.

    Args:
        camera: the rectified camera.
        T_world_camera: (N, 4, 4) rectified poses in the z-up world.
        max_depth_m: the farthest depth that is mapped.
        voxel_size_m: edges of a voxel.
        below_above_camera_m: the grid reaches so far below the lowest camera, and so far above the
            highest one.
        lattice_m: of the site (`site_lattice`), by default at the world's origin.
    """
    corners_camera = np.asarray(frustum_corners(camera, max_depth_m), np.float64)
    R, t = T_world_camera[:, :3, :3], T_world_camera[:, :3, 3]
    corners_world = np.einsum("nij,kj->nki", R, corners_camera) + t[:, None]
    lower, upper = corners_world.min(axis=(0, 1)), corners_world.max(axis=(0, 1))
    lower[2] = max(lower[2], t[:, 2].min() - below_above_camera_m[0])
    upper[2] = min(upper[2], t[:, 2].max() + below_above_camera_m[1])
    return make_grid(lower.tolist(), upper.tolist(), voxel_size_m, np.zeros(3) if lattice_m is None else lattice_m)


def site_lattice(
    site_origin: Float[np.ndarray, "3"], voxel_size_m: float | tuple[float, float, float]
) -> Float[np.ndarray, "3"]:
    """Where the lattice of a site lies relative to its origin: on whole voxels of the coordinate reference system.

    So the maps of any sessions in one system share their voxels, wherever each has its origin. Float64, metres.
    """
    size_m = np.broadcast_to(np.asarray(voxel_size_m, np.float64), (3,))
    # Rounded to what metres of millions are good for in float64: no remainder but a true one.
    return np.round(np.round(site_origin / size_m) * size_m - site_origin, 7) + 0.0


def view_boxes(
    grid: GridSpec, camera: StereoCamera, T_world_camera: Float[np.ndarray, "N 4 4"], max_depth_m: float
) -> Int[np.ndarray, "N 2 3"]:
    """The voxels that views can touch, on the lattice: the first along each axis, and one past the last.

    A voxel more on each side makes up for rounding in the step. Where a view lies outside the grid its box is empty.
    Host side, float64.
    """
    corners_camera = np.asarray(frustum_corners(camera, max_depth_m), np.float64)
    corners = np.einsum("nij,kj->nki", T_world_camera[:, :3, :3], corners_camera) + T_world_camera[:, None, :3, 3]
    scaled = (corners - np.asarray(grid.lattice_m, np.float64)) / np.asarray(grid.voxel_size_m, np.float64)
    lower, upper = np.asarray(grid.first), np.asarray(grid.first) + grid.shape
    first = np.clip(np.floor(scaled.min(axis=1)) - 1, lower, upper)
    return np.stack([first, np.clip(np.floor(scaled.max(axis=1)) + 2, first, upper)], axis=1).astype(np.int64)


def map_bytes(grid: GridSpec, class_count: int, members: int = 0) -> int:
    """Memory of a map's tensors, float32: channels for occupancy and each class, two for each member of an ensemble."""
    # Of Python integers: NumPy's would wrap round.
    return 4 * (1 + class_count + 2 * members) * math.prod(grid.shape)


def check_memory(grid: GridSpec, class_count: int, limit_gib: float, members: int = 0) -> None:
    """Refuses a map, with the members of its ensemble, that would take more memory than allowed.

    Raises:
        JaxmapError: says what it would take and which voxel size would fit.
    """
    limit_bytes = limit_gib * 2**30
    needed_bytes = map_bytes(grid, class_count, members)
    if needed_bytes <= limit_bytes:
        return
    size_m = np.asarray(grid.voxel_size_m, np.float64)
    span_m = size_m * grid.shape
    # Rounded up to a centimetre, with a voxel to spare along each axis: what is advised must fit.
    fitting_m = np.ceil(size_m * (needed_bytes / limit_bytes) ** (1 / 3) * 100) / 100
    number_bytes = 4 * (1 + class_count + 2 * members)
    # Ends at a single voxel, where not even that fits.
    while number_bytes * np.prod(np.ceil(span_m / fitting_m) + 1) > limit_bytes and (fitting_m < span_m).any():
        fitting_m = np.ceil(fitting_m * 1.05 * 100) / 100
    advice = " ".join(f"{edge:g}" for edge in (fitting_m[:1] if np.ptp(fitting_m) == 0 else fitting_m))
    ensemble, fewer = (f" with {members} members", "fewer --ensemble.members, ") if members else ("", "")
    raise JaxmapError(
        f"a map of {' x '.join(map(str, grid.shape))} voxels{ensemble} takes {_size_text(needed_bytes)}, "
        f"over the limit of {_size_text(limit_bytes)}",
        where="grid",
        fix=f"take larger voxels (--grid.voxel-size-m {advice}), a shorter range (--depth.max-m), "
        f"{fewer}or raise --grid.max-memory-gib",
    )


def _size_text(size_bytes: float) -> str:
    return f"{size_bytes / 2**30:.1f} GiB" if size_bytes >= 2**30 else f"{size_bytes / 2**20:.3g} MiB"
