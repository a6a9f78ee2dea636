"""Which cells the cameras see, and from how far: a domain that does not depend on what a map observed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64

from jaxmap.evaluation.cells import CellGrid

_TILE_M = 2.0


@dataclass(frozen=True, eq=False)
class CameraTrack:
    """A pinhole camera and its poses along a drive.

    Attributes:
        T_world_camera: (N, 4, 4), relative to the site origin.
        focal_px: fx, fy.
        centre_px: cx, cy.
        size_px: width, height.
        max_range_m: greatest depth that was mapped; cells beyond it are not in view.
    """

    T_world_camera: Float64[np.ndarray, "N 4 4"]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    size_px: tuple[int, int]
    max_range_m: float


def view_range(
    cells: CellGrid, ground_m: Float[np.ndarray, "I J"], track: CameraTrack, max_range_m: float
) -> Float64[np.ndarray, "I J"]:
    """Distance of the nearest camera that sees each cell, metres: infinite where none does within the range.

    A camera sees a cell whose centre, on the ground, projects into its image. Occlusion is not considered.

    Args:
        cells: the cells.
        ground_m: height of the ground in each, world (`ground_height`).
        track: the cameras.
        max_range_m: how far they see.
    """
    x, y = cells.centres()
    nearest_m = np.full(cells.shape, np.inf)
    for T_world_camera in np.asarray(track.T_world_camera, np.float64):
        position = T_world_camera[:3, 3]
        near_x, near_y = _within(x, position[0], max_range_m), _within(y, position[1], max_range_m)
        here = (near_x, near_y)
        offset = np.stack(np.broadcast_arrays(x[near_x, None], y[None, near_y], ground_m[here]), axis=-1) - position
        distance_m = np.linalg.norm(offset, axis=-1)
        seen = _in_image(offset @ T_world_camera[:3, :3], track) & (distance_m <= max_range_m)
        nearest_m[here] = np.where(seen, np.minimum(nearest_m[here], distance_m), nearest_m[here])
    return nearest_m


def ground_height(
    height_m: Float[np.ndarray, "X Y"], observed: Bool[np.ndarray, "X Y"], column_m: tuple[float, float]
) -> Float64[np.ndarray, "X Y"]:
    """A smooth ground under a map: the median height of tiles of 2 m, that of the nearest tile where none was seen.

    Rocks and stray points hardly move a median, so that maps of one traverse agree on it.
    """
    from scipy.ndimage import distance_transform_edt

    size = [max(1, round(_TILE_M / edge)) for edge in column_m]
    tiles = [-(-count // edge) for count, edge in zip(height_m.shape, size, strict=True)]
    medians = np.full(tiles, np.nan)
    known = np.where(observed, np.asarray(height_m, np.float64), np.nan)
    for i, j in np.ndindex(*tiles):
        tile = known[i * size[0] : (i + 1) * size[0], j * size[1] : (j + 1) * size[1]]
        if np.isfinite(tile).any():
            medians[i, j] = np.nanmedian(tile)
    if not np.isfinite(medians).any():
        return np.zeros(height_m.shape)
    nearest = np.asarray(distance_transform_edt(np.isnan(medians), return_distances=False, return_indices=True))
    filled = medians[tuple(nearest)]
    return filled.repeat(size[0], axis=0).repeat(size[1], axis=1)[: height_m.shape[0], : height_m.shape[1]]


def _within(centres: np.ndarray, position: float, range_m: float) -> slice:
    first, last = np.searchsorted(centres, [position - range_m, position + range_m])
    return slice(int(first), int(last))


def _in_image(points_camera: np.ndarray, track: CameraTrack) -> np.ndarray:
    depth = points_camera[..., 2]
    ahead = depth > 0
    safe = np.where(ahead, depth, 1.0)
    inside = ahead
    for axis in (0, 1):
        pixel = track.focal_px[axis] * points_camera[..., axis] / safe + track.centre_px[axis]
        inside = inside & (pixel >= -0.5) & (pixel < track.size_px[axis] - 0.5)
    return inside
