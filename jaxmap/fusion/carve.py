"""Free space, found projectively: each voxel looks itself up in the depth image."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from jaxmap.fusion.params import FusionParams
from jaxmap.geometry.camera import depth_sigma, points_to_pixels, transform_points
from jaxmap.geometry.grid import voxel_centres
from jaxmap.types import GridSpec, StereoCamera

MARGIN_SIGMAS = 2.0


def carve(
    camera: StereoCamera,
    T_world_camera: jaxlie.SE3,
    depth_m: Float[Array, "H W"],
    valid: Bool[Array, "H W"],
    grid: GridSpec,
    params: FusionParams,
    depth_range_m: tuple[float, float] = (0.0, float("inf")),
) -> Bool[Array, "X Y Z"]:
    """Which voxels the camera saw through.

    A voxel is free where its centre lies in the view, between the depths, and nearer than the depth
    measured at its pixel by more than half its diagonal and two sigmas of depth noise.

    Args:
        camera: the rectified camera.
        T_world_camera: its pose.
        depth_m: measured depth along the optical axis.
        valid: where that depth is real; elsewhere nothing is known to be free.
        grid: whose voxels are asked about.
        params: `disparity_sigma_px` sets the depth noise.
        depth_range_m: nearer and farther voxels are left alone.
    """

    def look_up() -> Bool[Array, "X Y Z"]:
        centres_camera = transform_points(T_world_camera.inverse(), voxel_centres(grid))
        u_px, v_px, _, in_front = points_to_pixels(camera, centres_camera)
        height, width = depth_m.shape
        column, row = jnp.round(u_px), jnp.round(v_px)
        in_view = in_front & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixel = jnp.where(in_view, row * width + column, 0.0).astype(jnp.int32)
        measured_m = jnp.where(valid, depth_m, 0.0).reshape(-1)[pixel]
        voxel_depth_m = centres_camera[..., 2]
        margin_m = 0.5 * jnp.linalg.norm(grid.voxel_size_m) + MARGIN_SIGMAS * depth_sigma(
            camera, measured_m, params.disparity_sigma_px
        )
        seen_through = voxel_depth_m + margin_m < measured_m
        in_range = (voxel_depth_m >= depth_range_m[0]) & (voxel_depth_m <= depth_range_m[1])
        return in_view & seen_through & in_range

    with jax.named_scope("carve"):
        # Nothing is fused across a conditional: as a part of what reads it, carving would be computed anew for each
        # of its readers.
        return jax.lax.cond(valid.any(), look_up, lambda: jnp.zeros(grid.shape, bool))
