"""The rectified camera of two 3x4 projection matrices, as KITTI, ROS and others write them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from jaxmap.errors import JaxmapError
from jaxmap.types import StereoCamera, make_stereo_camera


def camera_of_projections(
    P_left: Float64[np.ndarray, "3 4"],
    P_right: Float64[np.ndarray, "3 4"],
    size_px: tuple[int, int],
    where: object,
    baseline_m: float | None = None,
) -> StereoCamera:
    """The camera whose images `P = [K | -f b]` project points of the rectified left camera to.

    Args:
        P_left: of the left camera.
        P_right: of the right camera, to the right of it.
        size_px: width and height.
        where: the source, for errors.
        baseline_m: where the matrices hold none.

    Raises:
        JaxmapError: a matrix that is no projection, cameras that differ, or no baseline.
    """
    for P in (P_left, P_right):
        if not (np.isfinite(P).all() and P[0, 0] > 0 and P[1, 1] > 0):
            raise JaxmapError("P holds no focal length", where=where, fix="restore it, or give a --calibration")
        if not np.array_equal(P[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1]):
            raise JaxmapError("P is not of a rectified camera", where=where, fix="restore it, or give a --calibration")
    if not np.allclose(P_left[[0, 1, 1], [0, 1, 2]], P_right[[0, 1, 1], [0, 1, 2]], rtol=1e-3):
        raise JaxmapError("the two cameras differ", where=where, fix="give a rectified pair, or a --calibration")
    return make_stereo_camera(
        fx_px=float(P_left[0, 0]),
        fy_px=float(P_left[1, 1]),
        cx_px=float(P_left[0, 2]),
        cy_px=float(P_left[1, 2]),
        baseline_m=float((P_left[0, 3] - P_right[0, 3]) / P_left[0, 0]) if baseline_m is None else baseline_m,
        doffs_px=float(P_right[0, 2] - P_left[0, 2]),
        width_px=size_px[0],
        height_px=size_px[1],
        where=where,
    )
