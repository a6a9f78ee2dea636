"""Tunes fusion on some traverses and scores it on others: what the numbers are worth where they were not tuned.

    python scripts/tune_fusion.py --tune TRAVERSE... --score TRAVERSE... [--labels true deeplab plane] [--kernel 5]

A traverse is a folder in the simulator's layout: `Part1` and `gt`. For each source of labels, fusion is tuned by
`jaxmap tune` on the first ones; then all are mapped by the default rule and by the tuned numbers, as `jaxmap map` does
it, and scored as `jaxmap evaluate` does: cells of 0.2 m within 8 m of a camera. Because a site of a few dozen rock
cells moves by hundredths when the lattice of cells does, the IoU is also told as the mean over 16 lattices.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from ladder import confusions, fused

from jaxmap.evaluation.evaluate import evaluate_map
from jaxmap.evaluation.map_scores import confusion_scores
from jaxmap.evaluation.options import ScoringOptions
from jaxmap.host.cache import keep_compiled_programs
from jaxmap.mapping.sequence import PreparedFrame, prepare_frames
from jaxmap.runs.config import DepthConfig, MapConfig, load_config
from jaxmap.runs.evaluation import TruthOptions, read_truth
from jaxmap.runs.mapping_plan import plan_run
from jaxmap.runs.tuning import Source, TuneOptions, TuningRun

LABELS = {"true": "files", "deeplab": "deeplab", "plane": "plane"}
CELL_M, RANGE_M = 0.2, 8.0
SCORES = ("iou", "precision", "recall", "nll", "ece")


def main() -> None:
    """Tunes, maps, scores, prints one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tune", nargs="+", type=Path, required=True, help="traverses to tune on")
    parser.add_argument("--score", nargs="+", type=Path, required=True, help="traverses that tuning never sees")
    parser.add_argument("--labels", nargs="+", choices=LABELS, default=list(LABELS))
    parser.add_argument("--out", type=Path, default=Path("tuned"), help="folder for the configurations")
    parser.add_argument("--kernel", type=int, default=0, help="size of the learned kernel; tuned beside the rest")
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parser.parse_args()
    keep_compiled_programs()
    rows = [row for labels in given.labels for row in rows_of(labels, given)]
    print_table(rows)
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")


def rows_of(labels: str, given: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The scores of every traverse under every rule, for one source of labels."""
    rules = {"default": base_config(labels, given.score[0])}
    for name, size in [("tuned", 0), *([("with kernel", given.kernel)] if given.kernel else [])]:
        rules[name] = tuned(labels, given, size, given.out / f"{labels}{'_kernel' * bool(size)}.yaml")
    for traverse in dict.fromkeys([*given.tune, *given.score]):
        frames: list[PreparedFrame] = []
        for name, config in rules.items():
            plan = plan_run(str(traverse / "Part1"), with_labels(config, labels, traverse), lambda line: None)
            needs = plan.labeller.needs
            frames = frames or list(prepare_frames(plan.sequence, plan.front_end, plan.label_folder, needs=needs))
            class_map = fused(plan, frames, "rock")
            raster = read_truth([traverse / "gt" / "orthomosaic_labels.tif"], class_map.place, TruthOptions())
            scores = evaluate_map(class_map, raster, None, ScoringOptions(cell_size_m=CELL_M)).scores
            lattices = [confusion_scores(one)["iou"] or 0.0 for one in confusions(class_map, raster, CELL_M)]
            told = {name: scores[name] for name in (*SCORES, "cells", "rock_cells")}
            yield {
                "labels": labels,
                "traverse": traverse.name,
                "seen": traverse in given.tune,
                "rule": name,
                "iou_of_lattices": float(np.mean(lattices)),
                **told,
            }


def base_config(labels: str, traverse: Path) -> MapConfig:
    """The default rule, for a source of labels."""
    return with_labels(MapConfig(labeller=LABELS[labels], depth=DepthConfig(max_m=RANGE_M)), labels, traverse)


def with_labels(config: MapConfig, labels: str, traverse: Path) -> MapConfig:
    """The settings with the true labels of a traverse, where labels come from files."""
    if labels != "true":
        return config
    return replace(config, labels=traverse / "gt" / "labels", labels_are="raw")


def tuned(labels: str, given: argparse.Namespace, kernel: int, out: Path) -> MapConfig:
    """What `jaxmap tune` makes of the traverses to tune on."""
    started_s = time.perf_counter()
    config = base_config(labels, given.tune[0])
    sources = [
        Source(
            str(one / "Part1"),
            one / "gt" / "orthomosaic_labels.tif",
            labels=one / "gt" / "labels" if labels == "true" else None,
        )
        for one in given.tune
    ]
    run = TuningRun(sources, config, TruthOptions(), TuneOptions(kernel=kernel), out, notify=lambda line: None)
    run.cache(lambda done: None)
    cached_s = time.perf_counter()
    result = run.tune(lambda step, note: None)
    print(
        f"{labels}{' with kernel' * bool(kernel)}: {run.frames} frames cached in {cached_s - started_s:.0f} s, "
        f"{sum(len(stage['history']) for stage in result['stages'])} steps in {time.perf_counter() - cached_s:.0f} s",
        flush=True,
    )
    return load_config(str(out))


def print_table(rows: list[dict[str, Any]]) -> None:
    """One table of all scores."""
    print(f"\n{'labels':9s}{'traverse':14s}{'':8s}{'rule':13s}{'IoU':>7s}{'16 lattices':>13s}", end="")
    print("".join(f"{name:>11s}" for name in SCORES[1:]) + f"{'cells':>8s}{'rock':>6s}")
    for row in rows:
        numbers = "".join(f"{row[name] or 0.0:11.3f}" for name in SCORES[1:])
        seen = "tuned on" if row["seen"] else ""
        print(
            f"{row['labels']:9s}{row['traverse']:14s}{seen:9s}{row['rule']:12s}{row['iou'] or 0.0:7.3f}"
            f"{row['iou_of_lattices']:13.3f}{numbers}{row['cells']:8d}{row['rock_cells']:6d}"
        )


if __name__ == "__main__":
    main()
