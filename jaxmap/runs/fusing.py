"""Mapping observations region by region, on workers: `jaxmap map OBS --workers`, `--scheduler` and `--update`.

Workers share nothing but files. Each plans the run for itself, once, and writes the tiles of a region as a part of the
map, whole and under a name that tells what they are made of; when all are there, the map is put together. So a task
that is lost or done twice, or a run that is killed, changes nothing but the time that it takes.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import socket
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.geometry.bounds import view_boxes
from jaxmap.host.bounded_text import parse_json
from jaxmap.host.cache import keep_compiled_programs
from jaxmap.host.executors import Workers, run_tasks
from jaxmap.mapping.parts import (
    KeptTiles,
    TileFiles,
    TileRecord,
    assemble_map,
    kept_tiles,
    part_name,
    part_tiles,
    read_record,
    read_told,
    write_part,
)
from jaxmap.mapping.regions import Region, Shape, frames_of_tiles, fuse_region, regions_of, tile_sources
from jaxmap.mapping.sequence import PreparedFrame
from jaxmap.mapping.step import StepReport
from jaxmap.mapping.tile_arrays import Tile
from jaxmap.report.run_page import write_report
from jaxmap.runs.config import CHOSEN_ANEW, MapConfig, absolute_tree, check_config
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.hazard_layers import add_hazards
from jaxmap.runs.labelling import Notify
from jaxmap.runs.log import FrameNumbers, RunLog, numbers_of
from jaxmap.runs.map_in_progress import map_attributes
from jaxmap.runs.mapping import Pictures, write_outputs
from jaxmap.runs.mapping_plan import Plan, Sharing, plan_run
from jaxmap.runs.metrics import notes
from jaxmap.runs.perceiving import run_perception
from jaxmap.runs.perceiving_shared import check_shareable, keep_on_workers
from jaxmap.types import to_device

ON_A_CLUSTER = 16
"""So many workers a map is shared out among where their number is not known. The map is the same for any number."""

_FILES = ("poses", "calibration", "model", "labels")
_ONE_AT_A_TIME = threading.Lock()
_plans: dict[str, Plan] = {}


class Steps(Protocol):
    """Shows progress: `Console.steps`."""

    def __call__(self, title: str, unit: str, total: int) -> AbstractContextManager[Callable[[int], object]]:
        """Yields a function to call with the number done."""
        ...


@dataclass(frozen=True)
class FuseTask:
    """A region to be fused; plain values.

    Attributes:
        run: JSON of what a worker plans the run from.
        digest: of the frames, their poses and the camera (`Plan.digest`).
        place: the part to write.
        first: voxel of the lattice where the region begins.
        tiles: to be written.
        frames: indices of the frames that touch them.
        numbers: how many frames of the run are fused before each.
    """

    run: str
    digest: str
    place: str
    first: Shape
    tiles: tuple[Tile, ...]
    frames: tuple[int, ...]
    numbers: tuple[int, ...]


def share(config: MapConfig, workers: Workers) -> Sharing:
    """How a map is shared out among workers; processes of one machine share its memory."""
    if workers.scheduler is not None:
        return Sharing(ON_A_CLUSTER, config.grid.max_memory_gib)
    return Sharing(workers.processes, config.grid.max_memory_gib / workers.processes)


def fuse_task(task: FuseTask) -> dict[int, str]:
    """Fuses a region and writes its part, on a worker.

    Returns:
        The frames that cannot be read, with the reason; then nothing was written.

    Raises:
        JaxmapError: this worker sees other observations, or the disk refuses.
    """
    # Threads of one worker would take the memory of several.
    with _ONE_AT_A_TIME:
        plan = _planned(task.run)
        if plan.digest(len(plan.sequence.frames)) != task.digest:
            raise JaxmapError(
                "a worker sees other frames or poses than the process that gives the tasks",
                where=socket.gethostname(),
                fix="let all machines see the same files under the same paths, with the same jaxmap",
            )
        told: dict[str, FrameNumbers] = {}

        def note(prepared: PreparedFrame, report: StepReport) -> None:
            told[prepared.ref.name] = numbers_of(prepared, report)

        assert plan.block_shape is not None
        grid = replace(plan.grid, first=to_device(np.array(task.first), np.int32), shape=plan.block_shape)
        numbers = dict(zip(task.frames, task.numbers, strict=True))
        frames = plan.prepare(task.frames)
        voxel_map, faults = fuse_region(
            plan.mapper, plan.labeller.classes, grid, frames, numbers, plan.params, plan.key, note
        )
        if not faults:
            write_part(Path(task.place), voxel_map, task.tiles, {"frames": told})
        return {index: str(fault) for index, fault in faults.items()}


def map_observations(
    source: str,
    config: MapConfig,
    folder: RunFolder,
    workers: Workers,
    notify: Notify,
    steps: Steps,
    *,
    resume: bool = False,
    overwrite: bool = False,
    update: bool = False,
) -> dict[str, Any]:
    """Maps observations on workers: from their plan to the outputs.

    Args:
        source: the observations.
        config: the settings.
        folder: the run folder.
        workers: where the tasks run.
        notify: takes lines for the user.
        steps: shows progress.
        resume: go on with a run that was interrupted.
        overwrite: replace the run that is there.
        update: replace it, but for the tiles that are the same.

    Returns:
        The metrics, as they are in metrics.json.

    Raises:
        JaxmapError: as `plan_run`, `RunFolder.writing` and `run_shared`.
    """
    plan = plan_run(source, config, notify, shared=share(config, workers))
    folder.check_apart(plan.source, plan.images, (config.poses, config.calibration, config.model))
    with (
        folder.locked(),
        folder.writing(plan.settings(config), resume=resume, overwrite=overwrite, update=update) as work,
    ):
        old = folder.map if update else work.map if work.map.exists() else None
        return run_shared(plan, config, work, workers=workers, old=old, notify=notify, steps=steps)


def map_on_workers(
    source: str,
    config: MapConfig,
    folder: RunFolder,
    workers: Workers,
    notify: Notify,
    steps: Steps,
    *,
    resume: bool = False,
    overwrite: bool = False,
    keep: bool = False,
) -> dict[str, Any]:
    """Maps a sequence on workers: they perceive its frames, then they fuse what was perceived.

    The arguments and what is returned are those of `map_observations`, but that `source` is a sequence; with `keep`,
    the observations stay in the folder.

    Raises:
        JaxmapError: as `map_observations`, and as `run_perception`.
    """
    check_shareable(config)
    perceived = plan_run(source, config, notify, keep=True, in_tiles=True)
    keeper = perceived.keeper
    assert keeper is not None
    folder.check_apart(perceived.source, perceived.images, (config.poses, config.calibration, config.model))
    settings = perceived.settings(config) | {"keep_observations": keep}
    with folder.locked(), folder.writing(settings, resume=resume, overwrite=overwrite) as work:
        with steps("perceiving", "frames", len(perceived.sequence.frames)) as advance:
            on_workers = partial(keep_on_workers, keeper, config, work, workers=workers, notify=notify)
            run_perception(keeper, work, strict=config.strict, notify=notify, on_frame=advance, keep=on_workers)
        # What chooses frames and poses has done so.
        usual = MapConfig()
        of_kept = replace(config, **{name: getattr(usual, name) for name in CHOSEN_ANEW if name != "strict"})
        plan = plan_run(str(work.observations), of_kept, lambda line: None, shared=share(config, workers))
        old = work.map if work.map.exists() else None
        metrics = run_shared(plan, of_kept, work, workers=workers, old=old, notify=notify, steps=steps)
        if not keep:
            shutil.rmtree(work.observations, ignore_errors=True)
        return metrics


def run_shared(
    plan: Plan,
    config: MapConfig,
    folder: RunFolder,
    *,
    workers: Workers,
    old: Path | None,
    notify: Notify,
    steps: Steps,
    report: bool = True,
) -> dict[str, Any]:
    """Maps observations on workers and writes all outputs.

    Args:
        plan: the run, planned to be shared (`share`).
        config: its settings.
        folder: where it goes; `RunFolder.begin` or `begin_update` was called. What an interrupted run has left is used.
        workers: where the tasks run.
        old: a map of which the tiles stay that are made of the same frames at the same poses.
        notify: takes lines for the user.
        steps: shows progress.
        report: write the page of the run.

    Returns:
        The metrics, as they are in metrics.json.

    Raises:
        FrameError: a frame cannot be used, and the settings are strict.
        JaxmapError: no frame can be fused, workers are lost again and again, or an output cannot be written.
    """
    started_s = time.perf_counter()
    work = _Work(plan, config, folder.parts, old, notify)
    while faults := _fuse_left(work, workers, steps, notify):
        work.leave_out(faults)
    _write_pictures(plan, folder, work.numbers)
    log = work.log()
    log.total_s = time.perf_counter() - started_s
    record = TileRecord(work.digest, work.sources, set(), {name: list(told) for name, told in work.told.items()})
    attributes = map_attributes(plan, log)
    told = (plan.grid, plan.labeller.classes, log.fused, attributes)
    assemble_map(folder.map, *told, work.files(), record, surface=plan.rule.surface)
    where = workers.processes if workers.scheduler is None else workers.scheduler
    details = {"shared": {"workers": where, **work.counts}}
    metrics = write_outputs(plan, folder, log, add_hazards(folder.map, plan.rover), details)
    shutil.rmtree(folder.parts, ignore_errors=True)
    if report:
        write_report(folder.path)
    for note in notes(plan, log, metrics):
        notify(f"note: {note}")
    return metrics


class _Work:
    """What is to be done of a map, and what is there.

    Attributes:
        numbers: of each frame that can be used, how many are fused before it.
        sources: what each tile is made of.
        told: what is known of each frame, by name.
    """

    def __init__(self, plan: Plan, config: MapConfig, parts: Path, old: Path | None, notify: Notify) -> None:
        assert plan.observations is not None and plan.block_shape is not None
        self.plan, self.parts, self.old, self.notify = plan, parts, old, notify
        self.strict = config.strict
        self.digest = _digest(plan, config)
        self.run = _told_to_workers(plan, config)
        _plans.clear()
        _plans[self.run] = plan
        self.poses = plan.sequence.T_world_camera @ plan.front_end.T_raw_rectified
        boxes = view_boxes(plan.grid, plan.front_end.camera, self.poses, plan.depth_range_m[1])
        self.all_touching = frames_of_tiles(plan.grid, boxes)
        self.skipped: dict[int, str] = {}
        self.told: dict[str, FrameNumbers] = {}
        self.record = None if old is None or not old.exists() else read_record(old)
        if old is not None and (self.record is None or self.record.digest != self.digest):
            self.record = None
            notify("the map that is there does not tell what its tiles are made of: all of them are fused")
        self.leave_out({})

    def leave_out(self, faults: dict[int, str]) -> None:
        """Plans the map without some frames."""
        plan = self.plan
        self.skipped |= faults
        names = [ref.name for ref in plan.sequence.frames]
        used = [index for index in range(len(names)) if index not in self.skipped]
        if not used:
            first = self.skipped[min(self.skipped)]
            raise JaxmapError(f"none of {len(names)} frames could be fused; the first: {first}")
        self.numbers = {index: number for number, index in enumerate(used)}
        left = {
            tile: [index for index in frames if index not in self.skipped] for tile, frames in self.all_touching.items()
        }
        touching = {tile: frames for tile, frames in left.items() if frames}
        counted = [self.numbers.get(index, 0) for index in range(len(names))] if plan.labeller.draws else None
        self.sources = tile_sources(touching, names, self.poses, counted)
        self.kept = KeptTiles({}, set(), {})
        if self.record is not None and self.old is not None:
            self.kept = kept_tiles(self.old, self.record, self.sources, plan.grid, surface=plan.rule.surface)
            of_old = {name: FrameNumbers(*told) for name, told in self.record.frames.items()}
            self.told = of_old | self.told
        for tile, reason in self.kept.lost.items():
            count = len(touching[tile])
            self.notify(f"tile {' '.join(map(str, tile))} of the map {reason}: its {count} frames are fused again")
        assert plan.block_shape is not None
        to_fuse = {tile: frames for tile, frames in touching.items() if tile not in self.kept.done}
        self.regions = regions_of(plan.grid, plan.block_shape, to_fuse)
        self.counts = {
            "tiles": len(touching),
            "tiles_fused": len(to_fuse),
            "regions": len(self.regions),
            "frames_fused": len({index for region in self.regions for index in region.frames}),
            "steps": sum(len(region.frames) for region in self.regions),
        }

    def part_of(self, region: Region) -> Path:
        """Where the tiles of a region are, or will be."""
        return self.parts / part_name(self.digest, {tile: self.sources[tile] for tile in region.tiles})

    def tasks(self) -> list[FuseTask]:
        """What is left to do."""
        digest = self.plan.digest(len(self.plan.sequence.frames))
        return [
            FuseTask(
                self.run,
                digest,
                os.path.abspath(place),
                region.first,
                region.tiles,
                region.frames,
                tuple(self.numbers[index] for index in region.frames),
            )
            for region in self.regions
            if not (place := self.part_of(region)).exists()
        ]

    def files(self) -> TileFiles:
        """The files of all tiles, once all are there."""
        files = dict(self.kept.files)
        for region in self.regions:
            files |= part_tiles(self.part_of(region))
        return files

    def log(self) -> RunLog:
        """The log of the run, as if it had been one."""
        for region in self.regions:
            frames = read_told(self.part_of(region))["frames"]
            self.told |= {name: FrameNumbers(*told) for name, told in frames.items()}
        refs = self.plan.sequence.frames
        log = RunLog(next_index=len(refs), fused=len(self.numbers), complete=True)
        log.skipped = [{"frame": refs[index].name, "reason": reason} for index, reason in sorted(self.skipped.items())]
        used = [refs[index].name for index in self.numbers]
        self.told = {name: self.told[name] for name in used if name in self.told}
        for told in self.told.values():
            log.count(told)
        return log


def _fuse_left(work: _Work, workers: Workers, steps: Steps, notify: Notify) -> dict[int, str]:
    """Fuses the regions that are not there yet; returns the frames that cannot be read, where there are any."""
    tasks, counts = work.tasks(), work.counts
    if counts["tiles_fused"] < counts["tiles"] or len(tasks) < len(work.regions):
        notify(f"{len(tasks)} of {len(work.regions)} regions are left to fuse, of {counts['tiles_fused']} tiles in all")
    total, done = sum(len(task.frames) for task in tasks), 0
    faults: dict[int, str] = {}
    with steps("fusing", "frames", total) as advance:
        for task, unread in run_tasks(workers, fuse_task, tasks, notify):
            if unread and work.strict:
                raise JaxmapError(next(iter(unread.values())))
            faults |= unread
            done += len(task.frames)
            advance(done)
    return faults


def _write_pictures(plan: Plan, folder: RunFolder, numbers: dict[int, int]) -> None:
    """Writes the pictures of the key frames, with the labels that the steps of the workers gave them."""
    pictures = Pictures(plan, folder)
    for prepared in plan.prepare(sorted(plan.key_frames.keys() & numbers.keys())):
        if prepared.frame is not None:
            labels = None
            if plan.labeller.classes:
                number = numbers[prepared.index]
                labels = np.asarray(plan.mapper.label_image(prepared.frame, plan.params, plan.key, number))
            pictures.waiting.append((prepared, labels))
            pictures.write()


def _digest(plan: Plan, config: MapConfig) -> str:
    """A fingerprint of all that decides what a tile comes out as but its frames and their poses."""
    assert plan.observations is not None
    # Bounds and memory decide which tiles there are, not what they hold; their voxels are compared apart.
    free = ("sequence", "grid", "rover", *CHOSEN_ANEW, *_FILES)
    settings = {name: value for name, value in plan.settings(config).items() if name not in free}
    told = [settings, plan.observations.attributes.digest(), plan.depth_range_m, plan.fusion, plan.labeller.classes]
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:32]


def _told_to_workers(plan: Plan, config: MapConfig) -> str:
    """What a worker plans the run from, wherever it runs."""
    settings = absolute_tree(config)
    return json.dumps({"source": os.path.abspath(plan.source), "settings": settings, "shape": plan.block_shape})


def _planned(run: str) -> Plan:
    """The plan of a run, made once on each worker."""
    if run not in _plans:
        keep_compiled_programs()
        tree = parse_json(run, "the task of a worker")
        config = check_config(tree["settings"], "the task of a worker")
        _plans.clear()
        _plans[run] = plan_run(tree["source"], config, lambda line: None, shared=tuple(tree["shape"]))
    return _plans[run]
