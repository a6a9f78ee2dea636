"""The cameras of the small scenes: one rectified, one raw and askew."""

from __future__ import annotations

import cv2
import numpy as np
from scenes import CX_PX, CY_PX, F_PX, HEIGHT_PX, WIDTH_PX

from jaxmap.stereo.rectify import make_stereo_rig
from jaxmap.types import make_stereo_camera

K = np.array([[F_PX, 0, CX_PX], [0, F_PX, CY_PX], [0, 0, 1]])

RIG = make_stereo_rig(
    K_left=K,
    distortion_left=np.array([-0.12, 0.02, 0.001, -0.001]),
    K_right=K + np.array([[2.0, 0, 1.5], [0, 2.0, -1.0], [0, 0, 0]]),
    distortion_right=np.array([-0.10, 0.01, -0.001, 0.001]),
    R_right_left=cv2.Rodrigues(np.array([0.02, -0.03, 0.025]))[0],
    t_right_left_m=np.array([-0.12, 0.003, -0.002]),
    size_px=(WIDTH_PX, HEIGHT_PX),
)

CAMERA = make_stereo_camera(
    fx_px=F_PX, cx_px=CX_PX, cy_px=CY_PX, baseline_m=0.12, width_px=WIDTH_PX, height_px=HEIGHT_PX
)
