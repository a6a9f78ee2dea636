"""From which frame on each voxel is in view."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64, Int

from jaxmap.report.image_colours import project_points, unhidden
from jaxmap.types import Pinhole


def first_seen(
    points_world: Float[np.ndarray, "P 3"],
    T_world_camera: Float64[np.ndarray, "N 4 4"],
    camera: Pinhole,
    size_px: tuple[int, int],
    max_range_m: float,
) -> Int[np.ndarray, "P"]:
    """The first frame that sees each point; -1 where none does.

    A frame sees a point that lies in its image and range with none well before it in the same block of pixels. A point
    that is hidden in all frames (blocks are coarse) counts as seen by the first that has it in its image and range.

    Args:
        points_world: occupied voxels.
        T_world_camera: of the frames, in their order.
        camera: for all frames.
        size_px: width and height of their images.
        max_range_m: greatest depth.
    """
    first, in_view = np.full((2, len(points_world)), -1)
    points_world = np.asarray(points_world, np.float64)
    shape = (size_px[1], size_px[0])
    # A corner of the image is farther than its depth.
    reach_m = max_range_m * np.hypot(1.0, np.hypot(size_px[0] / camera.fx_px, size_px[1] / camera.fy_px))
    for frame, T in enumerate(T_world_camera):
        near = np.flatnonzero(np.abs(points_world - T[:3, 3]).max(axis=1) <= reach_m)
        if (first[near] >= 0).all():
            continue
        depth_m, column, row = project_points(
            points_world[near], T, (camera.fx_px, camera.fy_px), (camera.cx_px, camera.cy_px), shape
        )
        there = depth_m <= max_range_m
        for kept, mask in ((in_view, there), (first, there & unhidden(depth_m, column, row, shape))):
            seen = near[mask]
            kept[seen[kept[seen] < 0]] = frame
    return np.where(first < 0, in_view, first)
