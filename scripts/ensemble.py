"""What the ensemble is worth and what it costs: does it tell missed rocks, and which of its errors does?

    python scripts/ensemble.py TRAVERSE... [--members 8]     # sample:traverse, or folders that hold Part1 and gt

Each traverse is mapped once without an ensemble and once for each spread: errors of the poses alone, of the disparities
alone, of the sensor model alone, and all of them. Printed is how well the layer ranks the cells of 0.2 m that are rock
among those that the map does not call rock (area under the ROC curve, average precision), how many it expects and how
many there are, its calibration, and the time and memory of each member.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxmap.ensemble.layer import ensemble_layers
from jaxmap.ensemble.options import EnsembleOptions
from jaxmap.evaluation.evaluate import evaluate_map
from jaxmap.evaluation.options import ScoringOptions
from jaxmap.host.cache import keep_compiled_programs
from jaxmap.host.files import bundled
from jaxmap.mapping.sequence import PreparedFrame, prepare_frames, run_sequence
from jaxmap.runs.config import DepthConfig, MapConfig
from jaxmap.runs.evaluation import TruthOptions, class_layer_of, read_truth
from jaxmap.runs.mapping_plan import plan_run

CELL_M, RANGE_M = 0.2, 8.0
NO_POSES = dict(position_sigma_m=0.0, heading_sigma_rad=0.0, tilt_sigma_rad=0.0)
NO_DISPARITY = dict(disparity_sigma_px=0.0)
NO_SENSOR = dict(increment_sigma=0.0, temperature_sigma=0.0, label_bias_sigma=0.0)
SPREADS: dict[str, dict[str, float]] = {
    "poses": NO_DISPARITY | NO_SENSOR,
    "disparities": NO_POSES | NO_SENSOR,
    "sensor model": NO_POSES | NO_DISPARITY,
    "all": {},
}


def main() -> None:
    """Maps, scores, prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("traverses", nargs="+", help="sample:traverse, or folders that hold Part1 and gt")
    parser.add_argument("--members", type=int, default=8)
    parser.add_argument("--labels", choices=("deeplab", "plane"), default="deeplab")
    parser.add_argument("--spreads", nargs="+", choices=tuple(SPREADS), default=list(SPREADS))
    parser.add_argument(
        "--set", nargs=2, action="append", default=[], metavar=("OPTION", "VALUE"), help="of the ensemble"
    )
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parser.parse_args()
    keep_compiled_programs()
    options = EnsembleOptions(members=given.members, **{name: float(value) for name, value in given.set})
    rows = [row for name in given.traverses for row in rows_of(name, given.labels, options, given.spreads)]
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")


def rows_of(name: str, labels: str, options: EnsembleOptions, spreads: list[str]) -> list[dict[str, Any]]:
    """The table of one traverse, printed as it comes."""
    sequence, truth = paths_of(name)
    base = MapConfig(labeller=labels, depth=DepthConfig(max_m=RANGE_M))  # pyright: ignore[reportArgumentType]
    plan = plan_run(sequence, base, lambda line: None)
    frames = list(prepare_frames(plan.sequence, plan.front_end, needs=plan.labeller.needs))
    alone = fused(plan, frames)
    print(
        f"\n{name}, labels by {labels}, {options.members} members; a step without them takes {alone['step_ms']:.0f} ms"
    )
    print(
        f"{'spread':14s}{'AUC':>7s}{'AP':>7s}{'ECE':>8s}{'expected':>10s}{'missed':>8s}{'cells':>7s}"
        f"{'ms per member':>15s}{'MiB per member':>16s}   said/true"
    )
    rows = []
    for spread in spreads:
        config = replace(base, ensemble=replace(options, **SPREADS[spread]))
        plan = plan_run(sequence, config, lambda line: None)
        run = fused(plan, frames)
        scores = scored(plan, run["voxel_map"], truth)
        row = {"traverse": name, "labels": labels, "spread": spread, "members": options.members} | scores
        row["ms_per_member"] = (run["step_ms"] - alone["step_ms"]) / options.members
        row["mib_per_member"] = run["voxel_map"].members.nbytes / options.members / 2**20
        if not rows:
            print_row("map alone", scores | scores["map_alone"], "")
        print_row(spread, row, f"{row['ms_per_member']:15.0f}{row['mib_per_member']:16.1f}")
        rows.append(row)
    return rows


def paths_of(name: str) -> tuple[str, Path]:
    """Sequence and truth of a traverse."""
    if name == "sample:traverse":
        return name, bundled("traverse") / "gt" / "orthomosaic_labels.tif"
    return str(Path(name) / "Part1"), Path(name) / "gt" / "orthomosaic_labels.tif"


def fused(plan: Any, frames: list[PreparedFrame]) -> dict[str, Any]:
    """The map of the frames, and the median time of a step."""
    if plan.pose_errors is not None:
        frames = [
            replace(one, frame=replace(one.frame, pose_errors=jax.numpy.asarray(plan.pose_errors[one.index])))
            for one in frames
            if one.frame is not None
        ]
    for one in frames:
        one.stages_s.pop("step", None)
    started_s = time.perf_counter()
    voxel_map, _ = deque(run_sequence(plan.mapper, plan.mapper.init(), frames, plan.params, plan.key), maxlen=1).pop()
    steps_s = [one.stages_s["step"] for one in frames if "step" in one.stages_s]
    total_s = time.perf_counter() - started_s
    return {"voxel_map": voxel_map, "step_ms": 1e3 * float(np.median(steps_s)), "total_s": total_s}


def scored(plan: Any, voxel_map: Any, truth: Path) -> dict[str, Any]:
    """The scores of the ensemble."""
    site_origin, crs = plan.sequence.site_origin, plan.sequence.crs
    params, rule = plan.params.fusion, plan.rule
    layers = ensemble_layers(voxel_map, params, rule)
    class_map = class_layer_of(voxel_map, params, rule, "rock", site_origin=site_origin, crs=crs)
    class_map = replace(class_map, ensemble=np.asarray(layers.probability))
    raster = read_truth([truth], class_map.place, TruthOptions())
    return evaluate_map(class_map, raster, None, ScoringOptions(cell_size_m=CELL_M)).scores["ensemble"]


def print_row(name: str, row: dict[str, Any], cost: str) -> None:
    """One line of the table."""
    numbers = f"{row['auc']:7.3f}{row['average_precision']:7.3f}{row['ece']:8.4f}"
    counts = f"{row['expected_missed_cells']:10.1f}{row['missed_cells']:8d}{row['cells']:7d}"
    bins = (
        " ".join(f"{part['said']:.2f}/{part['true']:.2f}({part['cells']})" for part in row["reliability"])
        if cost
        else ""
    )
    print(f"{name:14s}{numbers}{counts if cost else '':25s}{cost:31s}   {bins}", flush=True)


if __name__ == "__main__":
    main()
