"""How far a rectified pair is from being rectified, by sparse matches, and the small rotation that mends it.

In a rectified pair every point lies on one row of both images, and none lies behind infinity (disparity below zero).
Features are matched over the whole image, with no regard to rows, so that what the calibration says does not decide
what is found.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxmap.stereo.match import as_grey
from jaxmap.types import StereoCamera

FEATURES = 1500
RATIO = 0.8
"""A match must be so much nearer in descriptors than the second best (Lowe 2004)."""

MIN_MATCHES = 20
WIDE_TOLERANCE, NARROW_TOLERANCE, LEAST_TOLERANCE_PX = 0.006, 0.002, 1.0
"""Matches whose rows differ by more from what a rotation explains, as a share of the width, are wrong."""

NOISE_PX = 0.3
BEHIND_SHARE, BEHIND_PX = 0.05, 1.0
"""The cameras converge more than the calibration says where so many matches lie so far behind infinity."""

HYPOTHESES = 300


def match_features(left: np.ndarray, right: np.ndarray, shrink: int = 1) -> Float64[np.ndarray, "M 4"]:
    """Matches of SIFT features that are each other's best by a clear margin.

    Args:
        left: uint8, (H, W) or (H, W, 3) RGB.
        right: likewise.
        shrink: both are shrunk so many times, which is faster and less exact.

    Returns:
        Column and row in the left image, column and row in the right one, in pixels of the full size.
    """
    # Sand has little contrast: OpenCV's threshold would leave a few features on it.
    detector = cv2.SIFT.create(FEATURES, contrastThreshold=0.01)
    found = [detector.detectAndCompute(shrunk_grey(image, shrink), None) for image in (left, right)]  # type: ignore[call-overload]
    if any(len(points) < 2 for points, _ in found):
        return np.zeros((0, 4))
    (points_left, descriptors_left), (points_right, descriptors_right) = found
    distance2 = (
        np.sum(descriptors_left**2, axis=1)[:, None]
        + np.sum(descriptors_right**2, axis=1)
        - 2 * descriptors_left @ descriptors_right.T
    )
    rows = np.arange(len(distance2))
    best, back = distance2.argmin(axis=1), distance2.argmin(axis=0)
    nearest, second = np.partition(distance2, 1, axis=1)[:, :2].T
    kept = rows[(back[best] == rows) & (nearest < RATIO**2 * second)]
    pixels = [np.array([point.pt for point in points]) for points in (points_left, points_right)]
    both = np.concatenate([pixels[0][kept], pixels[1][best[kept]]], axis=1)
    return (both + 0.5) * shrink - 0.5


def shrunk_grey(image: np.ndarray, shrink: int) -> np.ndarray:
    """An image, grey or RGB, as grey and shrunk so many times; what is left of a whole pixel at its edges goes."""
    grey = as_grey(image)
    if shrink == 1:
        return grey
    height, width = (length // shrink * shrink for length in grey.shape)
    return cv2.resize(grey[:height, :width], None, fx=1 / shrink, fy=1 / shrink, interpolation=cv2.INTER_AREA)


class Alignment(NamedTuple):
    """What makes the rows of a pair agree.

    Attributes:
        rotation_rad: rotation vector; it turns the rays of the right camera as calibrated into those that fit.
        inliers: of the matches given, those that agree with it.
        row_error_px: row in the right image less row in the left one, of each match, as the images are.
        row_residual_px: the same after the rotation.
        disparity_px: of each match, offset added, after the rotation: proportional to 1 / depth.
    """

    rotation_rad: Float64[np.ndarray, "3"]
    inliers: Bool[np.ndarray, "M"]
    row_error_px: Float64[np.ndarray, "M"]
    row_residual_px: Float64[np.ndarray, "M"]
    disparity_px: Float64[np.ndarray, "M"]


def estimate_alignment(camera: StereoCamera, matches: Float64[np.ndarray, "M 4"]) -> Alignment | None:
    """The rotation of the right camera under which rows agree and nothing lies behind infinity.

    Rows determine the rotations about the baseline (x) and the optical axis (z). The one about the vertical (y) bends
    rows by a pattern that errors of distortion make as well, while it shifts all disparities: on KITTI rows alone would
    shift them by 7 px. So it is zero unless matches lie behind infinity without it.

    Args:
        camera: the rectified camera.
        matches: of one pair or several, as of `match_features`.

    Returns:
        None where the matches are too few to tell.
    """
    if len(matches) < MIN_MATCHES:
        return None
    rotation = _consensus(camera, matches)
    tolerance_px = WIDE_TOLERANCE * camera.width_px
    for share in (1.0, 1.0, NARROW_TOLERANCE / WIDE_TOLERANCE):
        inliers = np.abs(_aligned(camera, rotation, matches)[:, 1]) < max(share * tolerance_px, LEAST_TOLERANCE_PX)
        if inliers.sum() < MIN_MATCHES:
            return None
        rotation = _rows_fitted(camera, matches[inliers], rotation)
        far_px, middle_px = np.quantile(_aligned(camera, rotation, matches[inliers])[:, 0], (BEHIND_SHARE, 0.5))
        # Where most of them lie behind infinity, left and right are swapped, which no rotation mends.
        if share == 1.0 and far_px < -BEHIND_PX and middle_px > 0:
            rotation[1] += far_px / float(camera.fx_px)
    disparity_px, residual_px = _aligned(camera, rotation, matches).T
    return Alignment(rotation, inliers, matches[:, 3] - matches[:, 1], residual_px, disparity_px)


def _aligned(camera: StereoCamera, rotation: np.ndarray, matches: np.ndarray) -> Float64[np.ndarray, "M 2"]:
    """Disparity, offset added, and difference of rows of matches after a rotation of the right camera, in px."""
    turned = rotate_right(camera, rotation, matches[:, 2:])
    return np.column_stack([matches[:, 0] - turned[:, 0] + float(camera.doffs_px), turned[:, 1] - matches[:, 1]])


def join(matches: Sequence[Float64[np.ndarray, "M 4"]]) -> Float64[np.ndarray, "M 4"]:
    """Matches of several pairs in one array."""
    return np.concatenate([np.zeros((0, 4)), *matches])


def rotate_right(
    camera: StereoCamera, rotation_rad: Float64[np.ndarray, "3"], pixels: Float64[np.ndarray, "M 2"]
) -> Float64[np.ndarray, "M 2"]:
    """Where pixels of the right image lie after a rotation of its rays."""
    H = alignment_homography(camera, rotation_rad)
    turned = np.column_stack([pixels, np.ones(len(pixels))]) @ H.T
    return turned[:, :2] / turned[:, 2:]


def alignment_homography(camera: StereoCamera, rotation_rad: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """K R inverse(K) of the right camera: it takes pixels of the right image to where they should lie."""
    K = np.array(
        [
            [float(camera.fx_px), 0, float(camera.cx_px) + float(camera.doffs_px)],
            [0, float(camera.fy_px), float(camera.cy_px)],
            [0, 0, 1],
        ]
    )
    return K @ Rotation.from_rotvec(rotation_rad).as_matrix() @ np.linalg.inv(K)


def _consensus(camera: StereoCamera, matches: np.ndarray) -> Float64[np.ndarray, "3"]:
    """The rotation about x and z, to first order, that the rows of most matches agree with (RANSAC)."""
    x = (matches[:, 2] - float(camera.cx_px) - float(camera.doffs_px)) / float(camera.fx_px)
    y = (matches[:, 3] - float(camera.cy_px)) / float(camera.fy_px)
    error_px = matches[:, 3] - matches[:, 1]
    # A rotation w moves a row by fy (wz x - wx (1 + y^2)), which is to be the opposite of the error.
    design = float(camera.fy_px) * np.column_stack([1 + y**2, -x])
    drawn = np.random.default_rng(0).integers(len(matches), size=(HYPOTHESES, 2))
    models = (np.linalg.pinv(design[drawn], rcond=1e-2) @ error_px[drawn][..., None])[..., 0]
    # A smooth score (Cauchy's), so that matches within a pixel count for more than those just within the tolerance.
    scores = np.log1p(((models @ design.T - error_px) / (3 * NOISE_PX)) ** 2).sum(axis=1)
    about_x, about_z = models[int(scores.argmin())]
    return np.array([about_x, 0.0, about_z])


def _rows_fitted(camera: StereoCamera, matches: np.ndarray, rotation: np.ndarray) -> Float64[np.ndarray, "3"]:
    """The rotation, turned about x and z to where rows agree best (Cauchy's loss)."""

    def residuals(about: np.ndarray) -> np.ndarray:
        turned = np.array([about[0], rotation[1], about[1]])
        return _aligned(camera, turned, matches)[:, 1] / NOISE_PX

    about_x, about_z = least_squares(residuals, rotation[[0, 2]], loss="cauchy", x_scale=1e-3).x
    return np.array([about_x, rotation[1], about_z])
