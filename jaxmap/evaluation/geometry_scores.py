"""Scores of geometry: disparity against truth, depth between frames, surfaces against surfaces."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float

from jaxmap.geometry.camera import disparity_to_points, points_to_pixels, transform_points
from jaxmap.types import StereoCamera


class DisparityScores(NamedTuple):
    """Disparity against truth.

    `median_error_px` and `bad_2` (the share off by more than 2 px) are over the pixels that have
    both; `valid` is the share of all pixels that have a disparity.
    """

    median_error_px: float
    bad_2: float
    valid: float


def score_disparity(
    disparity_px: Float[np.ndarray, "H W"], true_disparity_px: Float[np.ndarray, "H W"]
) -> DisparityScores:
    """Compares disparities; NaN is unknown in both."""
    error_px = np.abs(disparity_px - true_disparity_px)
    error_px = error_px[np.isfinite(error_px)]
    return DisparityScores(
        median_error_px=float(np.median(error_px)),
        bad_2=float((error_px > 2.0).mean()),
        valid=float(np.isfinite(disparity_px).mean()),
    )


def point_range_error(
    camera: StereoCamera,
    T_world_camera: jaxlie.SE3,
    disparity_px: Float[np.ndarray, "H W"],
    true_disparity_px: Float[np.ndarray, "H W"],
) -> float:
    """Median error of points in the world, as a share of their distance from the camera.

    Both disparities go the whole way: to points, to the world, and back to distances from where the
    camera stands.
    """
    distances_m = []
    for disparity in (disparity_px, true_disparity_px):
        points_camera, valid = disparity_to_points(camera, jnp.asarray(disparity))
        points_world = np.asarray(transform_points(T_world_camera, points_camera), np.float64)
        offsets_m = points_world - np.asarray(T_world_camera.translation(), np.float64)
        distances_m.append(np.where(valid, np.linalg.norm(offsets_m, axis=-1), np.nan))
    return float(np.nanmedian(np.abs(distances_m[0] - distances_m[1]) / distances_m[1]))


def depth_consistency(
    camera: StereoCamera,
    disparity_a_px: Float[np.ndarray, "H W"],
    disparity_b_px: Float[np.ndarray, "H W"],
    T_b_a: jaxlie.SE3,
) -> Float[np.ndarray, "N"]:
    """How the points of frame a, moved into frame b, agree with the depth that b measured.

    Args:
        camera: of both frames.
        disparity_a_px: NaN where unknown.
        disparity_b_px: likewise.
        T_b_a: the pose of camera a in camera b.

    Returns:
        Signed dZ / Z for each point of a that lands on a pixel of b with a depth; points hidden in
        b, or moving, are among them, so read the median of its absolute value.
    """
    points_a, valid_a = disparity_to_points(camera, jnp.asarray(disparity_a_px))
    points_b = transform_points(T_b_a, points_a)
    u_px, v_px, _, in_front = (np.asarray(value) for value in points_to_pixels(camera, points_b))
    height, width = disparity_b_px.shape
    landed = (
        np.asarray(valid_a) & in_front & (u_px > -0.5) & (u_px < width - 0.5) & (v_px > -0.5) & (v_px < height - 0.5)
    )
    rows, columns = np.rint(v_px[landed]).astype(int), np.rint(u_px[landed]).astype(int)
    measured, valid_b = (np.asarray(value) for value in disparity_to_points(camera, jnp.asarray(disparity_b_px)))
    seen = valid_b[rows, columns]
    predicted_m = np.asarray(points_b)[landed][seen, 2]
    measured_m = measured[rows, columns, 2][seen]
    return (predicted_m - measured_m) / measured_m
