"""The stereo front end: from a pair of images as read to a rectified pair and its disparity."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmap.errors import FrameError, JaxmapError
from jaxmap.host.stages import timed_stage
from jaxmap.labels import IGNORE
from jaxmap.stereo.match import Matcher, StereoOptions
from jaxmap.stereo.rectify import Rectifier, StereoRig, make_rectifier, rectify_image, rectify_labels
from jaxmap.types import StereoCamera


class RectifiedFrame(NamedTuple):
    """A rectified pair, the disparity of its left image in px (NaN where unknown), and the time of the two stages."""

    left: np.ndarray
    right: np.ndarray
    disparity_px: np.ndarray
    rectify_s: float
    match_s: float


class StereoFrontEnd:
    """Rectification, where the images are raw, and matching; may be called from several threads.

    Attributes:
        camera: the rectified camera.
        T_raw_rectified: (4, 4), so that `T_world_raw @ T_raw_rectified` is the rectified pose.
    """

    def __init__(self, camera: StereoCamera | StereoRig, options: StereoOptions) -> None:
        """Prepares the look-up maps and the matcher.

        Raises:
            JaxmapError: the cameras stand one above the other or are swapped.
            UsageError: more disparities than columns.
        """
        self.rectifier: Rectifier | None = None
        self.T_raw_rectified = np.eye(4)
        if isinstance(camera, StereoRig):
            self.rectifier = make_rectifier(camera, options.alpha)
            self.T_raw_rectified[:3, :3] = self.rectifier.R_rectified_left.T
            camera = self.rectifier.camera
        self.camera: StereoCamera = camera
        self.matcher = Matcher(options, camera.width_px)

    def __call__(self, left: np.ndarray, right: np.ndarray) -> RectifiedFrame:
        """Rectifies and matches one pair.

        Args:
            left: uint8, (H, W) or (H, W, 3) RGB, as read.
            right: likewise.

        Raises:
            FrameError: the sizes disagree with each other or with the calibration.
        """
        expected = (self.camera.height_px, self.camera.width_px)
        for side, image in (("left", left), ("right", right)):
            if image.shape[:2] != expected:
                raise FrameError(
                    f"the {side} image is {image.shape[1]}x{image.shape[0]} px, the calibration says "
                    f"{expected[1]}x{expected[0]} px",
                    fix="give the calibration of these images",
                )
        stages_s: dict[str, float] = {}
        with timed_stage("rectify", stages_s):
            if self.rectifier is not None:
                left = rectify_image(left, self.rectifier.left_maps)
                right = rectify_image(right, self.rectifier.right_maps)
        with timed_stage("match", stages_s):
            disparity_px = self.matcher(left, right)
            if self.rectifier is not None:
                disparity_px[~self.rectifier.seen] = np.nan
        return RectifiedFrame(left, right, disparity_px, stages_s["rectify"], stages_s["match"])

    def check_order(self, frame: RectifiedFrame, where: object = "") -> None:
        """Rejects a pair whose left and right images are swapped.

        Raises:
            JaxmapError: the pair matches far better the other way round.
        """
        if self.matcher.looks_swapped(frame.left, frame.right, frame.disparity_px):
            valid = np.isfinite(frame.disparity_px).mean()
            raise JaxmapError(
                f"left and right look swapped: {valid:.0%} of the disparities are valid, far more the other way round",
                where=where,
                fix="swap the two folders or cameras",
            )

    def rectify_labels(self, labels: np.ndarray) -> np.ndarray:
        """Label image (H, W) or probabilities (H, W, C) of the raw left image, rectified.

        Labels take the nearest pixel and are `IGNORE` outside the raw image; probabilities are
        interpolated and 0 outside.
        """
        if self.rectifier is None:
            return labels
        if labels.ndim == 2:
            return rectify_labels(labels, self.rectifier.left_maps, IGNORE)
        # With a border, OpenCV remaps at most four channels at once.
        planes = [
            rectify_image(np.ascontiguousarray(labels[..., c]), self.rectifier.left_maps)
            for c in range(labels.shape[2])
        ]
        return np.stack(planes, axis=-1)
