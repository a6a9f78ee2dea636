"""The folder of one mapping run: what lies in it, and where it can go on."""

from __future__ import annotations

import re
import shutil
from contextlib import AbstractContextManager
from pathlib import Path

from jaxmap.config import MapConfig, config_tree
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.map_store import holds_map, load_map
from jaxmap.mapping_plan import Plan
from jaxmap.output_folder import check_inputs_stay, check_same_settings, locked, write_yaml
from jaxmap.run_log import RunLog
from jaxmap.types import VoxelMap

_PICTURE_NAME = re.compile(r"\d{6}_(left|disparity|labels)\.png")


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
        self.profile = path / "profile"

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
        return voxel_map, RunLog.from_json(attributes.progress, self.map)

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
        for folder in (self.map, self.profile):
            shutil.rmtree(folder, ignore_errors=True)
        for file in self._files:
            file.unlink(missing_ok=True)
        for picture in self.pictures.glob("*.png"):
            if _PICTURE_NAME.fullmatch(picture.name):
                picture.unlink()
