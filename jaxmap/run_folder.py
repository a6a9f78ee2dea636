"""The folder of one mapping run: what lies in it, what a run has logged, and where it can go on."""

from __future__ import annotations

import re
import shutil
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxmap.config import MapConfig, config_tree
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.map_store import holds_map, load_map
from jaxmap.mapping_plan import Plan
from jaxmap.output_folder import check_inputs_stay, check_same_settings, locked, write_yaml
from jaxmap.sequence import FusedFrame
from jaxmap.types import VoxelMap

_PICTURE_NAME = re.compile(r"\d{6}_(left|disparity|labels)\.png")


@dataclass
class RunLog:
    """What a run has done so far; it is saved with the map, so that a resumed run goes on counting.

    Attributes:
        next_index: the frame to go on with.
        fused: names of the fused frames.
        skipped: the others, each with its reason.
        stages_ms: what each stage took, for each frame.
        valid_fractions: share of pixels with a disparity, for each frame.
        points_fused: points that the labeller kept.
        total_s: time spent on frames.
        compile_s: time spent on compiling.
        temporary_bytes: memory that the step takes beside the map.
        digest: of the frames done so far, their poses and the camera (`Plan.digest`).
        complete: whether the run has come to its end.
    """

    next_index: int = 0
    fused: list[str] = field(default_factory=list)
    skipped: list[dict[str, str]] = field(default_factory=list)
    stages_ms: dict[str, list[float]] = field(default_factory=dict)
    valid_fractions: list[float] = field(default_factory=list)
    points_fused: int = 0
    total_s: float = 0.0
    compile_s: float = 0.0
    temporary_bytes: int = 0
    digest: str = ""
    complete: bool = False

    def add(self, fused: FusedFrame) -> None:
        """Takes note of one frame."""
        prepared = fused.prepared
        self.next_index = prepared.index + 1
        if fused.info is None:
            self.skipped.append({"frame": prepared.ref.name, "reason": str(prepared.fault)})
            return
        self.fused.append(prepared.ref.name)
        for name, seconds in prepared.stages_s.items():
            self.stages_ms.setdefault(name, []).append(round(1e3 * seconds, 3))
        pixels = prepared.rectified.disparity_px.size if prepared.rectified is not None else 1
        self.valid_fractions.append(round(int(fused.info.points_valid) / pixels, 4))
        self.points_fused += int(fused.info.points_kept)

    def as_json(self) -> dict[str, Any]:
        """The log as plain values."""
        return asdict(self)

    def stage_summary(self) -> dict[str, dict[str, float]]:
        """Median, 95th percentile (milliseconds) and total (seconds) of each stage."""
        return {
            name: {
                "median_ms": round(float(np.median(times)), 3),
                "p95_ms": round(float(np.percentile(times, 95)), 3),
                "total_s": round(float(np.sum(times)) / 1e3, 3),
            }
            for name, times in self.stages_ms.items()
            if times
        }


class RunFolder:
    """Paths and bookkeeping of one run folder."""

    def __init__(self, path: Path) -> None:
        """Names the files; nothing is read or written yet."""
        self.path = path
        self.map = path / "map.zarr"
        self.ply = path / "map.ply"
        self.geotiff = path / "bev.tif"
        self.picture = path / "bev.png"
        self.missed = path / "missed.png"
        self.metrics = path / "metrics.json"
        self.config = path / "config.yaml"
        self.poses = path / "poses.tum"
        self.scores = path / "scores.json"
        self.errors = path / "errors.png"
        self.pictures = path / "pictures"

    def locked(self) -> AbstractContextManager[None]:
        """Keeps other runs out of the folder, see `output_folder.locked`."""
        return locked(self.path)

    def begin(self, plan: Plan, config: MapConfig, *, resume: bool, overwrite: bool) -> None:
        """Writes the resolved configuration, or checks that a run can go on.

        Raises:
            JaxmapError: the folder holds a run already, or files of the same names that are no run's.
            UsageError: the run to be resumed had other settings.
        """
        tree = {"sequence": plan.source, **config_tree(config), **plan.resolved}
        # A run that has failed before its first save has left nothing to lose.
        used = holds_map(self.map) or self.metrics.exists()
        if used and resume:
            check_same_settings(self.config, tree)
            return
        if used and not overwrite:
            raise JaxmapError(
                "the folder holds a run already",
                where=self.path,
                fix="go on with it (--resume), replace it (--overwrite), or choose another folder",
            )
        self._clear()
        write_yaml(self.config, tree)

    @property
    def _files(self) -> tuple[Path, ...]:
        report = self.path / "report.html"
        # Scores are of the map that is there: they go with it.
        scored = (self.scores, self.errors)
        derived = (self.ply, self.geotiff, self.picture, self.missed)
        return (*derived, self.metrics, self.poses, report, self.config, *scored)

    def check_apart(self, plan: Plan, config: MapConfig) -> None:
        """Refuses to write where the inputs lie; to be called before anything is made.

        Raises:
            UsageError: the folder is the sequence's own, or an output would overwrite an input.
        """
        here = self.path.resolve()
        images = {frame.left.parent.resolve() for frame in plan.sequence.frames}
        images |= {frame.right.parent.resolve() for frame in plan.sequence.frames}
        if here == Path(plan.source).resolve() or any(here == folder or folder in here.parents for folder in images):
            raise UsageError("the run folder is the sequence's own", where=self.path, fix="choose another --out")
        check_inputs_stay(self._files, (config.poses, config.calibration, config.model))

    def _is_run(self) -> bool:
        """Whether what lies here was written by a run."""
        if holds_map(self.map):
            return True
        try:
            return self.config.read_text(encoding="utf8").startswith("sequence:")
        except (OSError, UnicodeDecodeError):
            return False

    def resume_point(self) -> tuple[VoxelMap, RunLog] | None:
        """The map and log that an interrupted run has saved, or None where it has saved none.

        Raises:
            JaxmapError: there is a map, but it cannot be read.
        """
        if not holds_map(self.map):
            return None
        voxel_map, attributes = load_map(self.map, members=True)
        return voxel_map, RunLog(**attributes.progress)

    def _clear(self) -> None:
        """Removes what an earlier run has written, and nothing else."""
        if not self._is_run():
            foreign = [file.name for file in self._files if file.exists()]
            if foreign:
                raise JaxmapError(
                    f"{', '.join(foreign)} would be replaced, but no run has written them",
                    where=self.path,
                    fix="choose another --out",
                )
            return
        shutil.rmtree(self.map, ignore_errors=True)
        for file in self._files:
            file.unlink(missing_ok=True)
        for picture in self.pictures.glob("*.png"):
            if _PICTURE_NAME.fullmatch(picture.name):
                picture.unlink()
