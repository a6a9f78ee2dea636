"""The options of geometry: the bounds of a map, the depths that are mapped, and the fit of a plane."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Interval

from jaxmap.errors import UsageError
from jaxmap.host.settings import LARGEST, AnyNumber, CellSize, NotNegative, Positive, count, options

_MOST_RESIDUALS = 1 << 25

Edge = Annotated[float, Interval(ge=1e-6, le=1e3)]
Metres = Annotated[float, AnyNumber]
Triple = tuple[Metres, Metres, Metres]


@options("grid")
class GridOptions:
    """Bounds and resolution of the map."""

    voxel_size_m: Edge | tuple[Edge, Edge, Edge] | None = None
    """Edge of a voxel, or three edges (x, y, z). By default 0.05 0.05 0.2: columns finer than the cells that maps are
    scored in, so that rocks are measured by area."""
    lower_m: Triple | None = None
    """Lower corner of the map, relative to the site origin, down to whole voxels; by default the poses and the range
    decide."""
    upper_m: Triple | None = None
    """Upper corner, with the lower one."""
    below_camera_m: Annotated[float, Positive] = 3.0
    """How far automatic bounds reach below the lowest camera."""
    above_camera_m: Annotated[float, Positive] = 2.0
    """How far automatic bounds reach above the highest camera."""
    max_memory_gib: Annotated[float, Interval(ge=1e-6, le=LARGEST)] = 2.0
    """Of a map that takes more, only tiles near the rover are in memory, and the others on disk."""


@options("depth")
class DepthOptions:
    """Which depths are mapped."""

    min_m: Annotated[float, NotNegative] = 0.3
    """Nearer points are left out."""
    max_m: Annotated[float, Positive] | None = None
    """Farther points are left out; by default where depth noise reaches max_sigma_m."""
    max_sigma_m: Annotated[float, Positive] = 0.5
    """Depth noise that sets the automatic range."""


@options("plane")
class PlaneFitOptions:
    """The fit of a plane by MLESAC (`geometry.plane`)."""

    sigma_m: Annotated[float, Positive] = 0.05
    """Standard deviation of points on the plane."""
    outlier_range_m: Annotated[float, Positive] = 4.0
    """Range over which points off the plane spread."""
    max_tilt_rad: Annotated[float, Interval(gt=0, le=1.5708)] = 0.6
    """Planes that lean further are walls."""
    hypotheses: Annotated[int, count(4096)] = 256
    """Planes tried, each through three points."""
    sample_points: Annotated[int, count(65_536, least=3)] = 8192
    """Points drawn to judge them."""
    em_rounds: Annotated[int, count(100)] = 3
    """Rounds of expectation maximisation."""
    cost: Literal["mlesac", "msac"] = "mlesac"
    """The score of a plane."""

    def __post_init__(self) -> None:
        """Refuses more residuals than fit a gigabyte."""
        if self.hypotheses * self.sample_points > _MOST_RESIDUALS:
            raise UsageError(
                f"{self.hypotheses} hypotheses of {self.sample_points} sample_points",
                where="plane",
                fix=f"take a product of at most {_MOST_RESIDUALS:,}",
            )


@options("relief")
class GroundOptions:
    """The local ground that relief is measured from (`geometry.relief`)."""

    range_m: Annotated[float, Interval(ge=0.1, le=1000)] = 12.8
    """How far ahead the ground is known."""
    cell_m: Annotated[float, CellSize] = 0.1
    """Edge of a cell of the ground; at long ranges it grows, so that no more than 160 cells lie ahead."""
    rock_m: Annotated[float, Interval(gt=0, le=20)] = 1.5
    """What rises on less than this width is no ground."""
    smooth_m: Annotated[float, Positive] = 0.6
    """Standard deviation of the neighbourhood that the ground is fitted to."""
    tolerance_m: Annotated[float, Positive] = 0.06
    """How far cells of the ground lie from it, beside their noise."""

    def __post_init__(self) -> None:
        """Refuses neighbourhoods wider than what is seen."""
        if max(self.rock_m, self.smooth_m) > self.range_m:
            raise UsageError(
                f"rock_m {self.rock_m:g} or smooth_m {self.smooth_m:g} is beyond range_m {self.range_m:g}",
                where="relief",
                fix="take smaller ones, or a longer range",
            )
