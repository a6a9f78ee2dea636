"""What a stereo matcher in JAX is made of: choices fixed before compiling, and numbers that may be tuned."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxmap.types import to_device

Cost = Literal["census", "bt", "mccnn"]

_MOST_STEPS = 127
MOST_P1, MOST_P2 = 1.0, 1.0
"""Where a cost is 127 steps at most, the ends of paths, and what two paths add to a cost, fit into 8 bits."""


@dataclass(frozen=True)
class MatchDesign:
    """What is decided before matching is compiled.

    Attributes:
        cost: how two pixels are compared: census, Birchfield-Tomasi or a network.
        min_disparity_px: smallest disparity searched.
        num_disparities: disparities searched, one pixel apart.
        paths: directions of the aggregation, 4 or 8.
        soft: minima are soft and gradients reach all numbers; else costs are small integers.
        kernels: CPUs and CUDA devices match by kernels made for them, bit for bit the same (not in soft mode).
        census_window_px: rows and columns that the census compares with the centre, odd.
        block_size: edge of the square over which costs are averaged, odd; 1 for none.
        pre_filter_cap: truncation of the image gradient (Birchfield-Tomasi).
        left_right_max_diff_px: greatest difference in the left-right check; negative for none.
        speckle_window_px: blobs of at most so many pixels are dropped; None for an 800th of the image's; 0 for none.
        speckle_range_px: disparity step that ends a blob.
        edge_step_px: pixels near a greater step of disparity are dropped; 0 for none.
        edge_window_px: edge of the square that is near, odd.
    """

    cost: Cost = "census"
    min_disparity_px: int = 0
    num_disparities: int = 64
    paths: Literal[4, 8] = 8
    soft: bool = False
    kernels: bool = True
    census_window_px: tuple[int, int] = (7, 9)
    block_size: int = 1
    pre_filter_cap: int = 31
    left_right_max_diff_px: float = 1.0
    speckle_window_px: int | None = None
    speckle_range_px: float = 2.0
    edge_step_px: float = 1.5
    edge_window_px: int = 7

    @property
    def cost_steps(self) -> int:
        """Steps that make up a cost of 1 where costs are integers (hard mode); those of the census are exact."""
        if self.cost != "census":
            return _MOST_STEPS
        bits = self.census_window_px[0] * self.census_window_px[1] - 1
        return bits * (_MOST_STEPS // bits)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MatchParams:
    """The numbers of the matcher on the device; every leaf is differentiable in soft mode.

    `p1` and `p2` penalise disparity steps of one and of more along a path, in units of the cost, which lies in [0, 1].
    `uniqueness` is the share by which the best match must win. `temperature`, in units of the cost, softens minima
    where the design is soft. `cost` are the weights of the cost network, where the design has one.
    """

    p1: Float[Array, ""]
    p2: Float[Array, ""]
    uniqueness: Float[Array, ""]
    temperature: Float[Array, ""]
    cost: PyTree = field(default_factory=dict)


_PENALTIES: dict[str, tuple[float, float]] = {"census": (0.15, 0.8), "bt": (0.13, 0.5), "mccnn": (0.4, 0.6)}


def make_match_params(
    cost: Cost = "census",
    *,
    p1: float | None = None,
    p2: float | None = None,
    uniqueness: float = 0.1,
    temperature: float = 0.05,
    weights: Any = None,
) -> MatchParams:
    """Builds `MatchParams`; penalties are by default those that suit the kind of cost."""
    least, most = _PENALTIES[cost]
    numbers = {"p1": least if p1 is None else p1, "p2": most if p2 is None else p2}
    numbers |= {"uniqueness": uniqueness, "temperature": temperature}
    return MatchParams(**{k: to_device(v, np.float32) for k, v in numbers.items()}, cost=weights or {})
