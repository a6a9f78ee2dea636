"""The options of the stereo front end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from annotated_types import Ge, Gt, Interval


@dataclass(frozen=True)
class StereoOptions:
    """Rectification and OpenCV's StereoSGBM; the same record serves as a node of the configuration."""

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid"}

    alpha: Annotated[float, Interval(ge=-1, le=1)] = 0.0
    """Rectification: 0 keeps only pixels valid in both images, 1 keeps all, -1 lets OpenCV choose."""
    mode: Literal["3way", "sgbm", "hh", "hh4"] = "3way"
    """Paths of the cost aggregation: three, five (sgbm), eight (hh) or four (hh4)."""
    min_disparity_px: int = 0
    """Smallest disparity searched."""
    num_disparities: Annotated[int, Gt(0)] | None = None
    """Disparities searched, a multiple of 16; by default an eighth of the image width."""
    block_size: Annotated[int, Gt(0)] = 5
    """Edge of the matched block, odd."""
    p1: Annotated[int, Gt(0)] | None = None
    """Penalty for a disparity step of one; by default 8 block_size^2."""
    p2: Annotated[int, Gt(0)] | None = None
    """Penalty for a greater step; by default 32 block_size^2."""
    pre_filter_cap: Annotated[int, Interval(ge=15, le=63)] = 31
    """Truncation of the image gradient; OpenCV takes 15 at least."""
    uniqueness_ratio: Annotated[int, Interval(ge=0, le=100)] = 10
    """Margin in per cent by which the best match must win."""
    left_right_max_diff_px: Annotated[int, Ge(-1)] = 1
    """Greatest difference in the left-right check; -1 turns it off."""
    speckle_window: Annotated[int, Ge(0)] = 100
    """Blobs of at most so many pixels are dropped; 0 turns it off."""
    speckle_range_px: Annotated[int, Ge(0)] = 2
    """Disparity step that ends a blob."""
    pad_left: bool = True
    """Match the leftmost columns too."""
