"""The stereo front end: from a pair of images as read to a rectified pair and its disparity."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from jaxmap.errors import FrameError, JaxmapError
from jaxmap.host.stages import timed_stage
from jaxmap.labels import IGNORE
from jaxmap.stereo.align import alignment_homography, estimate_alignment, match_features
from jaxmap.stereo.bands import search_bands
from jaxmap.stereo.blank import blank_reason
from jaxmap.stereo.coarse import CoarseMatcher
from jaxmap.stereo.jax_matcher import JaxMatcher, make_matcher
from jaxmap.stereo.match import Band, Matcher, StereoOptions, as_grey
from jaxmap.stereo.near import too_near
from jaxmap.stereo.rectify import Rectifier, StereoRig, make_rectifier, rectify_image, rectify_labels
from jaxmap.types import StereoCamera

_BLANK_FIX = "take the frame out, or choose others with --start, --stop and --stride"


class RectifiedFrame(NamedTuple):
    """A rectified pair, the disparity of its left image in px (NaN where unknown), and the time of the two stages.

    The images are empty where observations are read again; the right one is grey. The disparity is None where the
    compiled step finds it. `blind` are pixels that have none, whatever the images show: the raw image does not reach
    there, or something is too near; `bands` say what is searched where. `too_near` is the share of pixels that were
    left out because they are nearer than all that is searched, and `nearest_px` the disparity of the nearest of them.
    """

    left: np.ndarray
    right: np.ndarray
    disparity_px: np.ndarray | None
    rectify_s: float
    match_s: float
    too_near: float = 0.0
    nearest_px: float = 0.0
    blind: np.ndarray | None = None
    bands: tuple[Band, ...] = ()


class StereoFrontEnd:
    """Rectification, where the images are raw, and matching; may be called from several threads.

    Attributes:
        matcher: gives disparities to whatever asks for them on the host: OpenCV's, or that of the step, compiled apart.
        camera: the rectified camera.
        rectified_here: whether the images are raw, and rectified by it.
        T_raw_rectified: (4, 4), so that `T_world_raw @ T_raw_rectified` is the rectified pose.
        alignment_rad: rotation vector by which the rectified right camera is corrected, or None.
        matcher: of the rectified images.
        coarse: matches small images, which tell what is too near for the matcher, and what it need not search; None
            where neither was asked for.
    """

    def __init__(
        self,
        camera: StereoCamera | StereoRig,
        options: StereoOptions,
        alignment_rad: Float64[np.ndarray, "3"] | None = None,
    ) -> None:
        """Prepares the look-up maps and the matcher.

        Raises:
            JaxmapError: the cameras stand one above the other or are swapped.
            UsageError: more disparities than columns.
        """
        self.rectifier: Rectifier | None = None
        self.T_raw_rectified = np.eye(4)
        self.alignment_rad = alignment_rad
        self._right_homography: np.ndarray | None = None
        if isinstance(camera, StereoRig):
            R_aligned = None if alignment_rad is None else Rotation.from_rotvec(alignment_rad).as_matrix()
            self.rectifier = make_rectifier(camera, options.alpha, R_aligned)
            self.T_raw_rectified[:3, :3] = self.rectifier.R_rectified_left.T
            camera = self.rectifier.camera
        elif alignment_rad is not None:
            self._right_homography = alignment_homography(camera, alignment_rad)
        self.rectified_here = self.rectifier is not None
        self.camera: StereoCamera = camera
        self.matcher: Matcher | JaxMatcher = make_matcher(options, camera.width_px)
        narrows = isinstance(self.matcher, Matcher) and self.matcher.narrows
        self.coarse = CoarseMatcher(self.matcher, camera.width_px) if options.near_guard or narrows else None

    def __call__(self, left: np.ndarray, right: np.ndarray) -> RectifiedFrame:
        """Rectifies and matches one pair.

        Args:
            left: uint8, (H, W) or (H, W, 3) RGB, as read.
            right: likewise.

        Raises:
            FrameError: the sizes disagree with each other or with the calibration, or an image shows nothing.
        """
        ready, stages_s = self.ready(left, right), {}
        with timed_stage("match", stages_s):
            matched = self.matched(ready)
        return matched._replace(match_s=ready.match_s + stages_s["match"])

    def ready(self, left: np.ndarray, right: np.ndarray) -> RectifiedFrame:
        """Rectifies one pair for a step that matches it: as when it is called, but for the disparity.

        Raises:
            FrameError: the sizes disagree with each other or with the calibration, or an image shows nothing.
        """
        stages_s: dict[str, float] = {}
        self._check_sizes(left, right)
        with timed_stage("rectify", stages_s):
            for side, image in (("left", left), ("right", right)):
                if (reason := blank_reason(image)) is not None:
                    raise FrameError(f"the {side} image {reason} and cannot be matched", fix=_BLANK_FIX)
            # Matchers take grey images, and nothing else looks at the right one, which is a third to rectify then.
            left, right = self.rectify(left, as_grey(right))
        blind = None if self.rectifier is None else ~self.rectifier.seen
        frame = RectifiedFrame(left, right, None, stages_s["rectify"], 0.0, blind=blind)
        with timed_stage("match", stages_s):
            frame = self._glanced_at(frame)
        return frame._replace(match_s=stages_s["match"])

    def _glanced_at(self, frame: RectifiedFrame) -> RectifiedFrame:
        """The frame with what small images show of it."""
        if self.coarse is None:
            return frame
        coarse, matcher = self.coarse(frame.left, frame.right), self.matcher
        image_px = frame.left.shape[:2]
        limit_px = matcher.options.min_disparity_px + matcher.num_disparities
        if isinstance(matcher, Matcher) and matcher.narrows and self.coarse.limit_px >= limit_px:
            frame = frame._replace(bands=search_bands(coarse, matcher, image_px[0]))
        near = too_near(coarse, limit_px, image_px) if matcher.options.near_guard else None
        if near is None:
            return frame
        blind = near.pixels if frame.blind is None else frame.blind | near.pixels
        return frame._replace(too_near=float(near.pixels.mean()), nearest_px=near.disparity_px, blind=blind)

    def matched(self, frame: RectifiedFrame) -> RectifiedFrame:
        """The frame with its disparity."""
        return frame._replace(disparity_px=self.disparity_of(frame))

    def disparity_of(self, frame: RectifiedFrame) -> np.ndarray:
        """The disparity of a rectified pair, float32 (H, W): its own, or matched now where the step finds it."""
        if frame.disparity_px is not None:
            return frame.disparity_px
        if isinstance(self.matcher, Matcher):
            disparity_px = self.matcher(frame.left, frame.right, frame.bands)
        else:
            disparity_px = self.matcher(frame.left, frame.right)
        if frame.blind is not None:
            disparity_px[frame.blind] = np.nan
        return disparity_px

    def rectify(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The rectified pair; the images as they are where nothing is to be done.

        Raises:
            FrameError: the sizes disagree with each other or with the calibration.
        """
        self._check_sizes(left, right)
        if self.rectifier is not None:
            return rectify_image(left, self.rectifier.left_maps), rectify_image(right, self.rectifier.right_maps)
        if self._right_homography is not None:
            size_px = (self.camera.width_px, self.camera.height_px)
            right = cv2.warpPerspective(right, self._right_homography, size_px, flags=cv2.INTER_LINEAR)
        return left, right

    def _check_sizes(self, left: np.ndarray, right: np.ndarray) -> None:
        expected = (self.camera.height_px, self.camera.width_px)
        for side, image in (("left", left), ("right", right)):
            if image.shape[:2] != expected:
                raise FrameError(
                    f"the {side} image is {image.shape[1]}x{image.shape[0]} px, the calibration says "
                    f"{expected[1]}x{expected[0]} px",
                    fix="give the calibration of these images",
                )

    def check_order(self, frame: RectifiedFrame, where: object = "") -> None:
        """Rejects a pair whose left and right images are swapped.

        Raises:
            JaxmapError: the pair matches far better the other way round.
        """
        if self._looks_swapped(frame):
            valid = np.isfinite(self.disparity_of(frame)).mean()
            raise JaxmapError(
                f"left and right look swapped: {valid:.0%} of the disparities are valid, far more the other way round",
                where=where,
                fix="swap the two folders or cameras",
            )

    def _looks_swapped(self, frame: RectifiedFrame) -> bool:
        """Whether the pair matches far better the other way round, unless its features say that it does not."""
        # The shares of valid pixels that tell are OpenCV's.
        by_opencv = self.matcher
        if not isinstance(by_opencv, Matcher):
            by_opencv, frame = Matcher(by_opencv.options, self.camera.width_px), frame._replace(disparity_px=None)
        disparity_px = by_opencv(frame.left, frame.right) if frame.disparity_px is None else frame.disparity_px
        if not by_opencv.looks_swapped(frame.left, frame.right, disparity_px):
            return False
        # What is nearer than the matcher sees has few true matches either way.
        found = estimate_alignment(self.camera, match_features(frame.left, frame.right))
        return found is None or found.inliers.mean() < 0.5 or float(np.median(found.disparity_px[found.inliers])) < 0

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
