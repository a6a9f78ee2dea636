"""The matcher of the compiled step, for the host: what its options mean, and disparities where no step is run."""

from __future__ import annotations

from functools import partial
from threading import Lock
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Shaped

from jaxmap.errors import FrameError
from jaxmap.matching.design import Cost, MatchDesign, MatchParams, make_match_params
from jaxmap.matching.match import match
from jaxmap.stereo.match import Matcher, StereoOptions
from jaxmap.types import to_device


def make_matcher(options: StereoOptions, width_px: int) -> Matcher | JaxMatcher:
    """The matcher that the options name, for images of this width.

    Raises:
        UsageError: as many disparities as columns, or more.
    """
    return (Matcher if options.matcher == "opencv" else JaxMatcher)(options, width_px)


class JaxMatcher:
    """Semi-global matching in JAX, called on rectified pairs as `Matcher` is; may be called from several threads.

    Attributes:
        options: what it was made with.
        design: what is fixed before it is compiled: with the first pair.
        params: its numbers.
        num_disparities: how many disparities are searched.
    """

    def __init__(self, options: StereoOptions, width_px: int) -> None:
        """Decides on a design for images of this width."""
        self.options = options
        self.design, self.params = match_design(options, width_px), match_params(options)
        self.num_disparities = self.design.num_disparities
        self._lock = Lock()

    def __call__(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Disparity of the left image.

        Args:
            left: rectified, uint8, (H, W) or (H, W, 3) RGB.
            right: likewise, of the same size.

        Returns:
            float32 (H, W) in px; NaN where the pixel has no match, failed the left-right check, matched ambiguously,
            belongs to a speckle or lies at an edge of depth.

        Raises:
            FrameError: the two images differ in size.
        """
        if left.shape[:2] != right.shape[:2]:
            sizes = [f"{image.shape[1]}x{image.shape[0]}" for image in (left, right)]
            raise FrameError(f"the left image is {sizes[0]} and the right one {sizes[1]}")
        # One pair at a time takes all cores, and a volume of costs for each of several threads much memory.
        with self._lock:
            return np.array(_matched(self.design, to_device(left), to_device(right), self.params))


@partial(jax.jit, static_argnums=0)
def _matched(
    design: MatchDesign, left: Shaped[Array, "H W *rgb"], right: Shaped[Array, "H W *rgb"], params: MatchParams
) -> Float[Array, "H W"]:
    return match(design, left, right, params)


def match_params(options: StereoOptions, weights: Any = None) -> MatchParams:
    """The numbers that the options of stereo name; `weights` are those of the cost network."""
    return make_match_params(
        _cost(options),
        p1=options.step_penalty,
        p2=options.jump_penalty,
        uniqueness=options.uniqueness_ratio / 100,
        temperature=options.temperature,
        weights=weights,
    )


def match_design(options: StereoOptions, width_px: int) -> MatchDesign:
    """The design that the options of stereo name, for images of this width."""
    return MatchDesign(
        cost=_cost(options),
        min_disparity_px=options.min_disparity_px,
        num_disparities=options.num_disparities or -(-width_px // (8 * 16)) * 16,
        paths=options.paths,
        soft=options.soft,
        block_size=options.block_size if options.cost == "bt" else 1,
        pre_filter_cap=options.pre_filter_cap,
        left_right_max_diff_px=options.left_right_max_diff_px,
        speckle_window_px=options.speckle_window,
        speckle_range_px=options.speckle_range_px,
        edge_step_px=options.edge_step_px,
        edge_window_px=options.edge_window_px,
    )


def _cost(options: StereoOptions) -> Cost:
    return "mccnn" if options.matcher == "mccnn" else options.cost
