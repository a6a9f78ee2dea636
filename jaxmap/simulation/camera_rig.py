"""The rover's stereo cameras: the LocCam pair of the Katwijk data set, raw as it delivers them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxmap.errors import JaxmapError
from jaxmap.stereo.rectify import StereoRig, make_stereo_rig

LOCCAM_SIZE_PX = (1024, 768)

T_BODY_LEFT_POSITION_M = (-0.382, -0.078, 0.557)
T_BODY_LEFT_QUATERNION_XYZW = (0.572, 0.572, -0.416, -0.416)
"""The left camera in the frame of the inertial unit (x backward, y right, z up), as the data set's transforms say."""

GPS_ANTENNA_BODY_M = (0.221, -0.052, 1.5785)
"""The GPS antenna in the same frame."""

CAMERA_HEIGHT_M = 1.10
"""The left camera over level ground."""


def loccam() -> StereoRig:
    """The calibration of the LocCam pair, its principal points less MATLAB's 1 pixel."""
    return make_stereo_rig(
        K_left=[[834.2560029536488, 0, 496.7146425239835], [0, 838.9607387334217, 397.7726521928708], [0, 0, 1]],
        distortion_left=[-0.3599452734978721, 0.16926571545667204, 0, 0],
        K_right=[[837.1285943173126, 0, 480.93804066914896], [0, 840.8162958028008, 390.45997247218395], [0, 0, 1]],
        distortion_right=[-0.3532452554456559, 0.15661296396765548, 0, 0],
        R_right_left=np.transpose(
            [
                [0.9999918889154423, -0.003275110674652079, 0.002344302325735225],
                [0.0032800551744740386, 0.9999923978556189, -0.0021084280926701943],
                [-0.002337379168657423, 0.0021161004320057195, 0.9999950293764382],
            ]
        ),
        t_right_left_m=np.array([-120.07877836249332, -0.26252498371208993, 0.26829253767337935]) / 1000,
        size_px=LOCCAM_SIZE_PX,
    )


def scaled(rig: StereoRig, width_px: int) -> StereoRig:
    """The same cameras with images of another width: pixels grow, nothing else changes."""
    scale = width_px / rig.width_px
    height_px = round(rig.height_px * scale)

    def resized(K: np.ndarray) -> np.ndarray:
        # Pixel centres are integers, so the corner of the image lies at -0.5.
        shift = np.array([[scale, 0, 0.5 * scale - 0.5], [0, scale, 0.5 * scale - 0.5], [0, 0, 1]])
        return shift @ K

    return make_stereo_rig(
        K_left=resized(rig.K_left),
        distortion_left=rig.distortion_left,
        K_right=resized(rig.K_right),
        distortion_right=rig.distortion_right,
        R_right_left=rig.R_right_left,
        t_right_left_m=rig.t_right_left_m,
        size_px=(width_px, height_px),
    )


def body_from_left() -> Float[np.ndarray, "4 4"]:
    """T_body_left: the left camera's frame in the body's."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(T_BODY_LEFT_QUATERNION_XYZW).as_matrix()
    T[:3, 3] = T_BODY_LEFT_POSITION_M
    return T


def left_from_right(rig: StereoRig) -> Float[np.ndarray, "4 4"]:
    """T_left_right: the right camera's frame in the left one's."""
    T = np.eye(4)
    T[:3, :3] = rig.R_right_left
    T[:3, 3] = rig.t_right_left_m
    return np.linalg.inv(T)


def undistorted_pixels(
    K: Float[np.ndarray, "3 3"], distortion: Float[np.ndarray, "D"], width_px: int, height_px: int
) -> Float[np.ndarray, "2 H W"]:
    """Where the pixels of a raw image look: x and y of their rays at z = 1, to 1e-7 of a pixel."""
    u, v = np.meshgrid(np.arange(width_px, dtype=np.float64), np.arange(height_px, dtype=np.float64))
    target = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]])
    rays = target.copy()
    for _ in range(100):
        # What the lens shifts is added back; the shift grows less than the ray does, so this settles.
        missing = target - distorted(rays, distortion)
        rays += missing
        if np.abs(missing).max() * K[0, 0] < 1e-7:
            return rays
    raise JaxmapError("this lens folds its image over itself", where="calibration", fix="check the distortion")


def distorted(rays: Float[np.ndarray, "2 *N"], distortion: Float[np.ndarray, "D"]) -> Float[np.ndarray, "2 *N"]:
    """Rays (x and y at z = 1) as the lens bends them: Brown's model, `k1 k2 p1 p2 [k3]`."""
    k1, k2, p1, p2, k3 = (*distortion, 0.0)[:5]
    x, y = rays
    squared = x * x + y * y
    radial = 1 + squared * (k1 + squared * (k2 + squared * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (squared + 2 * x * x),
            y * radial + p1 * (squared + 2 * y * y) + 2 * p2 * x * y,
        ]
    )
