"""The point cloud of a frame: disparity projected into the world, and its relief."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from jaxmap.geometry.camera import depth_sigma, disparity_to_points, transform_points
from jaxmap.geometry.options import GroundOptions
from jaxmap.geometry.relief import Relief, relief_of
from jaxmap.types import StereoCamera


class PointCloud(NamedTuple):
    """The points of one frame: images of its pixels (H, W), and the points as a list in the order of rows.

    Attributes:
        points_world: metres.
        depth_m: along the optical axis; 1 where not valid.
        sigma_m: standard deviation of the depth.
        valid: pixels that have a disparity.
        in_range: valid points between the depths that are mapped.
        relief: how they rise above the local ground, where that was asked for.
    """

    points_world: Float[Array, "N 3"]
    depth_m: Float[Array, "H W"]
    sigma_m: Float[Array, "H W"]
    valid: Bool[Array, "H W"]
    in_range: Bool[Array, "H W"]
    relief: Relief | None = None


def project(
    camera: StereoCamera,
    T_world_camera: jaxlie.SE3,
    disparity_px: Float[Array, "H W"],
    depth_range_m: tuple[float, float],
    disparity_sigma_px: Float[Array, ""] | float,
    ground: GroundOptions | None = None,
) -> PointCloud:
    """The point cloud of a disparity image (paper eq. 1), seen from a pose.

    Args:
        camera: the rectified camera.
        T_world_camera: its pose.
        disparity_px: NaN where unknown.
        depth_range_m: the depths that are mapped.
        disparity_sigma_px: standard deviation of disparity.
        ground: where given, the relief above this ground is measured, too.
    """
    points_camera, valid = disparity_to_points(camera, disparity_px)
    depth_m = points_camera[..., 2]
    in_range = valid & (depth_m >= depth_range_m[0]) & (depth_m <= depth_range_m[1])
    points_world = transform_points(T_world_camera, points_camera)
    columns = [points_world[..., axis].reshape(-1) for axis in range(3)]
    # Kept apart: each reader would compute the points anew, one by one. In columns, for readers of columns; and by
    # themselves, so that without readers they are not computed at all.
    columns = jax.lax.optimization_barrier(columns)
    depth_m, in_range = jax.lax.optimization_barrier((depth_m, in_range))
    points_world = jnp.stack(columns, axis=-1)
    relief = None
    if ground is not None:
        up_camera = T_world_camera.rotation().as_matrix()[2]
        relief = relief_of(camera, up_camera, disparity_px, disparity_sigma_px, ground)
    sigma_m = depth_sigma(camera, depth_m, disparity_sigma_px)
    return PointCloud(points_world, depth_m, sigma_m, valid, in_range, relief)
