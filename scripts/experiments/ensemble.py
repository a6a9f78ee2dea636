"""What the ensemble is worth and what it costs: does it find missed rocks, and which of its errors does?

    python scripts/experiments/ensemble.py TRAVERSE... [--members 8]   # sample:traverse, or folders with Part1 and gt

Each traverse is mapped once without an ensemble and once for each spread: errors of the poses alone, of the disparities
alone, of the sensor model alone, and all of them. Prints one table: how well the layer ranks the cells of 0.2 m that
are rock among those that the map does not call rock (area under the ROC curve, average precision), its calibration
error, how many it expects and how many there are, and the time and memory of a member. `map alone` ranks cells by the
share of their columns that the map calls rock.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from common import Frames, Scored, Table, Traverse, command_line, fuse, parse

from jaxmap.ensemble.layer import ensemble_layers
from jaxmap.ensemble.options import EnsembleOptions
from jaxmap.runs.config import MapConfig
from jaxmap.runs.mapping_plan import Plan
from jaxmap.types import VoxelMap

NO_POSES = dict(position_sigma_m=0.0, heading_sigma_rad=0.0, tilt_sigma_rad=0.0)
NO_DISPARITY = dict(disparity_sigma_px=0.0)
NO_SENSOR = dict(increment_sigma=0.0, temperature_sigma=0.0, label_bias_sigma=0.0)
SPREADS: dict[str, dict[str, float]] = {
    "poses": NO_DISPARITY | NO_SENSOR,
    "disparities": NO_POSES | NO_SENSOR,
    "sensor model": NO_POSES | NO_DISPARITY,
    "all": {},
}
SCORES = ("auc", "average_precision", "ece")


def fused(frames: Frames, config: MapConfig) -> tuple[Plan, VoxelMap, float]:
    """The plan, the map, and the median milliseconds of a step."""
    plan = frames.plan(config)
    prepared = [one for one in frames.prepared if one.frame is not None]
    if plan.pose_errors is not None:
        errors = jnp.asarray(plan.pose_errors)
        prepared = [replace(one, frame=replace(one.frame, pose_errors=errors[one.index])) for one in prepared]
    for one in prepared:
        one.stages_s.pop("step", None)
    voxel_map = fuse(plan, prepared)
    return plan, voxel_map, 1e3 * float(np.median([one.stages_s["step"] for one in prepared]))


def main() -> None:
    """Maps, scores, prints."""
    parser = command_line(__doc__)
    parser.add_argument("traverses", nargs="+", help="sample:traverse, or folders that hold Part1 and gt")
    parser.add_argument("--members", type=int, default=8)
    parser.add_argument("--labels", choices=("deeplab", "plane"), default="deeplab")
    parser.add_argument("--spreads", nargs="+", choices=tuple(SPREADS), default=list(SPREADS))
    parser.add_argument(
        "--set", nargs=2, action="append", default=[], metavar=("OPTION", "VALUE"), help="of the ensemble"
    )
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parse(parser)
    options = EnsembleOptions(members=given.members, **{name: float(value) for name, value in given.set})
    columns = {"traverse": "<18", "spread": "<14", "AUC": "7.3f", "AP": "7.3f", "ECE": "8.4f", "expected": "10.1f"}
    columns |= {"missed": "8d", "cells": "7d", "ms a step": "11.0f", "ms a member": "13.0f", "MiB a member": "14.1f"}
    table = Table(columns)
    for name in given.traverses:
        traverse = Traverse(name)
        frames, base = Frames(traverse.sequence), traverse.config(given.labels)
        _, _, alone_ms = fused(frames, base)
        for spread in given.spreads:
            config = replace(base, ensemble=replace(options, **SPREADS[spread]))
            plan, voxel_map, step_ms = fused(frames, config)
            result = Scored(plan, voxel_map, traverse.truth)
            layers = ensemble_layers(voxel_map, plan.params.fusion, plan.rule)
            result.class_layer = replace(result.class_layer, ensemble=np.asarray(layers.probability))
            scores = result.scores["ensemble"]
            if spread == given.spreads[0]:
                without = [scores["map_alone"][key] for key in SCORES]
                table.row(traverse.name, "map alone", *without, None, None, None, alone_ms, None, None)
            cells = (scores["expected_missed_cells"], scores["missed_cells"], scores["cells"])
            member_ms = (step_ms - alone_ms) / given.members
            member_mib = voxel_map.members.nbytes / given.members / 2**20
            numbers = [scores[key] for key in SCORES]
            more = {"labels": given.labels, "reliability": scores["reliability"]}
            table.row(traverse.name, spread, *numbers, *cells, step_ms, member_ms, member_mib, **more)
    table.write(given.json)


if __name__ == "__main__":
    main()
