"""The stereo camera of two `sensor_msgs/CameraInfo`."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from jaxmap.datasets.projections import camera_of_projections
from jaxmap.errors import JaxmapError
from jaxmap.stereo.rectify import StereoRig, make_stereo_rig
from jaxmap.types import StereoCamera

_COEFFICIENTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "": (0,)}


class CameraInfo:
    """The numbers of a `CameraInfo` message: `K`, `D`, `R`, `P`, the model of distortion and the size.

    `P = [K' | -fx' b]` projects points of the rectified left camera, `R` turns raw vectors into rectified ones
    (docs of `sensor_msgs/CameraInfo`).
    """

    def __init__(self, message: Any, topic: str) -> None:
        """ROS 1 writes the names of the matrices in capitals, ROS 2 in small letters."""

        def matrix(name: str) -> np.ndarray:
            return np.asarray(
                getattr(message, name, None) if hasattr(message, name) else getattr(message, name.lower())
            )

        self.topic = topic
        self.K = matrix("K").astype(np.float64).reshape(3, 3)
        self.D = matrix("D").astype(np.float64).reshape(-1)
        self.R = matrix("R").astype(np.float64).reshape(3, 3)
        self.P = matrix("P").astype(np.float64).reshape(3, 4)
        self.model = str(message.distortion_model)
        self.size_px = (int(message.width), int(message.height))

    @property
    def undistorted(self) -> bool:
        """Whether raw and rectified images are the same: no distortion, no rotation, one camera matrix."""
        return not self.D.any() and np.allclose(self.R, np.eye(3)) and np.allclose(self.K, self.P[:, :3])

    def same_as(self, other: CameraInfo) -> bool:
        """Whether two messages say the same."""
        mine, theirs = ((info.K, info.D, info.R, info.P) for info in (self, other))
        return self.size_px == other.size_px and all(map(np.array_equal, mine, theirs))


def rectified_camera(
    left: CameraInfo, right: CameraInfo, T_left_right: Float64[np.ndarray, "4 4"] | None
) -> StereoCamera:
    """The camera of rectified images, by `P` of both; where they hold no baseline, it is taken from tf.

    Args:
        left: of the left camera.
        right: of the right camera.
        T_left_right: the right camera in the left one's frame, from tf.

    Raises:
        JaxmapError: no focal length, two different ones, or no baseline.
    """
    where = f"{left.topic} and {right.topic}"
    baseline_m = None
    if left.P[0, 3] == right.P[0, 3]:
        if T_left_right is None:
            raise JaxmapError(
                "no baseline: P[0, 3] is the same in both, and tf does not connect the cameras",
                where=where,
                fix="give --calibration FILE",
            )
        baseline_m = float(np.linalg.norm(T_left_right[:3, 3]))
    return camera_of_projections(left.P, right.P, left.size_px, f"{where} (left and right swapped?)", baseline_m)


def raw_rig(left: CameraInfo, right: CameraInfo, T_left_right: Float64[np.ndarray, "4 4"] | None) -> StereoRig:
    """The rig of raw images: `K` and `D`, and between the cameras what `R` and `P` say, else tf.

    With x_rect = R x in both cameras, and the rectified right camera at b = (P_left[0, 3] - P_right[0, 3]) / f:
    x_right = R_right^T (R_left x_left - (b, 0, 0)).

    Raises:
        JaxmapError: a distortion that is not supported, no baseline, or numbers that are no camera.
    """
    for info in (left, right):
        if len(info.D) not in (*_COEFFICIENTS.get(info.model, ()), 0):
            raise JaxmapError(
                f"distortion {info.model[:40]!r} with {len(info.D)} coefficients",
                where=info.topic,
                fix="plumb_bob and rational_polynomial are read; rectify the images, or give --calibration FILE",
            )
    f_left, f_right = left.P[0, 0], right.P[0, 0]
    baseline_m = left.P[0, 3] / f_left - right.P[0, 3] / f_right if f_left > 0 and f_right > 0 else 0.0
    if baseline_m:
        R_right_left = right.R.T @ left.R
        t_right_left_m = right.R.T @ [-baseline_m, 0.0, 0.0]
    elif T_left_right is not None:
        T_right_left = np.linalg.inv(T_left_right)
        R_right_left, t_right_left_m = T_right_left[:3, :3], T_right_left[:3, 3]
    else:
        raise JaxmapError(
            "CameraInfo does not say where the right camera is (P[0, 3] is 0), and tf does not connect the cameras",
            where=f"{left.topic} and {right.topic}",
            fix="give --calibration FILE",
        )
    return make_stereo_rig(
        K_left=left.K,
        distortion_left=left.D if left.D.size else np.zeros(5),
        K_right=right.K,
        distortion_right=right.D if right.D.size else np.zeros(5),
        R_right_left=R_right_left,
        t_right_left_m=t_right_left_m,
        size_px=left.size_px,
        where=f"{left.topic} and {right.topic}",
    )
