"""The relief of training images, measured as it is in the step."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Array, Float16

from jaxmap.geometry.relief import RELIEF_CHANNELS, RELIEF_STRIDE, relief_channels, relief_of
from jaxmap.training.data import Example, read_disparity
from jaxmap.types import StereoCamera, make_stereo_camera


def read_relief(example: Example) -> Float16[np.ndarray, "h w R"]:
    """The channels of relief of an image, `RELIEF_STRIDE` of its pixels for each; 0, unknown, without disparity.

    Raises:
        JaxmapError: disparity or camera cannot be read, or do not fit the image.
    """
    stereo = read_disparity(example)
    height, width = example.size_px
    if stereo is None:
        return np.zeros((-(-height // RELIEF_STRIDE), -(-width // RELIEF_STRIDE), RELIEF_CHANNELS), np.float16)
    disparity_px, level = stereo
    camera = make_stereo_camera(
        fx_px=level.fx_px,
        fy_px=level.fy_px,
        cx_px=level.cx_px,
        cy_px=level.cy_px,
        baseline_m=level.baseline_m,
        doffs_px=level.doffs_px,
        width_px=width,
        height_px=height,
        where=example.name,
    )
    return np.asarray(_channels(camera, np.asarray(level.up_camera, np.float32), disparity_px), np.float16)


@jax.jit
def _channels(camera: StereoCamera, up_camera: Array, disparity_px: Array) -> Array:
    return relief_channels(relief_of(camera, up_camera, disparity_px))
