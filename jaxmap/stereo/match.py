"""Semi-global block matching by OpenCV: a rectified pair in, disparity out."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from annotated_types import Interval

from jaxmap.errors import FrameError, UsageError
from jaxmap.host.settings import NotNegative, count, options

_SUBPIXELS, _UNKNOWN, _MULTIPLE = 16, -1, 16
"""Of a disparity in OpenCV's integers; what is none; and how many are searched is a multiple of that."""
_MOST_DISPARITIES, _MOST_PENALTY = 2032, 32_767
"""OpenCV keeps disparities, in sixteenths, and costs as 16-bit integers."""
OVERLAP_ROWS = 16
"""Rows above a band that are matched with it: paths begin there, and blocks reach over its edges."""

_OF_OPENCV = ("mode", "p1", "p2", "pad_left", "narrow")
_OF_STEP = ("cost", "paths", "step_penalty", "jump_penalty", "soft", "temperature", "kernels")


@options("stereo")
class StereoOptions:
    """Options of the rectification and of OpenCV's StereoSGBM; also the `stereo` node of the configuration.

    Raises:
        UsageError: a value out of its bounds, or one that OpenCV would refuse or silently change.
    """

    alpha: Annotated[float, Interval(ge=-1, le=1)] = 0.0
    """Rectification: 0 keeps only pixels valid in both images, 1 keeps all, -1 lets OpenCV choose."""
    align: bool = False
    """Estimate a rotation of the right camera under which the rows of both images agree, from matches in some frames,
    and rectify all frames with it: for a calibration that is slightly off (`jaxmap check` says so)."""
    matcher: Literal["opencv", "sgm", "mccnn"] = "opencv"
    """OpenCV's on the host, or semi-global matching inside the compiled step, by hand-made costs or a network's."""
    cost: Literal["census", "bt"] = "census"
    """matcher sgm: compares the order of grey levels around two pixels, or grey levels (Birchfield-Tomasi)."""
    paths: Literal[4, 8] = 8
    """matchers sgm, mccnn: directions along which costs are aggregated."""
    step_penalty: Annotated[float, Interval(ge=0, le=1)] | None = None
    """matchers sgm, mccnn: cost of a disparity step of one, where the worst match costs 1; by default, what suits the
    cost."""
    jump_penalty: Annotated[float, Interval(ge=0, le=1)] | None = None
    """matchers sgm, mccnn: cost of a greater step."""
    soft: bool = False
    """matchers sgm, mccnn: soft minima, slower, through which gradients reach images and penalties."""
    temperature: Annotated[float, Interval(ge=1e-4, le=10)] = 0.05
    """How soft, in units of the cost."""
    kernels: bool = True
    """matchers sgm, mccnn: kernels made for the device; a CPU's need a C++ compiler, a CUDA device's compute capability
    8.0 (Ampere). Without them the same disparities take ten times as long or more."""
    cost_network: Path | None = None
    """matcher mccnn: a file of the network's weights (.safetensors, .pt, .onnx); by default those that come with the
    package mccnn."""
    cost_network_sha256: str | None = None
    """matcher mccnn: SHA-256 that this file must have; the config.yaml of a run records it."""
    mode: Literal["3way", "sgbm", "hh", "hh4"] = "3way"
    """Paths of the cost aggregation: three, five (sgbm), eight (hh) or four (hh4)."""
    min_disparity_px: Annotated[int, count(1024, least=-1024)] = 0
    """Smallest disparity searched."""
    num_disparities: Annotated[int, count(_MOST_DISPARITIES)] | None = None
    """Disparities searched, a multiple of 16; by default an eighth of the image width."""
    block_size: Annotated[int, count(21)] = 7
    """Matchers opencv and sgm: edge of the matched block, odd."""
    p1: Annotated[int, count(_MOST_PENALTY)] | None = None
    """Penalty for a disparity step of one; by default 16 block_size^2, twice what OpenCV suggests: sand has little
    texture."""
    p2: Annotated[int, count(_MOST_PENALTY)] | None = None
    """Penalty for a greater step; by default 64 block_size^2."""
    pre_filter_cap: Annotated[int, Interval(ge=15, le=63)] = 31
    """Truncation of the image gradient; OpenCV takes 15 at least."""
    uniqueness_ratio: Annotated[int, Interval(ge=0, le=100)] = 10
    """Margin in per cent by which the best match must win."""
    left_right_max_diff_px: Annotated[int, count(_MOST_DISPARITIES, least=-1)] = 1
    """Greatest difference in the left-right check; -1 turns it off."""
    speckle_window: Annotated[int, count(2**30, least=0)] | None = None
    """Blobs of at most so many pixels are dropped; by default an 800th of the image's (983 of 1024 x 768), and at
    least 100; 0 turns it off."""
    speckle_range_px: Annotated[int, count(_MOST_DISPARITIES, least=0)] = 2
    """Disparity step that ends a blob."""
    edge_step_px: Annotated[float, NotNegative] = 1.5
    """Pixels near a greater step of disparity are dropped: there, blocks smear rocks over the ground behind; 0 keeps
    them."""
    edge_window_px: Annotated[int, count(255)] = 7
    """Edge of the square, odd, that is near."""
    pad_left: bool = True
    """Match the leftmost columns too."""
    narrow: bool = False
    """Mode 3way: search in each part of the image the disparities that small images show there, and no others: a
    quarter faster. More pixels are matched, doubtful ones among them, which blur low relief."""
    near_guard: bool = True
    """Leave out what is too near for the disparities searched, instead of taking false matches there."""

    def __post_init__(self) -> None:
        if self.min_disparity_px + (self.num_disparities or 0) > _MOST_DISPARITIES:
            raise _bad(
                f"min_disparity_px {self.min_disparity_px} and num_disparities {self.num_disparities} reach too far",
                f"search to {_MOST_DISPARITIES} at most",
            )
        if (self.num_disparities or 0) % 16:
            raise _bad(f"num_disparities is {self.num_disparities}", "take a positive multiple of 16")
        if self.left_right_max_diff_px == 0:
            raise _bad("left_right_max_diff_px is 0", "take 1 or more, or -1 to turn the check off")
        if self.block_size % 2 == 0:
            raise _bad(f"block_size is {self.block_size}", "take an odd number, usually 3 to 11")
        if self.edge_window_px % 2 == 0:
            raise _bad(f"edge_window_px is {self.edge_window_px}", "take an odd number")
        p1, p2 = self.penalties()
        if not p1 < p2:
            raise _bad(f"p1 is {p1} and p2 is {p2}", "take 0 < p1 < p2")
        self._refuse_what_means_nothing()

    def _refuse_what_means_nothing(self) -> None:
        """Refuses options that differ from their defaults and belong to another matcher."""
        others = _OF_OPENCV if self.matcher != "opencv" else _OF_STEP
        others += ("cost", "block_size") if self.matcher == "mccnn" else ("cost_network", "cost_network_sha256")
        for one in fields(self):
            if one.name in others and getattr(self, one.name) != one.default:
                raise _bad(
                    f"{one.name} is {getattr(self, one.name)}, which means nothing to the matcher {self.matcher}",
                    f"leave it at {one.default}, or choose another --stereo.matcher",
                )

    def disparities(self, width_px: int) -> int:
        """How many disparities are searched in images of this width."""
        return self.num_disparities or -(-width_px // (8 * 16)) * 16

    def penalties(self) -> tuple[int, int]:
        """The penalties p1 and p2 of disparity steps."""
        area = self.block_size**2
        return 16 * area if self.p1 is None else self.p1, 64 * area if self.p2 is None else self.p2


class Band(NamedTuple):
    """Rows of an image, `first` to before `end`, and how many disparities are searched in them, from `least_px` on."""

    first: int
    end: int
    least_px: int
    disparities: int


class Matcher:
    """Matches rectified pairs; may be called from several threads at once."""

    def __init__(self, options: StereoOptions, width_px: int) -> None:
        """Checks the options for images of this width.

        Raises:
            UsageError: as many disparities as columns, or more.
        """
        self.options = options
        self.num_disparities = options.disparities(width_px)
        if not options.pad_left and self.num_disparities + options.min_disparity_px >= width_px:
            raise _bad(f"{self.num_disparities} disparities in images {width_px} px wide", "take fewer")
        self._local = threading.local()

    @property
    def narrows(self) -> bool:
        """Whether it is to be told what to search where: the paths of other modes run through the whole image."""
        return self.options.narrow and self.options.mode == "3way"

    def band(self, first: int, end: int, least_px: float = -math.inf, limit_px: float = math.inf) -> Band:
        """Rows in which disparities from `least_px` to below `limit_px` are searched, as far as the options go."""
        lowest = self.options.min_disparity_px
        highest = lowest + self.num_disparities
        from_px = math.floor(min(max(least_px, lowest), highest - _MULTIPLE))
        count = -(-math.ceil(min(limit_px, highest) - from_px) // _MULTIPLE) * _MULTIPLE
        count = min(max(count, _MULTIPLE), self.num_disparities)
        return Band(first, end, min(from_px, highest - count), count)

    def __call__(self, left: np.ndarray, right: np.ndarray, bands: Sequence[Band] = ()) -> np.ndarray:
        """Disparity of the left image.

        Args:
            left: rectified, uint8, (H, W) or (H, W, 3) RGB.
            right: likewise, of the same size.
            bands: what to search in which rows, which together are all; by default everything everywhere.

        Returns:
            float32 (H, W) in px, a multiple of 1/16; NaN where the pixel has no match, failed the left-right
            check, matched ambiguously, belongs to a speckle or lies at an edge of depth.

        Raises:
            FrameError: the two images differ in size.
        """
        import cv2

        from jaxmap.matching.select import usual_speckle_px

        check_same_size(left, right)
        left, right = as_grey(left), as_grey(right)
        # From here on in sixteenths, counted from the least that is searched; what is unknown is negative.
        found = np.empty(left.shape, np.int16)
        for band in bands or [self.band(0, len(left))]:
            found[band.first : band.end] = self._searched(left, right, band)
        speckle_px = self.options.speckle_window
        if speckle_px is None:
            speckle_px = usual_speckle_px(left.size)
        if speckle_px:
            cv2.filterSpeckles(found, _UNKNOWN, speckle_px, self.options.speckle_range_px * _SUBPIXELS)
        disparity_px = np.multiply(found, np.float32(1 / _SUBPIXELS), dtype=np.float32)
        disparity_px += np.float32(self.options.min_disparity_px)
        np.copyto(disparity_px, np.nan, where=(found < 0) | self._at_edges(found))
        return disparity_px

    def _searched(self, left: np.ndarray, right: np.ndarray, band: Band) -> np.ndarray:
        """The disparities of a band, in sixteenths, from the least of the options on."""
        import cv2

        above = min(OVERLAP_ROWS, band.first)
        rows = slice(band.first - above, band.end + self.options.block_size // 2 + 1)
        # OpenCV leaves out the columns whose match may lie left of the right image.
        pad = max(band.disparities + band.least_px, 0) if self.options.pad_left else 0
        padded = (cv2.copyMakeBorder(image[rows], 0, 0, pad, 0, cv2.BORDER_REPLICATE) for image in (left, right))
        found = self.engine(band).compute(*padded)[above : above + band.end - band.first, pad:]
        # OpenCV's own mark of the unknown is less than all that is searched.
        unknown = found < band.least_px * _SUBPIXELS
        found = found - np.int16(self.options.min_disparity_px * _SUBPIXELS)
        found[unknown] = _UNKNOWN
        return found

    def _at_edges(self, sixteenths: np.ndarray) -> np.ndarray:
        """Where a step of disparity is near; means nothing where disparity is unknown, which is negative."""
        import cv2

        if not self.options.edge_step_px:
            return np.zeros(sixteenths.shape, bool)
        square = np.ones((self.options.edge_window_px,) * 2, np.uint8)
        greatest = cv2.dilate(sixteenths, square)
        # Without their sign, negative numbers are greater than all others.
        least = cv2.erode(sixteenths.view(np.uint16), square).view(np.int16)
        return cv2.subtract(greatest, least) > self.options.edge_step_px * _SUBPIXELS

    def looks_swapped(self, left: np.ndarray, right: np.ndarray, disparity_px: np.ndarray) -> bool:
        """Whether the pair matches far better with left and right exchanged."""
        valid = np.isfinite(disparity_px).mean()
        # Textured pairs in the right order reach 0.8 and more, swapped ones 0.2 to 0.6.
        if valid > 0.75:
            return False
        other_way = np.isfinite(self(right, left)).mean()
        return bool(other_way > 0.2 and other_way > 1.4 * valid)

    def engine(self, band: Band | None = None) -> Any:
        """OpenCV's matcher of grey images, for the disparities of a band or for all; speckles are left to the caller.

        Each thread has its own, which reuses its buffers.
        """
        # Imported here, so that the command line can read the options without OpenCV and JAX.
        import cv2

        options = self.options
        if not hasattr(self._local, "engine"):
            p1, p2 = options.penalties()
            mode = "SGBM_3WAY" if options.mode == "3way" else options.mode.upper()
            self._local.engine = cv2.StereoSGBM.create(
                blockSize=options.block_size,
                P1=p1,
                P2=p2,
                preFilterCap=options.pre_filter_cap,
                uniquenessRatio=options.uniqueness_ratio,
                mode=getattr(cv2, f"STEREO_SGBM_MODE_{mode}"),
            )
        engine, band = self._local.engine, band or self.band(0, 0)
        engine.setMinDisparity(band.least_px)
        engine.setNumDisparities(band.disparities)
        # OpenCV raises anything below 1 to 1, so a difference that never occurs turns the check off.
        unchecked = options.left_right_max_diff_px < 0
        engine.setDisp12MaxDiff(band.disparities + 1 if unchecked else options.left_right_max_diff_px)
        return engine


def check_same_size(left: np.ndarray, right: np.ndarray) -> None:
    """Refuses a pair that cannot be matched.

    Raises:
        FrameError: the two images differ in size.
    """
    if left.shape[:2] != right.shape[:2]:
        sizes = [f"{image.shape[1]}x{image.shape[0]}" for image in (left, right)]
        raise FrameError(f"the left image is {sizes[0]} and the right one {sizes[1]}")


def as_grey(image: np.ndarray) -> np.ndarray:
    """An image, grey or RGB, as grey (ITU-R 601 luma)."""
    import cv2

    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def _bad(what: str, fix: str) -> UsageError:
    return UsageError(what, where="the stereo matcher's options", fix=fix)
