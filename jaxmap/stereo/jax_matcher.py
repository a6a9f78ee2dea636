"""The matcher of the compiled step, for the host: what its options mean, and disparities where no step is run."""

from __future__ import annotations

import hashlib
from functools import partial
from threading import Lock

import jax
import numpy as np
from jaxtyping import Array, Float, Shaped

from jaxmap.errors import UsageError
from jaxmap.matching.design import Cost, MatchDesign, MatchParams, make_match_params
from jaxmap.matching.match import match
from jaxmap.matching.mccnn import load_cost_network, packaged_weights
from jaxmap.stereo.match import Matcher, StereoOptions, check_same_size
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
        network_sha256: SHA-256 of the file of the cost network; None where there is none.
    """

    def __init__(self, options: StereoOptions, width_px: int) -> None:
        """Decides on a design for images of this width.

        Raises:
            JaxmapError: the weights of the cost network cannot be read.
            UsageError: they are not those that the options name by their SHA-256.
        """
        self.options = options
        self.design, self.params = match_design(options, width_px), match_params(options)
        self.num_disparities = self.design.num_disparities
        self.network_sha256 = _network_sha256(options)
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
        check_same_size(left, right)
        # One pair at a time takes all cores, and a volume of costs for each of several threads much memory.
        with self._lock:
            return np.array(_matched(self.design, to_device(left), to_device(right), self.params))


@partial(jax.jit, static_argnums=0)
def _matched(
    design: MatchDesign, left: Shaped[Array, "H W *rgb"], right: Shaped[Array, "H W *rgb"], params: MatchParams
) -> Float[Array, "H W"]:
    return match(design, left, right, params)


def match_params(options: StereoOptions) -> MatchParams:
    """The numbers that the options of stereo name, and the weights of the cost network where they name one.

    Raises:
        JaxmapError: these weights cannot be read.
    """
    weights = load_cost_network(options.cost_network) if options.matcher == "mccnn" else None
    return make_match_params(
        _cost(options),
        p1=options.step_penalty,
        p2=options.jump_penalty,
        uniqueness=options.uniqueness_ratio / 100,
        temperature=options.temperature,
        weights=weights,
    )


def _network_sha256(options: StereoOptions) -> str | None:
    """That of the file of the cost network, held against what the options name."""
    if options.matcher != "mccnn":
        return None
    path = options.cost_network or packaged_weights()
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    if options.cost_network_sha256 is not None and options.cost_network_sha256.lower() != sha256:
        raise UsageError(
            f"the cost network's SHA-256 does not start with {options.cost_network_sha256[:16]}",
            where=path,
            fix="give the weights of that run, or leave out stereo.cost_network_sha256",
        )
    return sha256


def match_design(options: StereoOptions, width_px: int) -> MatchDesign:
    """The design that the options of stereo name, for images of this width."""
    return MatchDesign(
        cost=_cost(options),
        min_disparity_px=options.min_disparity_px,
        num_disparities=options.disparities(width_px),
        paths=options.paths,
        soft=options.soft,
        kernels=options.kernels,
        # The network itself sees a block.
        block_size=1 if options.matcher == "mccnn" else options.block_size,
        pre_filter_cap=options.pre_filter_cap,
        left_right_max_diff_px=options.left_right_max_diff_px,
        speckle_window_px=options.speckle_window,
        speckle_range_px=options.speckle_range_px,
        edge_step_px=options.edge_step_px,
        edge_window_px=options.edge_window_px,
    )


def _cost(options: StereoOptions) -> Cost:
    return "mccnn" if options.matcher == "mccnn" else options.cost
