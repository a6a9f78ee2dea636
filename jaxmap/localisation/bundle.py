"""Bundle adjustment of a few stereo cameras: their poses and the points they see, by robust least squares.

Levenberg-Marquardt on reprojection residuals in both images of each pair. The points are eliminated from the normal
equations by the Schur complement, so that a step solves for the poses alone: Triggs, McLauchlan, Hartley and
Fitzgibbon, "Bundle adjustment - a modern synthesis", Vision Algorithms (2000), section 6.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.spatial.transform import Rotation

from jaxmap.types import Pinhole

NEAREST_M = 0.05
"""Points nearer than this, or behind the camera, have no projection."""

ROBUST = 2.5
"""Scale of the robust loss (Cauchy's), in sigma: larger residuals count less and less."""

MAX_STEPS = 10
CONVERGED = 1e-3
"""The iteration ends when a step lowers the cost by a smaller share."""

SETTLED = 1e-5
"""The pose of one camera is found when a step is smaller, in metres and radians."""

UNSHARED = 250_000
"""Multiplications in a product of matrices that OpenBLAS leaves to one thread."""


class Sightings(NamedTuple):
    """Which camera saw which point where.

    Attributes:
        cameras: (M,) indices.
        points: (M,) indices.
        uvr_px: (M, 3), column and row in the left image, and column in the right one.
    """

    cameras: Int[np.ndarray, "M"]
    points: Int[np.ndarray, "M"]
    uvr_px: Float64[np.ndarray, "M 3"]


class Bundle(NamedTuple):
    """Poses and points; `T_world_camera` (K, 4, 4), `points_world` (P, 3)."""

    T_world_camera: Float64[np.ndarray, "K 4 4"]
    points_world: Float64[np.ndarray, "P 3"]


def triangulate(camera: Pinhole, uvr_px: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    """Points in the camera frame from their places in both images; `NaN` at and beyond infinity."""
    disparity_px = uvr_px[:, 0] - uvr_px[:, 2] + camera.doffs_px
    depth_m = camera.baseline_m * camera.fx_px / np.where(disparity_px > 1e-3, disparity_px, np.nan)
    across = (uvr_px[:, :2] - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px] * depth_m[:, None]
    return np.column_stack([across, depth_m])


def project(camera: Pinhole, points_camera: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    """Column and row in the left image, and column in the right one; `NaN` behind the camera."""
    x, y, z = points_camera.T
    z = np.where(z > NEAREST_M, z, np.nan)
    left_px = camera.fx_px * x / z + camera.cx_px
    right_px = camera.fx_px * (x - camera.baseline_m) / z + camera.cx_px + camera.doffs_px
    return np.column_stack([left_px, camera.fy_px * y / z + camera.cy_px, right_px])


def to_camera(
    T_world_camera: Float64[np.ndarray, "*N 4 4"], points_world: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 3"]:
    """World points in the frame of a camera, or each in that of its own."""
    offset = points_world - T_world_camera[..., :3, 3]
    return np.einsum("...ji,...j->...i", T_world_camera[..., :3, :3], offset)


def to_world(
    T_world_camera: Float64[np.ndarray, "4 4"], points_camera: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 3"]:
    """Points of a camera frame in the world."""
    return points_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]


def adjust(
    camera: Pinhole,
    bundle: Bundle,
    seen: Sightings,
    fixed: Bool[np.ndarray, "K"],
    sigma_px: float,
    *,
    steps: int = MAX_STEPS,
) -> Bundle:
    """The most likely poses and points.

    Args:
        camera: of all pairs.
        bundle: the start.
        seen: the measurements.
        fixed: cameras that stay where they are; one at least, as nothing else says where the world is.
        sigma_px: standard deviation of a measurement.
        steps: at most so many.
    """
    state, damping = bundle, 1e-4
    cost = _cost(camera, state, seen, sigma_px)
    for _ in range(steps):
        moved = _stepped(camera, state, seen, fixed, sigma_px, damping)
        after = _cost(camera, moved, seen, sigma_px)
        if not after < cost:
            damping *= 10
            if damping > 1e3:
                break
            continue
        gained, state, cost, damping = cost - after, moved, after, max(damping / 10, 1e-9)
        if gained < CONVERGED * cost:
            break
    return state


def adjust_pose(
    camera: Pinhole,
    T_world_camera: Float64[np.ndarray, "4 4"],
    points_world: Float64[np.ndarray, "N 3"],
    uvr_px: Float64[np.ndarray, "N 3"],
    sigma_px: float,
    *,
    steps: int = MAX_STEPS,
) -> Float64[np.ndarray, "4 4"]:
    """The most likely pose of one camera that sees known points; as `adjust`, with the points held."""
    seen = Sightings(np.zeros(len(uvr_px), int), np.arange(len(uvr_px)), uvr_px)
    T = T_world_camera
    for _ in range(steps):
        residual, by_pose, _ = _linearised(camera, Bundle(T[None], points_world), seen, sigma_px)
        normal = np.einsum("mri,mrj->ij", by_pose, by_pose) + 1e-9 * np.eye(6)
        step = -np.linalg.solve(normal, np.einsum("mri,mr->i", by_pose, residual))
        T = _moved(T[None], step[None])[0]
        if np.abs(step).max() < SETTLED:
            break
    return T


def errors_px(camera: Pinhole, bundle: Bundle, seen: Sightings) -> Float64[np.ndarray, "M 3"]:
    """Where the points project, less where they were seen; `NaN` behind a camera."""
    at_camera = to_camera(bundle.T_world_camera[seen.cameras], bundle.points_world[seen.points])
    return project(camera, at_camera) - seen.uvr_px


def _cost(camera: Pinhole, bundle: Bundle, seen: Sightings, sigma_px: float) -> float:
    squares = ((errors_px(camera, bundle, seen) / sigma_px) ** 2).sum(axis=1)
    # A point that went behind the camera costs as much as one seen an image away.
    squares = np.nan_to_num(squares, nan=1e6)
    return float((ROBUST**2 * np.log1p(squares / ROBUST**2)).sum())


def _linearised(
    camera: Pinhole, bundle: Bundle, seen: Sightings, sigma_px: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted residuals (M, 3) with their derivatives by pose (M, 3, 6) and by point (M, 3, 3)."""
    R = bundle.T_world_camera[seen.cameras, :3, :3]
    at_camera = to_camera(bundle.T_world_camera[seen.cameras], bundle.points_world[seen.points])
    residual = (project(camera, at_camera) - seen.uvr_px) / sigma_px
    weight = 1 / np.sqrt(1 + (residual**2).sum(axis=1) / ROBUST**2)
    weight = np.nan_to_num(weight) / sigma_px
    residual = np.nan_to_num(residual) * (weight * sigma_px)[:, None]

    x, y, z = at_camera.T
    z = np.maximum(z, NEAREST_M)
    zero = np.zeros_like(z)
    rows = [
        (camera.fx_px / z, zero, -camera.fx_px * x / z**2),
        (zero, camera.fy_px / z, -camera.fy_px * y / z**2),
        (camera.fx_px / z, zero, -camera.fx_px * (x - camera.baseline_m) / z**2),
    ]
    by_camera = np.stack([np.stack(row, axis=-1) for row in rows], axis=1) * weight[:, None, None]
    # The camera moves by `T exp(step)`: its points move the other way.
    turning = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    by_pose = np.concatenate([-by_camera, by_camera @ turning], axis=2)
    return residual, by_pose, by_camera @ R.transpose(0, 2, 1)


def _stepped(
    camera: Pinhole, bundle: Bundle, seen: Sightings, fixed: np.ndarray, sigma_px: float, damping: float
) -> Bundle:
    """The bundle after one damped Gauss-Newton step."""
    cameras, points = len(bundle.T_world_camera), len(bundle.points_world)
    residual, by_pose, by_point = _linearised(camera, bundle, seen, sigma_px)
    by_pose[fixed[seen.cameras]] = 0.0

    poses = np.zeros((cameras, 6, 6))
    np.add.at(poses, seen.cameras, by_pose.transpose(0, 2, 1) @ by_pose)
    cross = np.zeros((points, cameras, 6, 3))
    np.add.at(cross, (seen.points, seen.cameras), by_pose.transpose(0, 2, 1) @ by_point)
    own = np.zeros((points, 3, 3))
    np.add.at(own, seen.points, by_point.transpose(0, 2, 1) @ by_point)
    down_poses, down_points = np.zeros((cameras, 6)), np.zeros((points, 3))
    np.add.at(down_poses, seen.cameras, -np.einsum("mri,mr->mi", by_pose, residual))
    np.add.at(down_points, seen.points, -np.einsum("mri,mr->mi", by_point, residual))

    diagonal = np.arange(3)
    own[:, diagonal, diagonal] = own[:, diagonal, diagonal] * (1 + damping) + 1e-9
    inverse = np.linalg.inv(own)
    cross = cross.reshape(points, cameras * 6, 3)
    pulled = cross @ inverse
    normal = -_sum_of_products(pulled, cross)
    for index in range(cameras):
        block = slice(6 * index, 6 * index + 6)
        normal[block, block] += poses[index]
    right = down_poses.ravel() - np.einsum("pij,pj->i", pulled, down_points)

    free = np.repeat(~fixed, 6)
    reduced = normal[np.ix_(free, free)]
    corners = np.diag_indices_from(reduced)
    reduced[corners] = reduced[corners] * (1 + damping) + 1e-9
    step = np.zeros(6 * cameras)
    step[free] = np.linalg.solve(reduced, right[free])
    point_step = np.einsum("pij,pj->pi", inverse, down_points - np.einsum("pij,i->pj", cross, step))
    return Bundle(_moved(bundle.T_world_camera, step.reshape(-1, 6)), bundle.points_world + point_step)


def _sum_of_products(
    one: Float64[np.ndarray, "P n 3"], other: Float64[np.ndarray, "P n 3"]
) -> Float64[np.ndarray, "n n"]:
    """The sum over the points of `one @ other.T`.

    In chunks that BLAS does not share among threads: waiting for each other, they take longer than one alone.
    """
    points, size, _ = one.shape
    chunk = max(1, UNSHARED // (3 * size**2))
    padding = ((0, -points % chunk), (0, 0), (0, 0))
    wide = [
        np.pad(part, padding).reshape(-1, chunk, size, 3).transpose(0, 2, 1, 3).reshape(-1, size, 3 * chunk)
        for part in (one, other)
    ]
    return (wide[0] @ wide[1].transpose(0, 2, 1)).sum(axis=0)


def _moved(T: Float64[np.ndarray, "K 4 4"], step: Float64[np.ndarray, "K 6"]) -> Float64[np.ndarray, "K 4 4"]:
    """Poses moved by 3 m and 3 rad in their own frames."""
    moved = T.copy()
    moved[:, :3, 3] += np.einsum("kij,kj->ki", T[:, :3, :3], step[:, :3])
    moved[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(step[:, 3:]).as_matrix()
    return moved
