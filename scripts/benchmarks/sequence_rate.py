"""How near `jaxmap map` comes to the rate of its matcher alone, and what each stage of a frame costs the processors.

    python scripts/benchmarks/sequence_rate.py [SEQUENCE] [--frames 28] [--rounds 5] [--config F] [--labeller deeplab]
        [--matcher sgm] [--narrow] [--json F]

By default the bundled traverse (14 pairs of 1024 x 768 pixels, raw), its images written anew as PNG. In each round
OpenCV's SGBM in its 3WAY mode goes over the rectified pairs in grey, as many disparities and no more, and then the
frames are mapped as `jaxmap map` does it, from the files into the map, its step compiled before. Where other programs
share the cores, only the ratio of the two and the processors' time count; each stage is also timed alone, with nothing
beside it.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import jax
import numpy as np
from harness import limit_threads

from jaxmap.host.memory import restart_with_lasting_memory

STAGED_FRAMES = 5
"""Frames whose stages are timed one by one."""


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", nargs="?", help="a folder; by default the bundled traverse as PNG")
    parser.add_argument("--frames", type=int, default=28, help="mapped in a round; those of the sequence in turn")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--config", help="YAML file, or the name of a bundled one")
    parser.add_argument("--labeller", choices=["none", "plane", "relief", "deeplab"])
    parser.add_argument("--matcher", choices=["opencv", "sgm", "mccnn"])
    parser.add_argument("--narrow", action="store_true", help="match in bands")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    restart_with_lasting_memory()
    limit_threads(given.threads)
    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.runs.config import MapConfig, load_config
    from jaxmap.runs.mapping_plan import plan_run

    keep_compiled_programs(scopes=True)
    config = load_config(given.config) if given.config else MapConfig()
    if given.labeller:
        config = replace(config, labeller=given.labeller)
    if given.matcher:
        config = replace(config, stereo=replace(config.stereo, matcher=given.matcher))
    if given.narrow:
        config = replace(config, stereo=replace(config.stereo, narrow=True))
    with tempfile.TemporaryDirectory() as folder:
        source = given.sequence or str(bundled_as_png(Path(folder, "traverse")))
        run = Run(plan_run(source, config, print, match_in_step=True), Path(folder))
        run.map(4)
        figures: dict[str, Any] = {"device": jax.devices()[0].device_kind, "stages": run.stages()}
        rounds = [(run.match(given.frames), run.map(given.frames)) for _ in range(given.rounds)]
    figures |= rates(rounds, given.frames) | {"load": round(os.getloadavg()[0], 1)}
    print_figures(figures)
    if given.json:
        given.json.write_text(json.dumps(figures, indent=2) + "\n")


def bundled_as_png(folder: Path) -> Path:
    """The bundled traverse with its images as PNG of the usual level, which is what rovers' logs hold."""
    from PIL import Image

    from jaxmap.datasets.images import read_image
    from jaxmap.host.files import bundled

    shutil.copytree(bundled("traverse"), folder)
    for image in sorted(folder.glob("Part1/LocCam/*.jpg")):
        Image.fromarray(read_image(image)).save(image.with_suffix(".png"))
        image.unlink()
    return folder / "Part1"


class Spent(dict[str, list[tuple[float, float]]]):
    """Seconds on the clock and of the processors, by stage."""

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Times a block; what it has started elsewhere counts as far as it has ended by then."""
        started_s, used_s = time.perf_counter(), time.process_time()
        yield
        self.setdefault(name, []).append((time.perf_counter() - started_s, time.process_time() - used_s))


class Run:
    """A sequence that is mapped, or only matched, again and again."""

    def __init__(self, plan: Any, folder: Path) -> None:
        from jaxmap.mapping.step import compile_step
        from jaxmap.stereo.match import as_grey

        self.plan, self.folder, self.voxel_map = plan, folder, plan.mapper.init()
        self.mapper, self.cost = compile_step(plan.mapper, self.voxel_map, plan.frame_form, plan.params, plan.key)
        self.showing = plan.mapper.step
        self.prepared = list(plan.prepare())
        self.grey = [[as_grey(image) for image in one.rectified[:2]] for one in self.prepared]
        self.sgbm = _sgbm(plan.front_end.matcher.options, *self.grey[0][0].shape)

    def indices(self, frames: int) -> list[int]:
        """So many frames, those of the sequence in turn."""
        return list(islice(cycle(range(len(self.prepared))), frames))

    def match(self, frames: int) -> tuple[float, float]:
        """Seconds on the clock and of the processors for SGBM alone."""
        spent = Spent()
        with spent.stage("all"):
            for index in self.indices(frames):
                self.sgbm.compute(*self.grey[index])
        return spent["all"][0]

    def map(self, frames: int) -> tuple[float, float]:
        """The same for mapping: reading ahead, matching, the step."""
        from jaxmap.mapping.sequence import run_sequence
        from jaxmap.runs.log import RunLog

        plan, spent, log = self.plan, Spent(), RunLog()
        with spent.stage("all"):
            run = run_sequence(self.mapper, self.voxel_map, plan.prepare(self.indices(frames)), plan.params, plan.key)
            for voxel_map, fused in run:
                self.voxel_map = voxel_map
                log.add(fused)
        return spent["all"][0]

    def stages(self) -> dict[str, dict[str, float]]:
        """Medians of each stage alone, in milliseconds: on the clock and of the processors."""
        spent = Spent()
        for index in self.indices(STAGED_FRAMES):
            self._stages_of(index, spent)
        return {name: {"ms": _median(times, 0), "processor_ms": _median(times, 1)} for name, times in spent.items()}

    def _stages_of(self, index: int, spent: Spent) -> None:
        from jaxmap.datasets.images import as_rgb
        from jaxmap.mapping.sequence import FusedFrame
        from jaxmap.runs.folder import RunFolder, write_key_frame
        from jaxmap.runs.log import RunLog
        from jaxmap.stereo.bands import search_bands
        from jaxmap.stereo.blank import blank_reason
        from jaxmap.stereo.match import as_grey
        from jaxmap.types import to_device

        plan, prepared, log = self.plan, self.prepared[index], RunLog()
        front_end, frame = plan.front_end, prepared.frame
        with spent.stage("read and decode"):
            pair = plan.sequence.read_pair(plan.sequence.frames[index])
        with spent.stage("look whether blank"):
            for image in pair:
                blank_reason(image)
        with spent.stage("rectify"):
            left, right = front_end.rectify(pair.left, as_grey(pair.right))
        with spent.stage("SGBM alone"):
            self.sgbm.compute(*self.grey[index])
        with spent.stage("match everything"):
            front_end.matcher(left, right)
        with spent.stage("small images"):
            coarse = front_end.coarse(left, right)
            if bands := prepared.rectified.bands:
                search_bands(coarse, front_end.matcher, left.shape[0])
        if bands:
            with spent.stage("match what they show"):
                front_end.matcher(left, right, bands)
        with spent.stage("hand over"):
            to_device(as_rgb(left))
            to_device(right if frame.disparity_px is None else frame.disparity_px)
        with spent.stage("step"):
            self.voxel_map, info = self.mapper.step(self.voxel_map, frame, plan.params, plan.key)
            jax.block_until_ready(self.voxel_map.log_odds)
        with spent.stage("log"):
            log.add(FusedFrame(prepared, info))
        labels = None
        if plan.labeller.classes:
            frame = replace(frame, show=to_device(True, np.bool_))
            with spent.stage("step of a key frame"):
                self.voxel_map, info = self.showing(self.voxel_map, frame, plan.params, plan.key)
                labels = np.asarray(info.labels)
        folder = RunFolder(self.folder / "run")
        folder.pictures.mkdir(parents=True, exist_ok=True)
        matched = front_end.matched(prepared.rectified)
        with spent.stage("picture of a key frame"):
            write_key_frame(folder, index, matched, labels, plan.labeller.classes, large=False)


def _sgbm(options: Any, height_px: int, width_px: int) -> Any:
    """OpenCV's matcher, of all disparities, with its own removal of speckles."""
    from jaxmap.matching.select import usual_speckle_px
    from jaxmap.stereo.match import Matcher

    sgbm = Matcher(options, width_px).engine()
    sgbm.setSpeckleWindowSize(usual_speckle_px(height_px * width_px))
    sgbm.setSpeckleRange(options.speckle_range_px)
    return sgbm


def _median(times: list[tuple[float, float]], column: int) -> float:
    return round(1e3 * statistics.median(one[column] for one in times[1:]), 2)


def rates(rounds: list[tuple[tuple[float, float], tuple[float, float]]], frames: int) -> dict[str, Any]:
    """Frames a second and processor time of both, and the medians of their ratios in each round."""
    columns: dict[str, list[float]] = defaultdict(list)
    for (matched_s, matched_used_s), (mapped_s, mapped_used_s) in rounds:
        columns["matched_per_s"].append(frames / matched_s)
        columns["mapped_per_s"].append(frames / mapped_s)
        columns["ratio"].append(matched_s / mapped_s)
        columns["matched_processor_ms"].append(1e3 * matched_used_s / frames)
        columns["mapped_processor_ms"].append(1e3 * mapped_used_s / frames)
        columns["processor_ratio"].append(matched_used_s / mapped_used_s)
    return {name: round(statistics.median(values), 3) for name, values in columns.items()}


def print_figures(figures: dict[str, Any]) -> None:
    """The table of the stages, and the rates."""
    print(f"{'each stage alone':26s}{'ms':>9s}{'processor ms':>14s}")
    for name, row in figures["stages"].items():
        print(f"{name:26s}{row['ms']:9.2f}{row['processor_ms']:14.2f}")
    for name, title in (("matched", "SGBM 3WAY alone"), ("mapped", "mapped")):
        used_ms = figures[f"{name}_processor_ms"]
        print(f"{title:26s}{figures[f'{name}_per_s']:9.2f} frames/s, the processors work {used_ms:.0f} ms for one")
    print(
        f"{figures['ratio']:.2f} of the matcher's own rate (by the time of the processors "
        f"{figures['processor_ratio']:.2f}); {figures['device']}, load {figures['load']}"
    )


if __name__ == "__main__":
    main()
