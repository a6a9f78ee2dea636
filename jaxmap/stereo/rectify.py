"""Stereo rectification of raw pairs, by OpenCV."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import jaxlie
import numpy as np
from numpy.typing import ArrayLike

from jaxmap.errors import JaxmapError
from jaxmap.matching.rectify import RawCamera, RawPair
from jaxmap.types import MOST_CAMERA_PX, DistortionModel, StereoCamera, make_stereo_camera, to_device

_COEFFICIENTS = 14
"""Of a lens, as the compiled step takes them."""


@dataclass(frozen=True)
class StereoRig:
    """Calibration of a raw (distorted, unrectified) stereo pair, OpenCV's conventions.

    `x_right = R_right_left @ x_left + t_right_left_m`; pixel centres are integers (MATLAB's
    principal points minus 1); distortion is `k1 k2 p1 p2 [k3 [k4 k5 k6]]`. `doffs_px` is added to the
    disparity offset of the rectified pair, to correct a constant error. Of an equidistant (fisheye) camera the four
    coefficients are those of Kannala and Brandt (2006), as of `cv2.fisheye`.
    """

    K_left: np.ndarray
    distortion_left: np.ndarray
    K_right: np.ndarray
    distortion_right: np.ndarray
    R_right_left: np.ndarray
    t_right_left_m: np.ndarray
    width_px: int
    height_px: int
    doffs_px: float = 0.0
    model: DistortionModel = "opencv"


def make_stereo_rig(
    *,
    K_left: ArrayLike,
    distortion_left: ArrayLike,
    K_right: ArrayLike,
    distortion_right: ArrayLike,
    R_right_left: ArrayLike,
    t_right_left_m: ArrayLike,
    size_px: tuple[int, int],
    doffs_px: float = 0.0,
    model: DistortionModel = "opencv",
    where: object = "calibration",
) -> StereoRig:
    """Checks and builds a `StereoRig`; `size_px` is (width, height).

    Raises:
        JaxmapError: a wrong shape, a number that is not finite, an invalid rotation, no baseline.
    """
    arrays = {
        name: np.asarray(value, np.float64)
        for name, value in dict(
            K_left=K_left,
            distortion_left=distortion_left,
            K_right=K_right,
            distortion_right=distortion_right,
            R_right_left=R_right_left,
            t_right_left_m=t_right_left_m,
        ).items()
    }
    arrays["t_right_left_m"] = arrays["t_right_left_m"].reshape(-1)
    for side in ("distortion_left", "distortion_right"):
        arrays[side] = arrays[side].reshape(-1)
        if arrays[side].size not in ((4,) if model == "equidistant" else (4, 5, 8, 12, 14)):
            raise JaxmapError(
                f"{side} has {arrays[side].size} coefficients",
                where=where,
                fix="give k1 k2 p1 p2, or 5, 8, 12 or 14 of them; of an equidistant camera k1 k2 k3 k4",
            )
    shapes = dict(K_left=(3, 3), K_right=(3, 3), R_right_left=(3, 3), t_right_left_m=(3,))
    for name, value in arrays.items():
        if name in shapes and value.shape != shapes[name]:
            raise JaxmapError(f"{name} has shape {value.shape}, not {shapes[name]}", where=where)
        if not np.isfinite(value).all():
            raise JaxmapError(f"{name} holds a number that is not finite", where=where)
        if np.abs(value).max() > MOST_CAMERA_PX:
            raise JaxmapError(f"{name} holds {np.abs(value).max():g}", where=where, fix="correct the calibration")
    R = arrays["R_right_left"]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
        raise JaxmapError("R_right_left is not a rotation", where=where, fix="check the stereo extrinsics")
    if np.linalg.norm(arrays["t_right_left_m"]) < 1e-6:
        raise JaxmapError("the stereo baseline is zero", where=where, fix="check the stereo extrinsics")
    if min(size_px) < 1:
        raise JaxmapError(f"the image size is {size_px[0]}x{size_px[1]}", where=where, fix="give a positive size")
    for side in ("K_left", "K_right"):
        if arrays[side][0, 0] <= 0 or arrays[side][1, 1] <= 0:
            raise JaxmapError(f"{side} has a focal length that is not positive", where=where)
    if not abs(doffs_px) <= MOST_CAMERA_PX:
        raise JaxmapError(f"doffs_px is {doffs_px}", where=where, fix="give a finite number")
    width_px, height_px = int(size_px[0]), int(size_px[1])
    return StereoRig(**arrays, width_px=width_px, height_px=height_px, doffs_px=float(doffs_px), model=model)


class Rectifier(NamedTuple):
    """A rectified camera and the look-up maps that make its images.

    `R_rectified_left` rotates vectors from the raw left camera frame into the rectified one, so a pose of
    the raw camera becomes `T_world_camera @ inverse(R_rectified_left)`. `seen` marks the rectified
    pixels that lie inside the raw left image.
    """

    camera: StereoCamera
    R_rectified_left: np.ndarray
    left_maps: tuple[np.ndarray, np.ndarray]
    right_maps: tuple[np.ndarray, np.ndarray]
    seen: np.ndarray


def make_rectifier(rig: StereoRig, alpha: float = 0.0, R_aligned: np.ndarray | None = None) -> Rectifier:
    """Rectification after Bouguet (`cv2.stereoRectify`), principal points aligned.

    Args:
        rig: the raw calibration.
        alpha: 0 keeps only pixels valid in both images, 1 keeps them all, -1 lets OpenCV choose.
        R_aligned: (3, 3), a correction of the rectified right camera's rays (`align.estimate_alignment`).

    Raises:
        JaxmapError: the right camera is not to the right of the left one.
    """
    size = (rig.width_px, rig.height_px)
    if rig.model == "equidistant":
        R_left, R_right, P_left, P_right = _rectified_fisheye(rig)
        undistorted = cv2.fisheye.initUndistortRectifyMap
    else:
        R_left, R_right, P_left, P_right, *_ = cv2.stereoRectify(
            rig.K_left,
            rig.distortion_left,
            rig.K_right,
            rig.distortion_right,
            size,
            rig.R_right_left,
            rig.t_right_left_m.reshape(3, 1),
            flags=cv2.CALIB_ZERO_DISPARITY,
            alpha=alpha,
        )
        undistorted = cv2.initUndistortRectifyMap
    if abs(P_right[1, 3]) > abs(P_right[0, 3]):
        raise JaxmapError(
            "the cameras stand one above the other", where="calibration", fix="only horizontal pairs can be matched"
        )
    camera = make_stereo_camera(
        fx_px=P_left[0, 0],
        fy_px=P_left[1, 1],
        cx_px=P_left[0, 2],
        cy_px=P_left[1, 2],
        baseline_m=-P_right[0, 3] / P_right[0, 0],
        doffs_px=P_right[0, 2] - P_left[0, 2] + rig.doffs_px,
        width_px=rig.width_px,
        height_px=rig.height_px,
        where="calibration (left and right swapped?)",
    )
    if R_aligned is not None:
        R_right = R_aligned @ R_right
    # Fixed-point maps: half the memory traffic of float ones, 1/32 px.
    left = undistorted(rig.K_left, rig.distortion_left, R_left, P_left, size, cv2.CV_16SC2)
    right = undistorted(rig.K_right, rig.distortion_right, R_right, P_right, size, cv2.CV_16SC2)
    inside = np.full((rig.height_px, rig.width_px), 255, np.uint8)
    seen = cv2.remap(inside, *left, cv2.INTER_LINEAR) == 255
    return Rectifier(camera, R_left, (left[0], left[1]), (right[0], right[1]), seen)


def _rectified_fisheye(rig: StereoRig) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rotations and projections of a rectified pair of equidistant cameras.

    The focal length stays: in the middle no detail is lost, and as theta < tan theta no pixel looks outside the raw
    image. `cv2.fisheye.stereoRectify` fits the whole view instead, for a wide one with a third of the focal length.
    """
    size, zero = (rig.width_px, rig.height_px), np.zeros(5)
    between = (rig.R_right_left, rig.t_right_left_m.reshape(3, 1))
    R_left, R_right, *_ = cv2.stereoRectify(rig.K_left, zero, rig.K_right, zero, size, *between)
    f_px = float(np.mean([rig.K_left[0, 0], rig.K_left[1, 1], rig.K_right[0, 0], rig.K_right[1, 1]]))
    P_left = np.array([[f_px, 0, (size[0] - 1) / 2, 0], [0, f_px, (size[1] - 1) / 2, 0], [0, 0, 1, 0]])
    P_right = P_left.copy()
    P_right[:2, 3] = f_px * (R_right @ rig.t_right_left_m)[:2]
    return R_left, R_right, P_left, P_right


def rectify_image(image: np.ndarray, maps: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """The rectified image, bilinear; outside the raw image it is black."""
    return cv2.remap(image, *maps, cv2.INTER_LINEAR)


def rectify_labels(labels: np.ndarray, maps: tuple[np.ndarray, np.ndarray], outside: int) -> np.ndarray:
    """The rectified label image, nearest pixel; outside the raw image it is `outside`."""
    # OpenCV 5.0 takes the wrong neighbour from fixed-point maps, so they are turned into floats (32nds of a pixel).
    u_px = maps[0][..., 0] + np.float32(1 / 32) * (maps[1] & 31)
    v_px = maps[0][..., 1] + np.float32(1 / 32) * (maps[1] >> 5)
    return cv2.remap(labels, u_px, v_px, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=outside)


def make_raw_pair(rig: StereoRig, R_aligned: np.ndarray | None = None) -> RawPair:
    """The numbers of a calibration on the device; `R_aligned` (3, 3) as `make_rectifier` takes it."""

    def camera(K: np.ndarray, distortion: np.ndarray) -> RawCamera:
        numbers = {"fx_px": K[0, 0], "fy_px": K[1, 1], "cx_px": K[0, 2], "cy_px": K[1, 2]}
        count = 4 if rig.model == "equidistant" else _COEFFICIENTS
        lens = np.pad(distortion, (0, count - distortion.size))
        leaves = {name: to_device(value, np.float32) for name, value in numbers.items()}
        return RawCamera(**leaves, distortion=to_device(lens, np.float32), model=rig.model)

    turn = jaxlie.SO3.from_matrix(to_device(np.eye(3) if R_aligned is None else R_aligned, np.float32))
    R_right_left = jaxlie.SO3.from_matrix(to_device(rig.R_right_left, np.float32))
    moved = jaxlie.SE3.from_rotation_and_translation(R_right_left, to_device(rig.t_right_left_m, np.float32))
    left, right = camera(rig.K_left, rig.distortion_left), camera(rig.K_right, rig.distortion_right)
    return RawPair(left, right, moved, turn)
