"""What keeping observations costs, whether it moves a map, and how much faster they are fused than images are mapped.

    python scripts/experiments/observations.py [TRAVERSE...] [--frames 6] [--voxels 0.1 0.1 0.1]

Traverses are `sample:traverse` (the default) and folders that hold Part1 and gt. Each is perceived into a folder of its
own, then mapped from its images and from what was kept. The table says what a frame takes on disk; the share of voxels
seen that have the same label in both maps, and by how much accuracy and IoU of rock differ; the frames a second of
both, their ratio, and the processor time of a frame of both; and what a frame takes to be read and unpacked (in one
thread) and to be fused (the step). Times leave compiling out.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from common import Scored, Table, Traverse, command_line, parse

from jaxmap.fusion.query import observed, voxel_labels
from jaxmap.mapping.step import compile_step
from jaxmap.runs.config import MapConfig, config_of_observations
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.mapping_plan import Plan, plan_run
from jaxmap.runs.perceiving import make_keeper, run_perception
from jaxmap.runs.perception import plan_perception
from jaxmap.types import VoxelMap


def silent(line: str) -> None:
    """Tells nobody."""


class Timed:
    """A map, and the rate at which its frames came."""

    def __init__(self, plan: Plan, laps: int) -> None:
        self.plan = plan
        empty = plan.mapper.init()
        mapper, _ = compile_step(plan.mapper, empty, plan.frame_form, plan.params, plan.key)
        steps_s, count, first, started_s, used_s = [], 0, None, time.perf_counter(), time.process_time()
        for _ in range(laps):
            voxel_map = mapper.init()
            for prepared in plan.prepare():
                assert prepared.frame is not None, prepared.fault
                began_s = time.perf_counter()
                voxel_map, _ = mapper.step(voxel_map, prepared.frame, plan.params, plan.key)
                jax.block_until_ready(voxel_map.log_odds)
                steps_s.append(time.perf_counter() - began_s)
                count += 1
            first = voxel_map
        self.frames_per_s = count / (time.perf_counter() - started_s)
        self.processor_ms = 1e3 * (time.process_time() - used_s) / count
        self.step_ms = 1e3 * float(np.median(steps_s))
        assert first is not None
        self.voxel_map: VoxelMap = first


def read_ms(plan: Plan) -> float:
    """What reading and unpacking a frame takes in one thread, median."""
    assert plan.observations is not None
    times_s = []
    for index in range(len(plan.sequence.frames)):
        started_s = time.perf_counter()
        jax.block_until_ready(plan.observations.read(index))
        times_s.append(time.perf_counter() - started_s)
    return 1e3 * float(np.median(times_s))


def same_labels(one: Timed, other: Timed) -> float:
    """The share of the voxels that either map has observed and that have the same label in both."""
    labels = [
        np.asarray(voxel_labels(map_.voxel_map, map_.plan.params.fusion, map_.plan.rule)) for map_ in (one, other)
    ]
    seen = np.asarray(observed(one.voxel_map)) | np.asarray(observed(other.voxel_map))
    return float((labels[0] == labels[1])[seen].mean())


def scores(timed: Timed, truth: Path) -> np.ndarray:
    """Accuracy and IoU of rock."""
    found = Scored(timed.plan, timed.voxel_map, truth).scores
    return np.array([found["accuracy"], found["iou"]], np.float64)


def main() -> None:
    """Perceives, maps twice, compares, prints."""
    parser = command_line(__doc__)
    parser.add_argument("traverses", nargs="*", default=["sample:traverse"])
    parser.add_argument("--frames", type=int, help="only the first ones")
    parser.add_argument("--laps", type=int, default=3, help="times that observations are fused for the rate")
    parser.add_argument("--voxels", type=float, nargs=3, help="edges in metres; by default those of jaxmap map")
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parse(parser)
    columns = {"traverse": "<16", "frames": "6d", "MB/frame": "9.3f", "same": "9.5f", "accuracy": "9.4f", "IoU": "8.4f"}
    columns |= {"images/s": "9.2f", "kept/s": "8.2f", "ratio": "7.1f"}
    columns |= {"cpu ms": "8.1f", "kept cpu": "9.1f", "read ms": "8.1f", "step ms": "8.1f"}
    table = Table(columns)
    for name in given.traverses:
        traverse = Traverse(name)
        config = MapConfig(stop=given.frames)
        if given.voxels:
            config = replace(config, grid=replace(config.grid, voxel_size_m=tuple(given.voxels)))
        with tempfile.TemporaryDirectory() as place:
            folder = RunFolder(Path(place))
            seen = plan_perception(traverse.sequence, config, silent)
            told = run_perception(make_keeper(seen, config, 0.5), folder, strict=True, notify=silent)
            direct = Timed(plan_run(traverse.sequence, config, silent), 1)
            of_kept = replace(config_of_observations(folder.observations, None), grid=config.grid)
            fused = Timed(plan_run(str(folder.path), of_kept, silent), given.laps)
            moved = np.abs(scores(fused, traverse.truth) - scores(direct, traverse.truth))
            rates = (direct.frames_per_s, fused.frames_per_s, fused.frames_per_s / direct.frames_per_s)
            kept_mb = told["bytes_per_frame"] / 1e6
            frames = len(fused.plan.sequence.frames)
            times = (direct.processor_ms, fused.processor_ms, read_ms(fused.plan), fused.step_ms)
            table.row(traverse.name, frames, kept_mb, same_labels(fused, direct), *moved.tolist(), *rates, *times)
    table.write(given.json)


if __name__ == "__main__":
    main()
