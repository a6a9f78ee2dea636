"""The scene as a smaller camera sees it: every so many of its pixels, the same view."""

from __future__ import annotations

import scenes

from jaxmap.types import StereoCamera, make_stereo_camera


def small_camera(every_px: int) -> StereoCamera:
    """The scene's camera with pixels `every_px` times as large; disparities are so many times as small."""
    return make_stereo_camera(
        fx_px=scenes.F_PX / every_px,
        cx_px=scenes.CX_PX / every_px,
        cy_px=scenes.CY_PX / every_px,
        baseline_m=scenes.BASELINE_M,
        width_px=scenes.WIDTH_PX // every_px,
        height_px=scenes.HEIGHT_PX // every_px,
    )
