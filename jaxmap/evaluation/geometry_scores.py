"""Scores of geometry: disparity against truth, depth between frames, poses against truth."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

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
    """Compares disparities; NaN is unknown in both. The errors are NaN where no pixel has both."""
    error_px = np.abs(disparity_px - true_disparity_px)
    error_px = error_px[np.isfinite(error_px)]
    if not error_px.size:
        return DisparityScores(float("nan"), float("nan"), float(np.isfinite(disparity_px).mean()))
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


class PoseErrors(NamedTuple):
    """Errors without sign, (N,) each: in metres, and in degrees within 180."""

    position_m: np.ndarray
    heading_deg: np.ndarray
    roll_deg: np.ndarray
    pitch_deg: np.ndarray


def pose_errors(
    T_world_camera: Float64[np.ndarray, "N 4 4"],
    T_world_camera_true: Float64[np.ndarray, "N 4 4"],
    T_body_camera: Float64[np.ndarray, "*N 4 4"],
) -> PoseErrors:
    """Compares the cameras' positions, and the attitudes of the body that carries them.

    Args:
        T_world_camera: estimated.
        T_world_camera_true: true, in the same z-up world.
        T_body_camera: where the camera is in the body (x forward, y left, z up), whose heading, roll
            and pitch are compared.
    """
    R_camera_body = np.swapaxes(T_body_camera[..., :3, :3], -1, -2)
    angles, true_angles = (
        Rotation.from_matrix(T[:, :3, :3] @ R_camera_body).as_euler("ZYX", degrees=True)
        for T in (T_world_camera, T_world_camera_true)
    )
    heading, pitch, roll = np.abs((angles - true_angles + 180) % 360 - 180).T
    position = np.linalg.norm(T_world_camera[:, :3, 3] - T_world_camera_true[:, :3, 3], axis=1)
    return PoseErrors(position, heading, roll, pitch)
