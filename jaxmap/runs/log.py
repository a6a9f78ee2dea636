"""What a mapping run has done so far, in a size that does not grow with its frames."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval
from pydantic import ConfigDict, TypeAdapter, ValidationError

from jaxmap.errors import JaxmapError
from jaxmap.evaluation.geometry_scores import DisparityScores
from jaxmap.mapping.sequence import FusedFrame

MOST_KEPT = 2048

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
    disparity: dict[str, Sample] = field(default_factory=dict)
    total_s: Seconds = 0.0
    compile_s: Seconds = 0.0
    temporary_bytes: Count = 0
    digest: str = ""
    complete: bool = False

    def add(self, fused: FusedFrame) -> None:
        """Takes note of one frame."""
        prepared = fused.prepared
        self.next_index = prepared.index + 1
        if fused.info is None:
            self.skipped.append({"frame": prepared.ref.name, "reason": str(prepared.fault)})
            return
        self.fused += 1
        for name, seconds in prepared.stages_s.items():
            self.stages_ms.setdefault(name, Sample()).add(round(1e3 * seconds, 3))
        pixels = prepared.rectified.disparity_px.size if prepared.rectified is not None else 1
        self.valid_fractions.add(round(int(fused.info.points_valid) / pixels, 4))
        self.points_fused += int(fused.info.points_kept)
        # Of the plane labeller as of those that see relief.
        if (found := getattr(fused.info.estimate, "found", None)) is not None:
            self.without_ground = (self.without_ground or 0) + (not bool(found))

    def add_scores(self, scores: DisparityScores) -> None:
        """Takes note of how near the truth a frame's disparity is."""
        for name, value in scores._asdict().items():
            self.disparity.setdefault(name, Sample()).add(value)

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
