"""The demo: the paper's table on the bundled traverse, and what comes bundled."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from fixtures import cli, shared_cache  # noqa: F401

import jaxmap.commands.demo as command
from jaxmap.commands.demo import demo_rows, found_rocks
from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.datasets.poses import read_poses
from jaxmap.datasets.samples import sample_truth
from jaxmap.geometry.relief import RELIEF_CHANNELS
from jaxmap.host.files import bundled
from jaxmap.labels import ROVER_CLASSES
from jaxmap.models.checkpoint import load_network

MIB = 2**20


@pytest.mark.slow
def test_a_row_of_the_demo(cli, monkeypatch, tmp_path):
    _, config = demo_rows()["plane_chiodini2020"]
    # Labels from files: the quickest step to compile.
    labels = dict(labeller="files", labels=sample_truth() / "labels", labels_are="raw")
    config = replace(config, stop=2, stereo=replace(config.stereo, num_disparities=64, near_guard=False), **labels)
    monkeypatch.setattr(command, "demo_rows", lambda: {"true": ("true labels", config)})
    outcome = cli("demo", "--out", tmp_path / "demo")
    assert outcome.status == 0, outcome.err
    (row,) = json.loads((tmp_path / "demo" / "table.json").read_text())
    assert (row["run"], row["map"], row["frames"]) == ("true", "true labels", 2)
    page = (tmp_path / "demo" / "report.html").read_text("utf-8")
    for text in ("2 stereo frames", "Left image", "Labels", "Ground truth", "Top-down map", "Errors: true", "Images"):
        assert text in page
    for path in ("truth.png", "map.png", "true.png", "true/report.html", "true/errors.png"):
        assert (tmp_path / "demo" / path).stat().st_size > 1000
    assert f"{row['accuracy']:.3g}" in outcome.out and row["found"] in outcome.out


def test_rocks_are_counted_by_size():
    sizes = [(0.0, 0.1, 9, 8), (0.1, 0.2, 6, 1), (0.5, 1.0, 2, 0), (1.0, None, 2, 1)]
    rows = [dict(zip(("from", "to", "count", "missed"), size, strict=True)) for size in sizes]
    found = found_rocks({"count": 19, "missed": 10, "by_diameter_m": rows})
    assert found == {"found": "9 of 19", "under 0.2 m": "6 of 15", "0.2 to 0.5 m": None, "over 0.5 m": "3 of 4"}


@pytest.fixture(scope="module")
def demo(tmp_path_factory, shared_cache):
    work = tmp_path_factory.mktemp("demo")
    # In a process of its own, so that the memory it reports is its own.
    environment = {**os.environ, "JAXMAP_CACHE": str(shared_cache)}
    # As it stands in the README: into a folder of the current one.
    subprocess.run([sys.executable, "-m", "jaxmap", "demo"], cwd=work, env=environment, check=True)
    return work / "jaxmap_demo"


@pytest.mark.slow
def test_the_table_has_the_rows_of_the_paper_and_ours(demo):
    rows = json.loads((demo / "table.json").read_text())
    assert [row["run"] for row in rows] == ["plane_chiodini2020", "deeplab_chiodini2020", "relief", "relief_deeplab"]
    for row in rows:
        assert row["accuracy"] == (row["tp"] + row["tn"]) / (row["tp"] + row["tn"] + row["fp"] + row["fn"])
        assert row["iou"] == row["tp"] / (row["tp"] + row["fp"] + row["fn"])
        assert row["frames_per_s"] > 0 and row["peak_resident_mib"] < 4096
        assert (demo / row["run"] / "report.html").stat().st_size > 10_000


@pytest.mark.slow
def test_ours_beat_the_paper_s(demo):
    iou = {row["run"]: row["iou"] for row in json.loads((demo / "table.json").read_text())}
    assert iou["relief"] > 1.5 * iou["plane_chiodini2020"]
    assert iou["relief_deeplab"] == max(iou.values())


def test_the_bundled_network_is_small_and_knows_the_rover_s_classes():
    path = bundled("rover.safetensors")
    assert path.stat().st_size < 10 * MIB
    model = load_network(path)
    assert model.architecture.classes == ROVER_CLASSES and model.architecture.backbone == "efficientnet_lite0"
    assert model.architecture.relief_channels == RELIEF_CHANNELS


def test_the_sample_is_small_and_whole():
    files = [path for path in bundled("traverse").rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 15 * MIB
    sequence = open_sequence("sample:traverse", ReadOptions())
    assert len(sequence.frames) >= 12 and sequence.crs == "EPSG:32631"
    with rasterio.open(sample_truth() / "orthomosaic_labels.tif") as file:
        assert file.crs.to_epsg() == 32631 and set(np.unique(file.read(1))) == {0, 1, 2}


@pytest.mark.slow
def test_the_sample_s_estimated_poses_are_near_the_true_ones():
    sequence = open_sequence("sample:traverse", ReadOptions())
    true = read_poses(sample_truth() / "poses_utm.tum").T
    off_m = np.linalg.norm(sequence.T_world_camera[:, :3, 3] + sequence.site_origin - true[:, :3, 3], axis=1)
    assert off_m.max() < 0.05
