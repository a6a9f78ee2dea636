"""A run keeps to its own files, shares its folder with no other run, and says what it cannot know."""

from __future__ import annotations

import fcntl
import os
import shutil
import signal

import numpy as np
import pytest
import rasterio
import yaml
from fixtures import cli, finished_run, map_words, scene_copy, scene_folder, shared_cache  # noqa: F401

from jaxmap.host.files import atomic_path, bundled
from jaxmap.mapping.store import load_map, open_map
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.mapping import run_plan


def files(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("inside", [".", "left", "right/runs"])
def test_a_run_into_its_own_sequence_is_refused(cli, scene_copy, inside):
    before, folders = files(scene_copy), sorted(scene_copy.rglob("*"))
    outcome = cli(*map_words(scene_copy, scene_copy / inside, "--overwrite"))
    assert outcome.status == 2
    assert "the sequence's own" in outcome.error
    assert files(scene_copy) == before
    assert sorted(scene_copy.rglob("*")) == folders


def test_a_pose_file_in_use_is_not_overwritten(cli, scene_copy, tmp_path):
    (tmp_path / "run").mkdir()
    shutil.copy(scene_copy / "poses.tum", tmp_path / "run" / "poses.tum")
    before = files(tmp_path / "run")
    outcome = cli(*map_words(scene_copy, tmp_path / "run", "--poses", tmp_path / "run" / "poses.tum"))
    assert outcome.status == 2
    assert "an input would be overwritten" in outcome.error
    assert files(tmp_path / "run") == before


@pytest.mark.parametrize("option", [(), ("--overwrite",)])
def test_files_that_no_run_has_written_are_left_alone(cli, scene_folder, tmp_path, option):
    run = tmp_path / "run"
    (run / "pictures").mkdir(parents=True)
    (run / "pictures" / "holiday.png").write_text("sun")
    (run / "map.ply").write_text("mine")
    outcome = cli(*map_words(scene_folder, run, *option))
    assert outcome.status == 1
    assert "map.ply would be replaced" in outcome.error
    assert (run / "map.ply").read_text() == "mine"


@pytest.mark.slow
def test_overwriting_keeps_pictures_that_are_not_the_runs(cli, scene_folder, finished_run, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished_run, run)
    (run / "pictures" / "holiday.png").write_text("sun")
    assert cli(*map_words(scene_folder, run, "--overwrite", "--stop", "1")).status == 0
    assert sorted(path.name for path in (run / "pictures").iterdir()) == [
        *("000000_disparity.png", "000000_labels.png", "000000_left.png"),
        "holiday.png",
    ]


def test_two_runs_do_not_share_a_folder(cli, scene_folder, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    with RunFolder(run).locked():
        outcome = cli(*map_words(scene_folder, run))
    assert outcome.status == 1
    assert "another run is writing here" in outcome.error
    handle = os.open(run, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.close(handle)


def test_labels_that_nobody_would_read_are_refused(cli, scene_folder, tmp_path):
    outcome = cli(*map_words(scene_folder, tmp_path / "run", "--labels", scene_folder / "labels"))
    assert outcome.status == 2
    assert "--labeller files" in outcome.error


@pytest.mark.slow
def test_a_resolved_configuration_can_be_fed_back(cli, scene_folder, finished_run, tmp_path):
    assert cli(*map_words(scene_folder, tmp_path / "run", "--config", finished_run / "config.yaml")).status == 0
    first, again = (yaml.safe_load((run / "config.yaml").read_text()) for run in (finished_run, tmp_path / "run"))
    assert first == again
    maps = [np.asarray(load_map(run / "map.zarr")[0].log_odds) for run in (finished_run, tmp_path / "run")]
    np.testing.assert_array_equal(*maps)


def test_a_crs_that_is_given_goes_into_the_geotiff(cli, scene_folder, tmp_path):
    words = map_words(scene_folder, tmp_path / "run", "--stop", "1", "--labeller", "none", "--crs", "EPSG:32631")
    assert cli(*words).status == 0
    with rasterio.open(tmp_path / "run" / "bev.tif") as image:
        assert image.crs.to_epsg() == 32631
    outcome = cli(*map_words(scene_folder, tmp_path / "other", "--crs", "EPSG:nothing"))
    assert outcome.status == 2
    assert "not a coordinate reference system" in outcome.error


@pytest.mark.slow
def test_poses_that_changed_do_not_go_on_in_the_same_map(cli, scene_copy, tmp_path):
    run = tmp_path / "run"
    assert cli(*map_words(scene_copy, run)).status == 0
    lines = (scene_copy / "poses.tum").read_text().splitlines()
    moved = [line.split() for line in lines if not line.startswith("#")]
    moved = [[row[0], str(float(row[1]) + 0.01), *row[2:]] for row in moved]
    (scene_copy / "poses.tum").write_text("\n".join(" ".join(row) for row in moved))
    outcome = cli(*map_words(scene_copy, run, "--resume"))
    assert outcome.status == 1
    assert "frames, poses or camera" in outcome.error or "bounds of the map" in outcome.error


def test_an_interrupt_saves_what_is_there(scene_folder, tmp_path):
    from planned_runs import config_of, planned

    plan, folder = planned(scene_folder), RunFolder(tmp_path / "run")
    folder.begin(plan.settings(config_of()), resume=False, overwrite=False)
    told = []

    def interrupt(fused):
        if fused.prepared.index == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_plan(plan, folder, strict=True, checkpoint_every_s=60.0, notify=told.append, on_frame=interrupt)
    assert told[-1] == "interrupted and saved after 3 frames; --resume goes on there"
    progress = open_map(folder.map).attributes.progress
    assert progress["next_index"] == 3
    assert progress["total_s"] > 0, "the time that it took is not forgotten"


def test_what_ends_a_job_is_told_like_ctrl_c(cli, scene_folder, tmp_path):
    assert cli(*map_words(scene_folder, tmp_path / "run", "--stop", "1", "--labeller", "none")).status == 0
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)


@pytest.mark.parametrize("option", ["--calibration", "--model"])
def test_inputs_in_use_are_not_overwritten(option, cli, scene_folder, tmp_path):
    mine = tmp_path / "config.yaml"
    given = bundled("rover.safetensors") if option == "--model" else scene_folder / "camera.yaml"
    mine.write_bytes(given.read_bytes())
    more = ("--labeller", "deeplab") if option == "--model" else ()
    outcome = cli(*map_words(scene_folder, tmp_path, option, mine, *more, "--overwrite"))
    assert (outcome.status, "an input would be overwritten" in outcome.error) == (2, True)
    assert mine.read_bytes() == given.read_bytes() and len(list(tmp_path.iterdir())) == 1


def test_what_killed_writers_left_is_removed(tmp_path):
    dead, living = tmp_path / ".scores.tmp-999999999.json", tmp_path / f".scores.tmp-{os.getppid()}.json"
    dead.touch()
    living.touch()
    with atomic_path(tmp_path / "scores.json") as temporary:
        temporary.write_text("{}")
    assert not dead.exists()
    assert living.exists()
