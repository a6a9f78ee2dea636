"""Tunes fusion on some traverses and scores it on others: what the numbers are worth where they were not tuned.

    python scripts/experiments/tune_fusion.py --tune TRAVERSE... --score TRAVERSE... [--labels true] [--kernel 5]

A TRAVERSE is a folder in the simulator's layout. For each source of labels, fusion is tuned by `jaxmap tune` on the
first ones; then all are mapped under the default rule and under the tuned numbers. Prints one table: the scores of
`jaxmap evaluate` in cells of 0.2 m within 8 m, and the mean IoU on 16 lattices of cells.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import LABELS, Frames, Table, Traverse, command_line, parse

from jaxmap.runs.config import MapConfig, load_config
from jaxmap.runs.evaluation import TruthOptions
from jaxmap.runs.tuning import Source, TuningRun
from jaxmap.tuning.options import TuneOptions

SCORES = ("iou", "precision", "recall", "nll", "ece")


def tuned(labels: str, given: Namespace, kernel: int) -> MapConfig:
    """What `jaxmap tune` makes of the traverses to tune on."""
    out = given.out / f"{labels}{'_kernel' * bool(kernel)}.yaml"
    traverses = [Traverse(path) for path in given.tune]
    configs = [traverse.config(labels) for traverse in traverses]
    sources = [
        Source(traverse.sequence, traverse.truth, labels=config.labels)
        for traverse, config in zip(traverses, configs, strict=True)
    ]
    run = TuningRun(sources, configs[0], TruthOptions(), TuneOptions(kernel=kernel), out, notify=lambda line: None)
    run.cache(lambda done: None)
    run.tune(lambda step, note: None)
    return load_config(str(out))


def main() -> None:
    """Tunes, maps, scores, prints."""
    parser = command_line(__doc__)
    parser.add_argument("--tune", nargs="+", type=Path, required=True, help="traverses to tune on")
    parser.add_argument("--score", nargs="+", type=Path, required=True, help="traverses that tuning never sees")
    parser.add_argument("--labels", nargs="+", choices=LABELS, default=list(LABELS))
    parser.add_argument("--out", type=Path, default=Path("tuned"), help="folder for the configurations")
    parser.add_argument("--kernel", type=int, default=0, help="size of the learned kernel; tuned beside the rest")
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parse(parser)
    columns = {"labels": "<9", "traverse": "<14", "": "<10", "rule": "<13", **dict.fromkeys(SCORES, "10.3f")}
    table = Table({**columns, "mean IoU": "10.3f", "cells": "7d", "rock": "6d"})
    for labels in given.labels:
        configs = {"default": None, "tuned": tuned(labels, given, 0)}
        if given.kernel:
            configs["with kernel"] = tuned(labels, given, given.kernel)
        for path in dict.fromkeys([*given.tune, *given.score]):
            traverse, base = Traverse(path), Traverse(path).config(labels)
            frames = Frames(traverse.sequence, traverse.truth)
            for rule, config in configs.items():
                config = base if config is None else replace(config, labels=base.labels, labels_are=base.labels_are)
                result = frames.scored(config)
                numbers = [result.scores[name] or 0.0 for name in SCORES]
                counts = (result.scores["cells"], result.scores["rock_cells"])
                seen = "tuned on" if path in given.tune else ""
                table.row(labels, traverse.name, seen, rule, *numbers, float(np.mean(result.lattice_ious())), *counts)
    table.write(given.json)


if __name__ == "__main__":
    main()
