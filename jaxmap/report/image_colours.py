"""The colours of voxels in the images: each takes that of the nearest frame that sees it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, UInt8

_BLOCK_PX = 8
"""Pixels along a side of the blocks in which the nearest point hides those behind it."""
_HIDDEN_M, _HIDDEN_SHARE = 0.3, 0.12
"""How far behind the nearest point of its block a point is hidden: more with distance, where a block of level ground
is long."""
_UNSEEN = 128
_BRIGHT = 235.0


@dataclass(frozen=True)
class SeenFrame:
    """A rectified left image with its camera.

    Attributes:
        image: grey or RGB.
        T_world_camera: its pose (x right, y down, z forward).
        focal_px: fx, fy.
        centre_px: cx, cy.
    """

    image: UInt8[np.ndarray, "H W *rgb"]
    T_world_camera: Float64[np.ndarray, "4 4"]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]


def image_colours(
    points_world: Float[np.ndarray, "N 3"], frames: Sequence[SeenFrame], brightest: float | None = None
) -> UInt8[np.ndarray, "N 3"]:
    """The colours of points in the nearest frame that sees them, brightened alike so that the brightest are bright.

    What becomes bright is the level `brightest` of the images, by default that of 98 % of the points.

    A point hides those well behind it in the same block of pixels. Points that no frame sees take the colour of the
    nearest point that one sees; all are grey where no point is seen.
    """
    from PIL import Image, ImageFilter
    from scipy.spatial import KDTree

    points_world = np.asarray(points_world, np.float64).reshape(-1, 3)
    colours = np.zeros((len(points_world), 3))
    nearest_m = np.full(len(points_world), np.inf)
    for frame in frames:
        size = frame.image.shape[:2]
        depth_m, column, row = project_points(points_world, frame.T_world_camera, frame.focal_px, frame.centre_px, size)
        seen = unhidden(depth_m, column, row, size) & (depth_m < nearest_m)
        # Blurred, as a voxel covers more than a pixel.
        smooth = np.asarray(Image.fromarray(frame.image).convert("RGB").filter(ImageFilter.BoxBlur(2)))
        colours[seen] = smooth[row[seen], column[seen]]
        nearest_m[seen] = depth_m[seen]
    known = np.isfinite(nearest_m)
    if not known.any():
        return np.full(colours.shape, _UNSEEN, np.uint8)
    colours[~known] = colours[known][KDTree(points_world[known]).query(points_world[~known])[1]]
    level = float(np.percentile(colours.max(axis=-1), 98)) if brightest is None else brightest
    colours *= _BRIGHT / max(level, 1.0)
    return np.rint(colours.clip(0, 255)).astype(np.uint8)


def project_points(
    points_world: Float[np.ndarray, "N 3"],
    T_world_camera: Float64[np.ndarray, "4 4"],
    focal_px: tuple[float, float],
    centre_px: tuple[float, float],
    size: tuple[int, ...],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth of points, and column and row of the pixel they fall into; the depth is infinite outside the image.

    `size` is height and width of the image.
    """
    x, y, z = ((points_world - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]).T
    ahead = z > 0.05
    depth_m = np.where(ahead, z, 1.0)
    column, row = (
        np.floor(focal * side / depth_m + centre + 0.5)
        for focal, centre, side in zip(focal_px, centre_px, (x, y), strict=True)
    )
    height, width = size
    inside = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row = (np.where(inside, index, 0).astype(int) for index in (column, row))
    return np.where(inside, depth_m, np.inf), column, row


def unhidden(depth_m: np.ndarray, column: np.ndarray, row: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Points in the image (of `project_points`) with none well before them in the same block of pixels."""
    block = row // _BLOCK_PX, column // _BLOCK_PX
    nearest_m = np.full((-(-size[0] // _BLOCK_PX), -(-size[1] // _BLOCK_PX)), np.inf)
    np.minimum.at(nearest_m, block, depth_m)
    before_m = nearest_m[block]
    with np.errstate(invalid="ignore"):
        return np.isfinite(depth_m) & (depth_m <= before_m + np.maximum(_HIDDEN_M, _HIDDEN_SHARE * before_m))


def brightest_of(frames: Sequence[SeenFrame]) -> float:
    """The level that 98 % of the pixels of the images do not pass, for points that are coloured part by part."""
    levels = [frame.image.max(axis=-1) if frame.image.ndim == 3 else frame.image for frame in frames]
    return float(np.percentile(np.concatenate([level.ravel() for level in levels]), 98))
