"""`jaxmap map --ensemble.members`: the same map, a layer more, resumed to the last bit, refused where too large."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from fixtures import FRAMES, cli, finished_run, map_words, scene_folder, shared_cache  # noqa: F401
from planned_runs import config_of, log_odds, metrics_of, planned
from scenes import ROCK, SAND

from jaxmap.errors import JaxmapError
from jaxmap.mapping.sequence import FusedFrame
from jaxmap.mapping.store import load_map
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.mapping import run_plan

pytestmark = pytest.mark.slow

MEMBERS = 3
ENSEMBLE = ("--ensemble.members", str(MEMBERS))


class Cut(Exception):
    """Stands for whatever ends a run early."""


@pytest.fixture(scope="module")
def run(scene_folder: Path, tmp_path_factory) -> Path:
    from jaxmap.commands.main import main

    out = tmp_path_factory.mktemp("ensemble") / "run"
    assert main(map_words(scene_folder, out, *ENSEMBLE)) == 0
    return out


def members_of(run: Path) -> np.ndarray:
    return np.asarray(load_map(run / "map.zarr", members=True)[0].members)


def test_the_map_is_that_of_a_run_without_an_ensemble(run, finished_run):
    np.testing.assert_array_equal(log_odds(run), log_odds(finished_run))
    for name in ("map.ply", "bev.png"):
        assert (run / name).read_bytes() == (finished_run / name).read_bytes()
    assert not (finished_run / "missed.png").exists()


def test_the_layer_is_in_every_output(run):
    attributes = load_map(run / "map.zarr")[1]
    missed = attributes.layers["missed_rock"]
    assert members_of(run).shape == (MEMBERS, 2, *log_odds(run).shape[1:])
    with rasterio.open(run / "bev.tif") as raster:
        assert {"ensemble_probability_rock", "missed_rock"} <= set(raster.descriptions)
        band = raster.descriptions.index("missed_rock") + 1
        np.testing.assert_array_equal(raster.read(band), missed.T[::-1])
    ensemble = metrics_of(run)["ensemble"]
    assert ensemble["class"] == "rock" and ensemble["members"] == MEMBERS
    assert 0 < ensemble["missed_area_expected_m2"] < ensemble["observed_area_m2"]
    assert metrics_of(run)["memory"]["members_mib"] == pytest.approx(members_of(run).nbytes / 2**20, abs=0.01)
    page = (run / "report.html").read_text()
    assert "What may be missed" in page and "missed.png" in page


def test_a_run_that_was_cut_off_ends_with_the_same_members(run, scene_folder, cli, tmp_path):
    folder = RunFolder(tmp_path / "run")
    settings = {"ensemble": {"members": MEMBERS}}
    folder.begin(planned(scene_folder, **settings).settings(config_of(**settings)), resume=False, overwrite=False)

    def cut(fused: FusedFrame) -> None:
        if fused.prepared.index == 3:
            raise Cut

    with pytest.raises(Cut):
        run_plan(
            planned(scene_folder, **settings),
            folder,
            strict=False,
            checkpoint_every_s=0.0,
            notify=lambda line: None,
            on_frame=cut,
        )
    assert load_map(folder.map)[1].progress["next_index"] == 3
    assert cli(*map_words(scene_folder, folder.path, *ENSEMBLE, "--resume")).status == 0
    np.testing.assert_array_equal(members_of(folder.path), members_of(run))
    for name in ("bev.tif", "missed.png"):
        assert (folder.path / name).read_bytes() == (run / name).read_bytes()
    outcome = cli(*map_words(scene_folder, folder.path, "--ensemble.members", "2", "--resume"))
    assert outcome.status == 2 and "ensemble.members" in outcome.error


def test_exports_write_the_layer_anew(run, cli, tmp_path):
    def bands() -> np.ndarray:
        with rasterio.open(run / "bev.tif") as raster:
            return raster.read()

    picture, before = (run / "missed.png").read_bytes(), bands()
    (run / "missed.png").unlink()
    (run / "bev.tif").unlink()
    outcome = cli("export", run)
    assert outcome.status == 0 and "missed.png" in outcome.err + outcome.out
    assert (run / "missed.png").read_bytes() == picture and np.array_equal(bands(), before, equal_nan=True)


def test_scores_tell_how_well_missed_cells_are_told(run, scene_folder, cli, tmp_path):
    truth = tmp_path / "truth.tif"
    transform = rasterio.transform.from_origin(-3.0, 6.0, 0.1, 0.1)
    labels = np.full((90, 60), SAND, np.uint8)
    labels[20:45, 20:40] = ROCK
    profile = dict(driver="GTiff", width=60, height=90, count=1, dtype="uint8", transform=transform)
    with rasterio.open(truth, "w", **profile) as raster:
        raster.write(labels, 1)
    outcome = cli("evaluate", run, truth)
    assert outcome.status == 0, outcome.err
    ensemble = json.loads((run / "scores.json").read_text())["ensemble"]
    assert ensemble["cells"] == sum(part["cells"] for part in ensemble["reliability"])
    assert 0 <= ensemble["auc"] <= 1 and ensemble["missed_cells"] > 0
    assert "average precision" in (run / "report.html").read_text()


def test_an_ensemble_without_a_class_is_refused(cli, scene_folder, tmp_path):
    outcome = cli(*map_words(scene_folder, tmp_path / "run", *ENSEMBLE, "--labeller", "none"))
    assert outcome.status == 2 and "priority class" in outcome.error


@pytest.mark.parametrize("words", [("members", "-1"), ("position-sigma-m", "-0.1"), ("pose-correlation-s", "0")])
def test_spreads_that_are_none_are_refused(words, cli, scene_folder, tmp_path):
    name, value = words
    outcome = cli(*map_words(scene_folder, tmp_path / "run", f"--ensemble.{name}={value}"))
    assert outcome.status == 2 and name.replace("-", "_") in outcome.error


def test_members_count_against_the_memory(scene_folder):
    little = {"max_memory_gib": 0.005}
    planned(scene_folder, grid=little)
    with pytest.raises(JaxmapError, match=r"20 members.*fewer --ensemble\.members"):
        planned(scene_folder, grid=little, ensemble={"members": 20})


def test_more_frames_leave_the_errors_of_the_others(scene_folder):
    whole = planned(scene_folder, ensemble={"members": 2})
    part = planned(scene_folder, ensemble={"members": 2}, stop=2)
    assert whole.pose_errors.shape == (FRAMES, 2, 6)
    np.testing.assert_array_equal(part.pose_errors, whole.pose_errors[:2])
