"""What a mapping run has done so far, in a size that does not grow with its frames."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, NamedTuple

import numpy as np
from annotated_types import Interval
from pydantic import ConfigDict, TypeAdapter, ValidationError

from jaxmap.errors import JaxmapError
from jaxmap.evaluation.geometry_scores import DisparityScores
from jaxmap.mapping.sequence import FusedFrame, PreparedFrame
from jaxmap.mapping.step import StepReport

MOST_KEPT = 2048
TOO_NEAR_SHARE = 0.01
"""A frame is counted where more than this share of it is nearer than can be seen."""

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)

Count = Annotated[int, Interval(ge=0, le=2**62)]
Number = Annotated[float, Interval(ge=-1e15, le=1e15)]
Seconds = Annotated[float, Interval(ge=0, le=1e15)]


@dataclass
class Sample:
    """Numbers of a long run, of which every `stride`-th is kept: all of them until there are more than `MOST_KEPT`.

    Attributes:
        kept: the numbers, in their order.
        stride: doubled, and the numbers between dropped, whenever there are too many.
        count: of all numbers.
        total: their sum.
    """

    __pydantic_config__ = _STRICT

    kept: list[Number] = field(default_factory=list)
    stride: Annotated[int, Interval(ge=1, le=2**62)] = 1
    count: Count = 0
    total: Number = 0.0

    def add(self, number: float) -> None:
        """Takes one more."""
        if self.count % self.stride == 0:
            self.kept.append(number)
        self.count += 1
        self.total += number
        if len(self.kept) > MOST_KEPT:
            self.kept = self.kept[::2]
            self.stride *= 2

    def percentile(self, percent: float) -> float:
        """Of the numbers that are kept."""
        return float(np.percentile(self.kept, percent))


class FrameNumbers(NamedTuple):
    """What a log keeps of a frame: plain values, the same whatever part of the map it was fused into.

    Attributes:
        valid_fraction: share of the pixels that have a disparity.
        points_kept: by the labeller.
        ground_found: whether the labeller found ground below the camera; None where it looks for none.
        too_near: share of the pixels that were left out as nearer than the searched disparities reach.
        nearest_px: the greatest disparity of those.
    """

    valid_fraction: float
    points_kept: int
    ground_found: bool | None
    too_near: float
    nearest_px: float


def numbers_of(prepared: PreparedFrame, info: StepReport) -> FrameNumbers:
    """What a log keeps of a fused frame."""
    rectified = prepared.rectified
    pixels, too_near, nearest_px = 1, 0.0, 0.0
    if rectified is not None:
        seen = rectified.left if rectified.disparity_px is None else rectified.disparity_px
        height, width = seen.shape[:2]
        pixels, too_near, nearest_px = height * width, rectified.too_near, rectified.nearest_px
    # Of the plane labeller as of those that see relief.
    found = getattr(info.estimate, "found", None)
    return FrameNumbers(
        round(int(info.points_valid) / pixels, 4),
        int(info.points_kept),
        None if found is None else bool(found),
        float(too_near),
        float(nearest_px),
    )


@dataclass
class RunLog:
    """What a run has done so far; it is saved with the map, so that a resumed run goes on counting.

    Attributes:
        next_index: the next frame.
        fused: how many frames were fused.
        skipped: the others, each with its reason.
        stages_ms: what each stage took for a frame.
        valid_fractions: share of a frame's pixels that have a disparity.
        points_fused: points that the labeller kept.
        without_ground: frames in which the labeller found no ground below the camera; None where it looks for none.
        too_near: frames of which more than a hundredth was left out as nearer than the searched disparities reach.
        nearest_px: the greatest disparity of what was left out so.
        disparity: scores of the disparity of frames whose truth is known, by name.
        total_s: time spent on frames.
        compile_s: time spent on compiling.
        temporary_bytes: memory that the step takes beside the map.
        digest: of the frames done so far, their poses and the camera (`Plan.digest`).
        complete: whether the run has come to its end.
    """

    __pydantic_config__ = _STRICT

    next_index: Count = 0
    fused: Count = 0
    skipped: list[dict[str, str]] = field(default_factory=list)
    stages_ms: dict[str, Sample] = field(default_factory=dict)
    valid_fractions: Sample = field(default_factory=Sample)
    points_fused: Count = 0
    without_ground: Count | None = None
    too_near: Count = 0
    nearest_px: Number = 0.0
    disparity: dict[str, Sample] = field(default_factory=dict)
    total_s: Seconds = 0.0
    compile_s: Seconds = 0.0
    temporary_bytes: Count = 0
    digest: str = ""
    complete: bool = False

    def add(self, fused: FusedFrame, scores: DisparityScores | None = None) -> None:
        """Takes note of one frame, and of how near the truth its disparity is, where that is known."""
        prepared = fused.prepared
        self.next_index = prepared.index + 1
        if fused.info is None:
            self.skipped.append({"frame": prepared.ref.name, "reason": str(prepared.fault)})
            return
        self.fused += 1
        for name, seconds in prepared.stages_s.items():
            self.stages_ms.setdefault(name, Sample()).add(round(1e3 * seconds, 3))
        self.count(numbers_of(prepared, fused.info))
        for name, value in (scores._asdict() if scores else {}).items():
            self.disparity.setdefault(name, Sample()).add(value)

    def count(self, numbers: FrameNumbers) -> None:
        """Takes note of what one frame has shown."""
        self.valid_fractions.add(numbers.valid_fraction)
        self.points_fused += numbers.points_kept
        if numbers.ground_found is not None:
            self.without_ground = (self.without_ground or 0) + (not numbers.ground_found)
        if numbers.too_near > TOO_NEAR_SHARE:
            self.too_near += 1
            self.nearest_px = max(self.nearest_px, numbers.nearest_px)

    def as_json(self) -> dict[str, Any]:
        """The log as plain values."""
        return asdict(self)

    @classmethod
    def from_json(cls, progress: dict[str, Any], where: object) -> RunLog:
        """The log of `as_json`.

        Raises:
            JaxmapError: it is damaged, or of another version.
        """
        try:
            return TypeAdapter(cls).validate_python(progress)
        except ValidationError as fault:
            raise JaxmapError(
                "what the run has logged is damaged, or of another version",
                where=where,
                fix="map the sequence anew with --overwrite",
            ) from fault

    def stage_summary(self) -> dict[str, dict[str, float]]:
        """Median, 95th percentile (milliseconds) and total (seconds) of each stage."""
        return {
            name: {
                "median_ms": round(times.percentile(50), 3),
                "p95_ms": round(times.percentile(95), 3),
                "total_s": round(times.total / 1e3, 3),
            }
            for name, times in self.stages_ms.items()
            if times.kept
        }
