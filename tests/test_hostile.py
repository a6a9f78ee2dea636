"""Hostile files: whatever lies in a file, a command ends soon, in bounded memory, well or with one line."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from fixtures import finished_run, scene_folder, shared_cache  # noqa: F401
from hostile import FILE_CHANGES, TEXT_CHANGES, Campaign, Change, TooLong, flip_bytes, replace_number, replace_value
from planned_runs import config_of, planned
from truth_files import CRS, SITE, write_raster

from jaxmap.datasets.crs import Extent
from jaxmap.datasets.label_raster import read_coding, read_label_orthomosaic
from jaxmap.errors import JaxmapError
from jaxmap.mapping.sequence import prepare_frames
from jaxmap.mapping.store import open_map
from jaxmap.report.run_page import write_report
from jaxmap.runs.config import config_tree, load_config
from jaxmap.runs.evaluation import read_cameras
from jaxmap.runs.exports import write_exports
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.log import RunLog

SEQUENCE_FILES: dict[str, tuple[Change, ...]] = {
    "camera.yaml": TEXT_CHANGES,
    "poses.tum": TEXT_CHANGES,
    "times.txt": TEXT_CHANGES,
    "left/f000.png": FILE_CHANGES,
    "right/f000.png": FILE_CHANGES,
}
RUN_FILES: dict[str, tuple[Change, ...]] = {
    "metrics.json": (*TEXT_CHANGES, replace_number, replace_value, replace_value),
    "map.zarr/zarr.json": (*TEXT_CHANGES, replace_number, replace_value, replace_value),
    "map.zarr/log_odds/zarr.json": TEXT_CHANGES,
    "config.yaml": TEXT_CHANGES,
    "scores.json": TEXT_CHANGES,
    "poses.tum": TEXT_CHANGES,
    "bev.png": FILE_CHANGES,
    "pictures/000000_left.png": FILE_CHANGES,
}
TEXTS = [replace_number, replace_value, flip_bytes]
COUNTS = [pytest.param(12, id="quick"), pytest.param(150, id="all", marks=pytest.mark.slow)]


def test_a_campaign_notices():
    campaign = Campaign(seed=0)
    with campaign.trial("one line"):
        raise JaxmapError("what", where="where", fix="do this")
    campaign.check()
    for fault in (ValueError("what"), RecursionError(), MemoryError(), TooLong()):
        with campaign.trial("a fault"):
            raise fault
    assert len(campaign.faults) == 4
    with pytest.raises(AssertionError, match="a fault: ValueError: what"):
        campaign.check()


@pytest.mark.parametrize("count", COUNTS)
def test_hostile_configurations(count, tmp_path):
    campaign, path = Campaign(seed=count), tmp_path / "mine.yaml"
    for trial in range(3 * count):
        path.write_text(yaml.safe_dump(config_tree(config_of()), sort_keys=False))
        change = campaign.rng.choice(TEXTS)
        change(path, campaign.rng)
        with campaign.trial(f"configuration {trial}, {change.__name__}"):
            load_config(str(path))
    campaign.check()


@pytest.mark.parametrize("count", COUNTS)
def test_hostile_sequences(count, scene_folder, tmp_path):
    campaign = Campaign(seed=count)
    for trial in range(count):
        scene = Path(shutil.copytree(scene_folder, tmp_path / str(trial)))
        name = campaign.rng.choice(list(SEQUENCE_FILES))
        change = campaign.rng.choice(SEQUENCE_FILES[name])
        change(scene / name, campaign.rng)
        with campaign.trial(f"sequence {trial}, {change.__name__} {name}"):
            plan = planned(scene, labeller="none")
            next(iter(prepare_frames(plan.sequence, plan.front_end, plan.label_folder)))
    campaign.check()


@pytest.mark.parametrize("count", COUNTS)
def test_hostile_ground_truth(count, tmp_path):
    campaign = Campaign(seed=count)
    place = Extent(SITE[0], SITE[1], SITE[0] + 8.0, SITE[1] + 8.0, CRS)
    codes = tmp_path / "codes.yaml"
    for trial in range(count):
        path = write_raster(tmp_path / f"{trial}.tif", np.ones((80, 80), np.uint8), SITE[0], SITE[1] + 8, 0.1)
        change = campaign.rng.choice((*FILE_CHANGES, *[flip_bytes] * 8))
        change(path, campaign.rng)
        with campaign.trial(f"orthomosaic {trial}, {change.__name__}"):
            read_label_orthomosaic(path, place)
        codes.write_text("0: unlabelled\n1: sand\n2: rock\n")
        replace_value(codes, campaign.rng)
        with campaign.trial(f"codes {trial}"):
            read_coding(codes)
    campaign.check()


@pytest.mark.slow
def test_hostile_runs(finished_run, tmp_path):
    """A run folder of somebody else's: going on with it, and exporting and reporting it again."""
    campaign = Campaign(seed=7)
    for trial in range(80):
        run = Path(shutil.copytree(finished_run, tmp_path / str(trial)))
        (run / "scores.json").write_text('{"cells": 12, "accuracy": 0.5, "in_view": {"accuracy": 0.5}}')
        name = campaign.rng.choice(list(RUN_FILES))
        change = campaign.rng.choice(RUN_FILES[name])
        change(run / name, campaign.rng)
        with campaign.trial(f"run {trial}, {change.__name__} {name}"):
            read_cameras(run, np.zeros(3))
            reader = open_map(run / "map.zarr")
            RunLog.from_json(reader.attributes.progress, run)
            write_exports(RunFolder(run), reader)
            write_report(run)
        shutil.rmtree(run)
    campaign.check()


@pytest.mark.slow
def test_settings_at_their_bounds_are_planned_or_refused(scene_folder):
    """Every number of a configuration at the ends of its range, one at a time."""
    campaign = Campaign(seed=1)
    for group, values in config_tree(config_of()).items():
        for key, value in (values if isinstance(values, dict) else {group: values}).items():
            if not isinstance(value, int | float) or isinstance(value, bool):
                continue
            for extreme in (1e-9, 1e-6, 1e-3, 1, 16, 1000, 1_000_000, 2**31 - 1):
                number = int(extreme) if isinstance(value, int) else extreme
                with campaign.trial(f"{group}.{key} {number}"):
                    planned(scene_folder, **{group: {key: number} if isinstance(values, dict) else number})
    campaign.check()
