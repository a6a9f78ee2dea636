"""Frames made smaller, for what is computed many times over: fewer pixels at fewer disparities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxmap.datasets.images import as_rgb
from jaxmap.matching.design import MatchDesign
from jaxmap.stereo.front_end import RectifiedFrame
from jaxmap.types import Frame, StereoCamera, make_stereo_camera, pinhole, to_device


def small_camera(camera: StereoCamera, times: int) -> StereoCamera:
    """The camera of images so many times smaller; rows and columns that are left over are cut off."""
    numbers = pinhole(camera)
    return make_stereo_camera(
        fx_px=numbers.fx_px / times,
        fy_px=numbers.fy_px / times,
        # The centre of the first pixel lies half a pixel inside the image, at any size.
        cx_px=(numbers.cx_px + 0.5) / times - 0.5,
        cy_px=(numbers.cy_px + 0.5) / times - 0.5,
        baseline_m=numbers.baseline_m,
        doffs_px=numbers.doffs_px / times,
        width_px=camera.width_px // times,
        height_px=camera.height_px // times,
    )


def small_design(design: MatchDesign, times: int) -> MatchDesign:
    """A soft design that searches the same depths in the smaller images."""
    least = design.min_disparity_px // times
    last = -(-(design.min_disparity_px + design.num_disparities) // times)
    window = design.speckle_window_px
    return replace(
        design,
        soft=True,
        min_disparity_px=least,
        num_disparities=last - least,
        speckle_window_px=None if window is None else window // times**2,
        block_size=design.block_size // (2 * times) * 2 + 1,
        edge_window_px=design.edge_window_px // (2 * times) * 2 + 1,
    )


def small_frame(frame: Frame, rectified: RectifiedFrame, times: int) -> Frame:
    """A frame for a step that matches it, so many times smaller: means of its images, and one in so many labels.

    Args:
        frame: as prepared for the step; its disparity is left out.
        rectified: the images it comes from.
        times: how many times smaller, in rows and columns.
    """
    blind = np.zeros(rectified.left.shape[:2], bool) if rectified.blind is None else rectified.blind

    def middle(values: np.ndarray) -> np.ndarray:
        rows, columns = (size // times * times for size in values.shape[:2])
        return np.asarray(values)[times // 2 : rows : times, times // 2 : columns : times]

    of_pixels = {name: getattr(frame, name) for name in ("labels", "class_probabilities")}
    return replace(
        frame,
        disparity_px=None,
        image=to_device(_mean(as_rgb(rectified.left), times)),
        right_image=to_device(_mean(as_rgb(rectified.right), times)),
        blind=to_device(middle(blind)),
        **{name: to_device(middle(values)) for name, values in of_pixels.items() if values is not None},
    )


def _mean(image: np.ndarray, times: int) -> np.ndarray:
    """Means of squares of pixels, rounded: a network, too, takes small integers."""
    rows, columns = (size // times for size in image.shape[:2])
    cut = image[: rows * times, : columns * times].astype(np.float32)
    return np.rint(cut.reshape(rows, times, columns, times, -1).mean((1, 3))).astype(np.uint8)
