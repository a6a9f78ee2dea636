"""Tunes stereo matching through the map of some traverses, and scores it on others.

    python scripts/experiments/tune_stereo.py --tune sample:traverse --score TRAVERSE... [--labels relief] [--stop 6]

A TRAVERSE is `sample:traverse` or a folder in the simulator's layout. `jaxmap tune --through stereo` runs on the first
ones; then all are matched, with hard minima and at full size, and mapped with the numbers of before and with the tuned
ones. Prints one table: penalties, the scores of `jaxmap evaluate` in cells of 0.2 m within the range, the mean IoU on
16 lattices of cells, and the share of pixels with a disparity.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import Frames, Table, Traverse, command_line, parse

from jaxmap.geometry.options import DepthOptions, GridOptions
from jaxmap.runs.config import MapConfig, load_config
from jaxmap.runs.evaluation import TruthOptions
from jaxmap.runs.stereo_tuning import StereoTuningRun
from jaxmap.runs.tuning import Source
from jaxmap.stereo.match import StereoOptions
from jaxmap.tuning.options import DescentOptions, TuneOptions

SCORES = ("iou", "precision", "recall")


def config_of(traverse: Traverse, given: Namespace) -> MapConfig:
    """How a traverse is mapped before anything is tuned."""
    true = given.labels == "true"
    return replace(
        traverse.config("true" if true else "plane"),
        labeller="files" if true else given.labels,
        stereo=StereoOptions(matcher=given.matcher, num_disparities=given.num_disparities),
        depth=DepthOptions(max_m=given.max_m),
        grid=GridOptions(voxel_size_m=given.voxel_m),
        stop=given.stop,
        stride=given.stride,
    )


def tuned(given: Namespace) -> StereoOptions:
    """What tuning makes of the traverses to tune on."""
    traverses = [Traverse(path) for path in given.tune]
    configs = [config_of(traverse, given) for traverse in traverses]
    sources = [
        Source(traverse.sequence, traverse.truth, labels=config.labels)
        for traverse, config in zip(traverses, configs, strict=True)
    ]
    descent = DescentOptions(steps=given.steps, learning_rate=given.learning_rate)
    options = TuneOptions(descent=descent, through="stereo", smaller=given.smaller)
    out = given.out / f"{given.matcher}_{given.labels}.yaml"
    truth = TruthOptions()
    run = StereoTuningRun(sources, configs[0], truth, options, out, final=out, notify=lambda line: None)
    run.cache(lambda done: print(f"read {done} of {run.frames}", flush=True))
    run.tune(lambda step, note: print(f"step {step}: {note}", flush=True))
    return load_config(str(out)).stereo


def main() -> None:
    """Tunes, maps, scores, prints."""
    parser = command_line(__doc__)
    parser.add_argument("--tune", nargs="+", required=True, help="traverses to tune on")
    parser.add_argument("--score", nargs="*", default=[], help="traverses that tuning never sees")
    parser.add_argument("--labels", choices=("true", "relief", "plane", "deeplab"), default="relief")
    parser.add_argument("--matcher", choices=("sgm", "mccnn"), default="sgm")
    parser.add_argument("--num-disparities", type=int, help="disparities searched at full size")
    parser.add_argument("--smaller", type=int, choices=(1, 2, 4), default=2)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--learning-rate", type=float, default=0.1)
    parser.add_argument("--stop", type=int, help="frames of each traverse, from its first on")
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--max-m", type=float, default=8.0)
    parser.add_argument("--voxel-m", type=float, default=0.2)
    parser.add_argument("--out", type=Path, default=Path("tuned_stereo"), help="folder for the configurations")
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parse(parser)
    given.out.mkdir(parents=True, exist_ok=True)
    found = tuned(given)
    numbers = dict.fromkeys(("p1", "p2", "uniqueness"), "10.3f")
    columns = {"traverse": "<16", "": "<9", "stereo": "<8", **numbers, **dict.fromkeys(SCORES, "10.3f")}
    table = Table({**columns, "mean IoU": "10.3f", "matched": "9.3f", "cells": "7d", "rock": "6d"})
    for path in dict.fromkeys([*given.tune, *given.score]):
        traverse = Traverse(path)
        before = config_of(traverse, given)
        for name, config in {"before": before, "tuned": replace(before, stereo=found)}.items():
            # Each matches anew.
            frames = Frames(traverse.sequence, traverse.truth)
            result = frames.scored(config)
            ready = [one.frame.matched_px for one in frames.prepared if one.frame is not None]
            matched = float(np.mean([np.isfinite(disparity).mean() for disparity in ready]))
            params = result.plan.front_end.matcher.params  # pyright: ignore[reportAttributeAccessIssue]
            row = [float(value) for value in (params.p1, params.p2, params.uniqueness)]
            row += [result.scores[score] or 0.0 for score in SCORES]
            counts = (result.scores["cells"], result.scores["rock_cells"])
            seen = "tuned on" if path in given.tune else ""
            table.row(traverse.name, seen, name, *row, float(np.mean(result.lattice_ious())), matched, *counts)
    table.write(given.json)


if __name__ == "__main__":
    main()
