"""How the camera moved between frames, and where its ground lies, as the images alone show it."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from jaxmap.datasets.base import StereoSequence
from jaxmap.errors import FrameError
from jaxmap.stereo.align import match_features
from jaxmap.stereo.front_end import RectifiedFrame, StereoFrontEnd
from jaxmap.stereo.rectify import rectify_image
from jaxmap.types import StereoCamera

MIN_DISPARITY_PX = 3.0
"""Farther points fix the rotation alone, and their depth is noise."""

MIN_INLIERS, MIN_INLIER_SHARE = 20, 0.35
REPROJECTION_PX = 2.0
"""Motions with fewer points that agree within this are not told."""

STEP_M, STEP_DEG, LONGEST_STEP = 0.15, 2.0, 10
"""The second frame of a pair is the first that lies so far off or is turned so much by the poses, or else the tenth."""

LEAST_PARALLAX = 0.02
"""Motions shorter than this share of the depth of what is seen have no certain direction."""

LEAST_TURN_DEG = 1.0

PLANE_POINTS, PLANE_HYPOTHESES, PLANE_TOLERANCE, PLANE_SHARE = 1500, 150, 0.02, 0.5
"""A plane holds half of the points to a 50th of their depth, or it is none."""


class Motion(NamedTuple):
    """What two frames show of the motion between them.

    Attributes:
        i: index of the first frame in the sequence.
        j: of the second.
        T_i_j: takes points in the camera of the second into that of the first; metres of the calibration's baseline.
        inliers: how many points agree.
        depth_m: their median depth.
    """

    i: int
    j: int
    T_i_j: Float64[np.ndarray, "4 4"]
    inliers: int
    depth_m: float

    @property
    def steps(self) -> bool:
        """Whether it is long enough to have a direction."""
        return bool(np.linalg.norm(self.T_i_j[:3, 3]) > LEAST_PARALLAX * self.depth_m)

    @property
    def turns(self) -> bool:
        """Whether it turns enough to have an axis."""
        return bool(angle_deg(self.T_i_j[:3, :3]) > LEAST_TURN_DEG)


def choose_steps(T_world_camera: Float64[np.ndarray, "N 4 4"], count: int) -> list[tuple[int, int]]:
    """Pairs of frames a step apart, half of them spread over the path and half where it turns most.

    Args:
        T_world_camera: the poses as read; only their steps matter.
        count: how many pairs, at most.
    """
    steps = []
    for i in range(len(T_world_camera) - 1):
        later = T_world_camera[i + 1 : i + 1 + LONGEST_STEP]
        away_m = np.linalg.norm(later[:, :3, 3] - T_world_camera[i, :3, 3], axis=1)
        turned_deg = angle_deg(T_world_camera[i, :3, :3].T @ later[:, :3, :3])
        far = (away_m > STEP_M) | (turned_deg > STEP_DEG)
        j = int(np.argmax(far)) if far.any() else len(later) - 1
        steps.append((i, i + 1 + j, turned_deg[j]))
    spread = {int(row) for row in np.linspace(0, len(steps) - 1, (count + 1) // 2).round()} if steps else set()
    # Images turned much more share too little.
    by_turn = sorted(range(len(steps)), key=lambda row: -steps[row][2] if steps[row][2] < 30 else 0.0)
    rows = sorted([*spread, *[row for row in by_turn if row not in spread][: count - len(spread)]])
    return [steps[row][:2] for row in rows]


def read_left(sequence: StereoSequence, front_end: StereoFrontEnd, index: int) -> np.ndarray | None:
    """The rectified left image of a frame; None where it cannot be read."""
    try:
        left = sequence.read_pair(sequence.frames[index]).left
    except FrameError:
        return None
    return left if front_end.rectifier is None else rectify_image(left, front_end.rectifier.left_maps)


def read_matched(sequence: StereoSequence, front_end: StereoFrontEnd, index: int) -> RectifiedFrame | None:
    """A frame rectified and matched; None where it cannot be read."""
    try:
        return front_end(*sequence.read_pair(sequence.frames[index]))
    except FrameError:
        return None


def measure_motion(
    camera: StereoCamera,
    steps: tuple[int, int],
    left_i: np.ndarray,
    disparity_i_px: Float32[np.ndarray, "H W"],
    left_j: np.ndarray,
    shrink: int = 1,
) -> Motion | None:
    """The motion between two frames: features with depth in the first seen in the second, PnP with RANSAC.

    Args:
        camera: the rectified camera.
        steps: the indices of both frames.
        left_i: rectified, of the first frame.
        disparity_i_px: its disparity, NaN where unknown.
        left_j: rectified, of the second.
        shrink: features are found on images shrunk so many times.

    Returns:
        None where too few points agree.
    """
    matches = match_features(left_i, left_j, shrink)
    points_i, known = _points(camera, disparity_i_px, matches[:, :2])
    points_i, pixels_j = points_i[known], matches[known, 2:]
    if len(points_i) < MIN_INLIERS:
        return None
    K = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]], np.float64)
    scale_m = float(np.median(points_i[:, 2]))
    cv2.setRNGSeed(0)
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points_i / scale_m,
        pixels_j,
        K,
        None,
        iterationsCount=300,
        reprojectionError=REPROJECTION_PX * shrink,
        confidence=0.999,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not found or inliers is None or len(inliers) < max(MIN_INLIERS, MIN_INLIER_SHARE * len(points_i)):
        return None
    rows: np.ndarray = np.asarray(inliers, np.int64)[:, 0]
    turn, shift = cv2.solvePnPRefineLM(points_i[rows] / scale_m, pixels_j[rows], K, None, turn, shift)
    R_j_i, t_j = cv2.Rodrigues(turn)[0], shift[:, 0] * scale_m
    T_i_j = np.eye(4)
    T_i_j[:3, :3], T_i_j[:3, 3] = R_j_i.T, -R_j_i.T @ t_j
    return Motion(*steps, T_i_j, len(rows), float(np.median(points_i[rows, 2])))


def ground_normal(camera: StereoCamera, disparity_px: Float32[np.ndarray, "H W"]) -> Float64[np.ndarray, "3"] | None:
    """The normal of the plane that most of the lower two thirds of the image lie on, in the camera's frame.

    It points to the side of the camera, so it is up where the plane is the ground; a wall's is level.

    Returns:
        None where no plane holds half of the points.
    """
    height, width = disparity_px.shape
    rng = np.random.default_rng(0)
    pixels = rng.uniform((0, height / 3), (width - 1, height - 1), (4 * PLANE_POINTS, 2)).round()
    points, known = _points(camera, disparity_px, pixels)
    points: np.ndarray = points[known][:PLANE_POINTS]
    if len(points) < PLANE_POINTS // 10:
        return None
    corners = points[rng.integers(0, len(points), (PLANE_HYPOTHESES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    offsets_m = np.sum(normals * corners[:, 0], axis=1)
    near = np.abs(points @ normals.T - offsets_m) < PLANE_TOLERANCE * points[:, 2:]
    near[:, lengths[:, 0] == 0] = False
    best = near[:, near.sum(axis=0).argmax()]
    if best.mean() < PLANE_SHARE:
        return None
    centre = points[best].mean(axis=0)
    normal = np.linalg.svd((points[best] - centre) / points[best, 2:])[2][2]
    return normal if normal @ centre < 0 else -normal


def _points(camera: StereoCamera, disparity_px: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (M, 3) in the camera's frame at some pixels of the left image, and which of them are known."""
    columns, rows = np.rint(pixels.reshape(-1, 2)).astype(int).T
    height, width = disparity_px.shape
    disparity = disparity_px[rows.clip(0, height - 1), columns.clip(0, width - 1)].astype(np.float64)
    disparity = disparity + float(camera.doffs_px)
    known = disparity >= MIN_DISPARITY_PX
    fx, fy, cx, cy = (float(getattr(camera, f"{name}_px")) for name in ("fx", "fy", "cx", "cy"))
    Z = float(camera.baseline_m) * fx / np.where(known, disparity, 1.0)
    points = np.stack([(pixels[:, 0] - cx) * Z / fx, (pixels[:, 1] - cy) * Z / fy, Z], axis=-1)
    return points, known


def angle_deg(R: np.ndarray) -> np.ndarray:
    """Angles of rotations (..., 3, 3)."""
    return np.degrees(np.arccos(np.clip((np.trace(R, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))


def between_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between vectors (M, 3); 90 where one is zero, which has no direction."""
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    cosines = np.divide((a * b).sum(axis=1), lengths, out=np.zeros(len(a)), where=lengths > 0)
    return np.degrees(np.arccos(np.clip(cosines, -1, 1)))
