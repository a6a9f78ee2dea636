"""Prints what each step of the fusion rule brings: a sequence, its true labels, and its ground truth from above.

    python scripts/ladder.py SEQUENCE TRUTH [--labels DIR --labels-are raw] [--crs EPSG:32631] [--max-range-m 8]

TRUTH is what `jaxmap evaluate` takes. Without --labels the points are labelled by the MLESAC plane. Every rule maps the
same disparities; cells count where they were observed and are labelled. A rule is scored on several lattices of cells,
shifted by parts of a cell, because a site of a few dozen rock cells moves by several hundredths when its lattice does.
"""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxmap.datasets.label_raster import LabelRaster
from jaxmap.evaluation.cells import CellGrid, column_shares, make_cells, map_cells
from jaxmap.evaluation.evaluate import ClassLayer
from jaxmap.evaluation.map_scores import Confusion, confusion_scores, count_confusion
from jaxmap.evaluation.truth_cells import truth_cells
from jaxmap.host.cache import keep_compiled_programs
from jaxmap.mapping.sequence import PreparedFrame, prepare_frames, run_sequence
from jaxmap.runs.config import DepthConfig, FusionConfig, GridConfig, MapConfig, load_config
from jaxmap.runs.evaluation import TruthOptions, class_layer_of, read_truth
from jaxmap.runs.mapping_plan import Plan, plan_run

POINTS = FusionConfig(per_frame="sum", carve=False, range_weighting=False, class_hit=1.0, class_miss=-1.0)
"""More rock points than others, over all frames: the majority."""

FRAMES = replace(POINTS, per_frame="mean", full_evidence_points=1.0)
"""Each frame has one vote, shared by its points."""

FINE = GridConfig(voxel_size_m=(0.05, 0.05, 0.2))
COARSE = GridConfig(voxel_size_m=0.2)
LATTICES = 4


def rungs(base: MapConfig) -> Iterator[tuple[str, MapConfig]]:
    """The rules, from the paper's to the default."""
    paper = load_config("chiodini2020")
    yield "the paper: hit once", replace(base, grid=paper.grid, fusion=paper.fusion)
    yield "more rock points than others, 0.2 m", replace(base, grid=COARSE, fusion=POINTS)
    yield "... a vote for each frame", replace(base, grid=COARSE, fusion=FRAMES)
    yield "area: sub-cells of 0.05 m, points", replace(base, grid=FINE, fusion=POINTS)
    yield "... a vote for each frame", replace(base, grid=FINE, fusion=FRAMES)
    yield "... in full from 8 points on", replace(base, grid=FINE, fusion=replace(FRAMES, full_evidence_points=8.0))
    yield "... weighted by range noise", replace(base, grid=FINE, fusion=FusionConfig(carve=False))
    yield "the default: free space carved, too", base


def fused(plan: Plan, frames: list[PreparedFrame], target: str) -> ClassLayer:
    """The map of the frames under a rule."""
    # The step is compiled for each rule; the frames are the same.
    steps = run_sequence(plan.mapper, plan.mapper.init(), frames, plan.params, plan.key)
    voxel_map, _ = deque(steps, maxlen=1).pop()
    sequence = plan.sequence
    return class_layer_of(
        voxel_map, plan.params.fusion, plan.rule, target, site_origin=sequence.site_origin, crs=sequence.crs
    )


def confusions(class_map: ClassLayer, raster: LabelRaster, cell_size_m: float) -> list[Confusion]:
    """The confusion on lattices of cells shifted by parts of a cell, the usual one first."""
    usual = make_cells(class_map.grid, cell_size_m)
    found = []
    for east, north in np.ndindex(LATTICES, LATTICES):
        shift_m = np.array([east, north]) * cell_size_m / LATTICES
        origin_m = np.array(usual.origin_m) - shift_m
        cells = CellGrid(
            (float(origin_m[0]), float(origin_m[1])), usual.size_m, (usual.shape[0] + 1, usual.shape[1] + 1)
        )
        shares = column_shares(class_map.grid, cells)
        said = map_cells(class_map.is_class, class_map.probability, class_map.observed, shares)
        truth = truth_cells(raster, cells, class_map.site_origin, class_map.crs)
        counted = np.asarray(said.observed) & truth.labelled
        found.append(count_confusion(said.called(), truth.truly(), counted))
    return found


def main() -> None:
    """Prints one line for each rule."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence")
    parser.add_argument("truth", type=Path)
    parser.add_argument("--labels", type=Path)
    parser.add_argument("--labels-are", default="auto", choices=("auto", "raw", "rectified"))
    parser.add_argument("--poses", type=Path)
    parser.add_argument("--crs")
    parser.add_argument("--max-range-m", type=float, default=8.0)
    parser.add_argument("--cell-size-m", type=float, default=0.2)
    given = parser.parse_args()
    keep_compiled_programs()
    base = MapConfig(
        labeller="plane" if given.labels is None else "files",
        labels=given.labels,
        labels_are=given.labels_are,
        poses=given.poses,
        crs=given.crs,
        depth=DepthConfig(max_m=given.max_range_m),
    )
    frames: list[PreparedFrame] = []
    print(f"{'rule':38s} {'IoU':>6s} {'accuracy':>8s} {'TP':>5s} {'FP':>5s} {'FN':>5s} {'cells':>7s}   IoU of lattices")
    for name, config in rungs(base):
        plan = plan_run(given.sequence, config, lambda line: None)
        frames = frames or list(prepare_frames(plan.sequence, plan.front_end, plan.label_folder))
        class_map = fused(plan, frames, "rock")
        raster = read_truth([given.truth], class_map.place, TruthOptions())
        every = confusions(class_map, raster, given.cell_size_m)
        first = every[0]
        scores = confusion_scores(first)
        spread = [confusion_scores(one)["iou"] or 0.0 for one in every]
        print(
            f"{name:38s} {scores['iou'] or 0.0:6.3f} {scores['accuracy'] or 0.0:8.3f} {first.tp:5d} {first.fp:5d} "
            f"{first.fn:5d} {first.total:7d}   mean {np.mean(spread):.3f}, {min(spread):.3f} to {max(spread):.3f}"
        )


if __name__ == "__main__":
    main()
