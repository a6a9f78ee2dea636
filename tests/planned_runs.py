"""Runs of small scenes, planned and carried out, and what they leave."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from jaxmap.export.voxels import OccupiedVoxels, occupied_voxels
from jaxmap.fusion.params import stored_fusion
from jaxmap.mapping.store import load_map
from jaxmap.runs.config import MapConfig, check_config, config_tree
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.mapping import run_plan
from jaxmap.runs.mapping_plan import Plan, plan_run

BOUNDS = {"lower_m": [-2.0, 0.0, -0.5], "upper_m": [2.0, 5.2, 1.0]}


def config_of(**settings: object) -> MapConfig:
    tree = config_tree(MapConfig())
    tree["labeller"] = "plane"
    tree["grid"] |= BOUNDS
    for key, value in settings.items():
        tree[key] = {**tree[key], **value} if isinstance(value, dict) else value
    return check_config(tree)


def planned(sequence: Path, **settings: object) -> Plan:
    return plan_run(str(sequence), config_of(**settings), lambda line: None)


def ran(sequence: Path, out: Path, **settings: object) -> dict:
    folder = RunFolder(out)
    config = config_of(**settings)
    plan = planned(sequence, **settings)
    folder.begin(plan.settings(config), resume=False, overwrite=False)
    return run_plan(plan, folder, strict=config.strict, checkpoint_every_s=60.0, notify=lambda line: None)


def log_odds(run: Path) -> np.ndarray:
    return np.asarray(load_map(run / "map.zarr")[0].log_odds)


def voxels_of(run: Path) -> OccupiedVoxels:
    voxel_map, attributes = load_map(run / "map.zarr")
    return occupied_voxels(voxel_map, *stored_fusion(attributes.fusion, voxel_map.classes, "map"))


def metrics_of(run: Path) -> dict:
    return json.loads((run / "metrics.json").read_text())
