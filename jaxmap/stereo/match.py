"""Semi-global block matching by OpenCV: a rectified pair in, disparity out."""

from __future__ import annotations

import threading

import cv2
import numpy as np

from jaxmap.errors import FrameError, UsageError
from jaxmap.stereo.options import StereoOptions

_MODES = {
    "3way": cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    "sgbm": cv2.STEREO_SGBM_MODE_SGBM,
    "hh": cv2.STEREO_SGBM_MODE_HH,
    "hh4": cv2.STEREO_SGBM_MODE_HH4,
}
_SUBPIXELS = 16


class Matcher:
    """Matches rectified pairs; may be called from several threads at once."""

    def __init__(self, options: StereoOptions, width_px: int) -> None:
        """Checks the options for images of this width.

        Raises:
            UsageError: an option that OpenCV would refuse or silently change.
        """
        self.options = options
        self.num_disparities = options.num_disparities or -(-width_px // (8 * 16)) * 16
        if self.num_disparities <= 0 or self.num_disparities % 16:
            raise _bad(f"num_disparities is {self.num_disparities}", "take a positive multiple of 16")
        if options.left_right_max_diff_px == 0:
            raise _bad("left_right_max_diff_px is 0", "take 1 or more, or -1 to turn the check off")
        if not 15 <= options.pre_filter_cap <= 63:
            raise _bad(f"pre_filter_cap is {options.pre_filter_cap}", "take 15 to 63")
        if options.block_size < 1 or options.block_size % 2 == 0:
            raise _bad(f"block_size is {options.block_size}", "take an odd number, usually 3 to 11")
        if not options.pad_left and self.num_disparities + options.min_disparity_px >= width_px:
            raise _bad(f"{self.num_disparities} disparities in images {width_px} px wide", "take fewer")
        area = options.block_size**2
        self._p1 = 8 * area if options.p1 is None else options.p1
        self._p2 = 32 * area if options.p2 is None else options.p2
        if not 0 < self._p1 < self._p2:
            raise _bad(f"p1 is {self._p1} and p2 is {self._p2}", "take 0 < p1 < p2")
        self._local = threading.local()

    def __call__(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Disparity of the left image.

        Args:
            left: rectified, uint8, (H, W) or (H, W, 3) RGB.
            right: likewise, of the same size.

        Returns:
            float32 (H, W), pixels, in sixteenths; NaN where there is no match, the check of left
            against right failed, the match was not unique, or the blob was a speckle.
        """
        if left.shape[:2] != right.shape[:2]:
            raise FrameError(f"the left image is {_size(left)} and the right one {_size(right)}")
        left, right = _grey(left), _grey(right)
        pad = max(self.num_disparities + self.options.min_disparity_px, 0) if self.options.pad_left else 0
        if pad:
            left = cv2.copyMakeBorder(left, 0, 0, pad, 0, cv2.BORDER_REPLICATE)
            right = cv2.copyMakeBorder(right, 0, 0, pad, 0, cv2.BORDER_REPLICATE)
        raw = self._engine().compute(left, right)[:, pad:]
        disparity_px = np.multiply(raw, np.float32(1 / _SUBPIXELS), dtype=np.float32)
        np.copyto(disparity_px, np.nan, where=raw < self.options.min_disparity_px * _SUBPIXELS)
        return disparity_px

    def looks_swapped(self, left: np.ndarray, right: np.ndarray, disparity_px: np.ndarray) -> bool:
        """Whether the pair matches far better the other way round than it did."""
        valid = np.isfinite(disparity_px).mean()
        # Pairs in order reach 0.8 and more where all is textured; swapped ones 0.2 to 0.6.
        if valid > 0.75:
            return False
        other_way = np.isfinite(self(right, left)).mean()
        return bool(other_way > 0.2 and other_way > 1.4 * valid)

    def _engine(self) -> cv2.StereoSGBM:
        # An engine keeps its buffers from call to call, so each thread has its own.
        if not hasattr(self._local, "engine"):
            options, unchecked = self.options, self.options.left_right_max_diff_px < 0
            self._local.engine = cv2.StereoSGBM.create(
                minDisparity=options.min_disparity_px,
                numDisparities=self.num_disparities,
                blockSize=options.block_size,
                P1=self._p1,
                P2=self._p2,
                # OpenCV takes anything below 1 for 1, so the check is turned off by a difference that never occurs.
                disp12MaxDiff=self.num_disparities + 1 if unchecked else options.left_right_max_diff_px,
                preFilterCap=options.pre_filter_cap,
                uniquenessRatio=options.uniqueness_ratio,
                speckleWindowSize=options.speckle_window,
                speckleRange=options.speckle_range_px,
                mode=_MODES[options.mode],
            )
        return self._local.engine


def _grey(image: np.ndarray) -> np.ndarray:
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _bad(what: str, fix: str) -> UsageError:
    return UsageError(what, where="the stereo matcher's options", fix=fix)
