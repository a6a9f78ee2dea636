"""What each step of the fusion rule brings: one sequence with its labels, mapped under nine rules.

    python scripts/experiments/ladder.py SEQUENCE TRUTH [--labels DIR --labels-are raw] [--crs EPSG:32631]

TRUTH is what `jaxmap evaluate` takes. Without --labels the points are labelled by the MLESAC plane. Every rule maps the
same disparities. Prints one table: IoU, accuracy and confusion of the cells that were observed and are labelled, and
the IoU on 16 lattices of cells, shifted by parts of a cell.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import COARSE, FINE, FRAMES, POINTS, RANGE_M, Frames, Table, command_line, parse, rules

from jaxmap.evaluation.map_scores import confusion_scores
from jaxmap.fusion.options import FusionOptions
from jaxmap.geometry.options import DepthOptions
from jaxmap.runs.config import MapConfig


def rungs(base: MapConfig) -> Iterator[tuple[str, MapConfig]]:
    """The rules, from the paper's to the default."""
    yield "the paper, hits only", rules(base)["hits only"]
    yield "the paper", rules(base)["paper"]
    yield "majority of points, 0.2 m", rules(base)["majority"]
    yield "... a vote for each frame", replace(base, grid=COARSE, fusion=FRAMES)
    yield "area: columns of 0.05 m, points", replace(base, grid=FINE, fusion=POINTS)
    yield "... a vote for each frame", replace(base, grid=FINE, fusion=FRAMES)
    yield "... in full from 8 points on", replace(base, grid=FINE, fusion=replace(FRAMES, full_evidence_points=8.0))
    yield "... weighted by range noise", replace(base, grid=FINE, fusion=FusionOptions(carve=False))
    yield "the default: free space carved, too", base


def main() -> None:
    """Prints one line for each rule."""
    parser = command_line(__doc__)
    parser.add_argument("sequence")
    parser.add_argument("truth", type=Path)
    parser.add_argument("--labels", type=Path)
    parser.add_argument("--labels-are", default="auto", choices=("auto", "raw", "rectified"))
    parser.add_argument("--poses", type=Path)
    parser.add_argument("--crs")
    parser.add_argument("--max-range-m", type=float, default=RANGE_M)
    parser.add_argument("--cell-size-m", type=float, default=0.2)
    given = parse(parser)
    base = MapConfig(
        labeller="plane" if given.labels is None else "files",
        labels=given.labels,
        labels_are=given.labels_are,
        poses=given.poses,
        crs=given.crs,
        depth=DepthOptions(max_m=given.max_range_m),
    )
    frames = Frames(given.sequence, given.truth)
    columns = {"rule": "<38", "IoU": "7.3f", "accuracy": "9.3f", "TP": "6d", "FP": "6d", "FN": "6d", "cells": "8d"}
    table = Table({**columns, "mean IoU": "10.3f", "least": "7.3f", "greatest": "10.3f"})
    for name, config in rungs(base):
        every = frames.scored(config).confusions(given.cell_size_m)
        ious = [confusion_scores(one)["iou"] or 0.0 for one in every]
        first, accuracy = every[0], confusion_scores(every[0])["accuracy"] or 0.0
        counts = (first.tp, first.fp, first.fn, first.total)
        table.row(name, ious[0], accuracy, *counts, float(np.mean(ious)), min(ious), max(ious))


if __name__ == "__main__":
    main()
