"""The folder of a mapping run: its files, and what is written beside the map: pictures, PLY, GeoTIFF, poses."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxmap.datasets.poses import write_tum
from jaxmap.ensemble.layer import stored_layers
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.export.formats import FORMATS
from jaxmap.fusion.neighbours import kernel_margin
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams
from jaxmap.fusion.query import observed, occupied, voxel_labels
from jaxmap.host.bounded_text import read_text
from jaxmap.host.files import atomic_path, real_path
from jaxmap.host.output_folder import check_inputs_stay, check_same_settings, locked, write_yaml
from jaxmap.host.replacement import Replacement
from jaxmap.mapping.store import MapReader, holds_map, stray_maps
from jaxmap.report.detail import FOLDER
from jaxmap.report.pictures import colourise_disparity, overlay_labels
from jaxmap.runs.config import CHOSEN_ANEW, OBSERVATIONS
from jaxmap.stereo.front_end import RectifiedFrame

_PICTURE_NAME = re.compile(r"\d{6}_(left|disparity|labels)\.(png|webp)")
_SMALL_PX = 640
"""Width of the pictures of most key frames: a page holds two dozen of them."""


class RunFolder:
    """Paths and bookkeeping of one run folder."""

    def __init__(self, path: Path) -> None:
        """Names the files; nothing is read or written yet."""
        self.path = path
        self.map = path / "map.zarr"
        self.observations = path / OBSERVATIONS
        self.metrics = path / "metrics.json"
        self.config = path / "config.yaml"
        self.poses = path / "poses.tum"
        self.frames = path / "frames.csv"
        self.scores = path / "scores.json"
        self.errors = path / "errors.png"
        self.pose_scores = path / "pose_scores.json"
        self.pictures = path / "pictures"
        self.profile = path / "profile"
        self.parts = path / ".parts"
        self._replacement = Replacement(path, self._outputs)

    def locked(self) -> AbstractContextManager[None]:
        """Keeps other runs out of the folder, see `output_folder.locked`."""
        return locked(self.path)

    @contextmanager
    def writing(
        self, settings: Mapping[str, Any], *, resume: bool | None, overwrite: bool, update: bool = False
    ) -> Iterator[RunFolder]:
        """Begins a run and yields the folder it is to write into, see `begin` and `begin_update`.

        A run that is replaced stays until the block has ended without an error.
        """
        work = self.begin_update(settings) if update else self.begin(settings, resume=resume, overwrite=overwrite)
        if work is self:
            yield self
            return
        with self._replacement.written(keep=lambda: holds_map(work.map) or work.parts.exists()):
            yield work

    def begin(self, settings: Mapping[str, Any], *, resume: bool | None, overwrite: bool) -> RunFolder:
        """Writes the resolved settings (`Plan.settings`), or checks that the run here can be resumed with them.

        Args:
            settings: as plain values.
            resume: go on with what is there; None for work that cannot be resumed.
            overwrite: replace what is there.

        Returns:
            Where to write: here, or where a run is replaced, a folder within.

        Raises:
            JaxmapError: the folder holds a run already, or files of the same names that are no run's.
            UsageError: the run to be resumed had other settings.
        """
        self.settle()
        replacing = RunFolder(self._replacement.new)
        # A run that has failed before its first save has left nothing to lose.
        kept = (self.metrics, self.observations, self.parts)
        used = holds_map(self.map) or any(path.exists() for path in kept)
        if resume and (replacing.config.exists() or used):
            work = replacing if replacing.config.exists() else self
            check_same_settings(work.config, dict(settings))
            return work
        if not overwrite and (used or holds_map(replacing.map) or replacing.parts.exists()):
            going_on = "" if resume is None else "resume it (--resume), "
            raise JaxmapError(
                "the folder holds a run already",
                where=self.path,
                fix=f"{going_on}replace it (--overwrite), or choose another folder",
            )
        self._check_own()
        self._replacement.discard()
        if not used:
            self._clear()
        work = replacing if used else self
        write_yaml(work.config, dict(settings))
        return work

    def begin_update(self, settings: Mapping[str, Any]) -> RunFolder:
        """Writes the resolved settings of a run that replaces the one here, and differs from it in frames and poses.

        Returns:
            Where to write: a folder within, with the parts that an interrupted update has left there.

        Raises:
            UsageError: there is no run here, or it had other settings.
        """
        self.settle()
        if not holds_map(self.map):
            raise UsageError(
                "there is no run to bring up to date", where=self.path, fix="map into it without --update first"
            )
        check_same_settings(self.config, dict(settings), CHOSEN_ANEW)
        work = RunFolder(self._replacement.new)
        for path in work.path.iterdir() if work.path.exists() else ():
            if path != work.parts:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        write_yaml(work.config, dict(settings))
        return work

    def settle(self) -> None:
        """Puts a run in place that was whole when the process that wrote it was killed; the folder must be locked."""
        self._replacement.settle()

    def settle_for_reading(self) -> None:
        """`settle`, where no other process writes here."""
        self._replacement.settle_for_reading()

    @property
    def _files(self) -> tuple[Path, ...]:
        pages = (self.path / "report.html", self.path / "explain.html")
        # Scores are of the map that is there: they go with it.
        scored = (self.scores, self.errors, self.pose_scores)
        derived = [self.path / file for form in FORMATS.values() for file in form.files]
        return (*derived, self.metrics, self.poses, self.frames, *pages, self.config, *scored)

    def check_apart(self, source: str, images: Iterable[Path], inputs: Iterable[Path | None]) -> None:
        """Refuses to write where the inputs lie; to be called before anything is made.

        Args:
            source: the sequence.
            images: its images; the run folder may not lie in their folders.
            inputs: other files that are read, such as poses.

        Raises:
            UsageError: the folder is the sequence's own, or an output would overwrite an input.
        """
        here, read = real_path(self.path), real_path(source)
        folders = {real_path(folder) for folder in {image.parent for image in images}}
        own = here == read or (read.name == OBSERVATIONS and here == read.parent)
        if own or not folders.isdisjoint((here, *here.parents)):
            raise UsageError("the run folder is the sequence's own", where=self.path, fix="choose another --out")
        check_inputs_stay(self._files, inputs)

    def _is_run(self) -> bool:
        """Whether what lies here was written by a run."""
        if holds_map(self.map):
            return True
        try:
            return read_text(self.config).startswith("sequence:")
        except JaxmapError:
            return False

    def _check_own(self) -> None:
        """Checks that the files to be replaced are a run's.

        Raises:
            JaxmapError: they are not.
        """
        foreign = [] if self._is_run() else [file.name for file in self._files if file.exists()]
        if foreign:
            raise JaxmapError(
                f"{', '.join(foreign)} would be replaced, but no run has written them",
                where=self.path,
                fix="choose another --out",
            )

    def _outputs(self) -> Iterator[Path]:
        """What an earlier run has written, and nothing else."""
        derived = (self.parts, self.profile, self.path / FOLDER)
        yield from (self.map, *stray_maps(self.map), self.observations, *derived, *self._files)
        for picture in self.pictures.glob("*"):
            if _PICTURE_NAME.fullmatch(picture.name):
                yield picture

    def _clear(self) -> None:
        if self._is_run():
            for path in [*self._outputs()]:
                shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def write_poses(
    folder: RunFolder,
    timestamps_s: Float[np.ndarray, "N"],
    T_world_camera: Float[np.ndarray, "N 4 4"],
    site_origin: Float[np.ndarray, "3"],
) -> None:
    """Writes the poses of the fused frames, absolute (site origin added), in the z-up world."""
    absolute = np.array(T_world_camera, np.float64)
    absolute[:, :3, 3] += site_origin
    write_tum(folder.poses, timestamps_s, absolute)


def write_key_frame(
    folder: RunFolder,
    index: int,
    rectified: RectifiedFrame,
    labels: np.ndarray | None,
    classes: tuple[str, ...],
    *,
    large: bool,
) -> None:
    """Writes the pictures of one frame: left image, disparity and, where there are any, labels.

    Large ones are PNG of the image's own size, others small WebP.
    """
    import cv2
    from PIL import Image

    assert rectified.disparity_px is not None
    pictures = {"left": rectified.left, "disparity": colourise_disparity(rectified.disparity_px)}
    if labels is not None:
        pictures["labels"] = overlay_labels(rectified.left, labels, classes)
    # Noise does not compress: more effort takes twice to four times as long and saves little.
    ending, effort = ("png", dict(compress_level=1)) if large else ("webp", dict(quality=80, method=2))
    for kind, picture in pictures.items():
        height, width = picture.shape[:2]
        shrink = _SMALL_PX / max(height, width)
        if not large and shrink < 1:
            size = max(round(shrink * width), 1), max(round(shrink * height), 1)
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        with atomic_path(folder.pictures / f"{index:06d}_{kind}.{ending}") as temporary:
            Image.fromarray(picture).save(temporary, **effort)


def count_voxels(reader: MapReader, params: FusionParams, rule: FusionRule) -> dict[str, Any]:
    """How many voxels were observed, are occupied or free, and have each class."""
    seen = solid = 0
    by_class = np.zeros(256, np.int64)
    for voxel_map, own, _ in reader.blocks(kernel_margin(params.class_kernel)):
        seen += int(observed(voxel_map)[own].sum())
        solid += int(occupied(voxel_map, params)[own].sum())
        by_class += np.bincount(np.asarray(voxel_labels(voxel_map, params, rule))[own].ravel(), minlength=256)
    named = {name: int(by_class[index]) for index, name in enumerate(reader.classes)}
    return {"observed": seen, "occupied": solid, "free": seen - solid, "by_class": named}


def count_missed(rule: FusionRule, reader: MapReader, members: int) -> dict[str, Any]:
    """What the ensemble expects the map to have missed; nothing where there is no ensemble."""
    target = rule.target(reader.classes)
    layers = stored_layers(reader.layers(reader.whole), target, "map") if members else None
    if layers is None:
        return {}
    missed = np.asarray(layers.missed, np.float64)
    column_m2 = float(np.prod(np.asarray(reader.grid.voxel_size_m, np.float64)[:2]))
    return {
        "ensemble": {
            "class": target,
            "members": members,
            "missed_area_expected_m2": round(float(np.nansum(missed)) * column_m2, 4),
            "called_area_m2": round(int(layers.called().sum()) * column_m2, 4),
            "observed_area_m2": round(int(np.isfinite(missed).sum()) * column_m2, 4),
            "greatest_missed_probability": round(float(np.nanmax(missed, initial=0.0)), 4),
        }
    }
