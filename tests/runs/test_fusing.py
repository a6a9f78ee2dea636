"""Maps of observations that workers share: the same bits for any number of them, whatever is lost, moved or damaged."""

from __future__ import annotations

import json
import os
import shutil
import signal
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from observed_scenes import FARTHEST_M, VOXEL_M, write_traverse
from same_maps import assert_same_bits, assert_same_layers

import jaxmap.runs.fusing as fusing
from jaxmap.datasets.poses import write_tum
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.host.executors import Workers
from jaxmap.mapping.parts import read_record
from jaxmap.mapping.store import load_map
from jaxmap.runs.config import MapConfig, config_of_observations
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.fusing import fuse_task, map_observations
from jaxmap.runs.mapping import run_plan
from jaxmap.runs.mapping_plan import plan_run

FRAMES = 16
SMALL_GIB = 0.06
"""Memory of a map that then has several regions."""

HERE = Workers()

pytestmark = pytest.mark.slow


@contextmanager
def no_steps(title: str, unit: str, total: int):
    yield lambda done: None


def config_of(out: Path, **changes: Any) -> MapConfig:
    config = config_of_observations(out / "observations.zarr", None)
    grid = replace(config.grid, voxel_size_m=VOXEL_M, max_memory_gib=SMALL_GIB)
    return replace(config, grid=grid, depth=replace(config.depth, max_m=FARTHEST_M), **changes)


def mapped(out: Path, run: Path, workers: Workers = HERE, notes: list[str] | None = None, **words: Any) -> dict:
    ways = {name: words.pop(name) for name in ("resume", "overwrite", "update") if name in words}
    told, config = [] if notes is None else notes, config_of(out, **words)
    config = replace(config, grid=replace(config.grid, max_memory_gib=SMALL_GIB * workers.processes))
    return map_observations(str(out), config, RunFolder(run), workers, told.append, no_steps, **ways)


def log_odds(run: Path) -> np.ndarray:
    return np.asarray(load_map(run / "map.zarr")[0].log_odds)


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    """Observations; only to be read."""
    folder = tmp_path_factory.mktemp("observed") / "obs"
    write_traverse(folder, FRAMES)
    return folder


@pytest.fixture(scope="module")
def run(out, tmp_path_factory) -> Path:
    """A map of them by one worker; only to be read."""
    folder = tmp_path_factory.mktemp("run") / "run"
    mapped(out, folder)
    return folder


@pytest.fixture(autouse=True)
def without_pages(monkeypatch):
    monkeypatch.setattr(fusing, "write_report", lambda path: None)


def metrics_of(run: Path) -> dict:
    return json.loads((run / "metrics.json").read_text())


def test_the_map_is_that_of_one_pass_and_tells_what_it_is_made_of(out, run, tmp_path):
    config = config_of(out)
    whole = replace(config, grid=replace(config.grid, max_memory_gib=2.0))
    plan = plan_run(str(out), whole, lambda line: None)
    folder = RunFolder(tmp_path / "one")
    words = {"strict": True, "checkpoint_every_s": 1e9, "notify": lambda line: None, "report": False}
    with folder.writing(plan.settings(whole), resume=False, overwrite=False) as work:
        run_plan(plan, work, **words)
    one, many = load_map(tmp_path / "one" / "map.zarr")[0], load_map(run / "map.zarr")[0]
    assert_same_bits(many, one)
    assert_same_layers(run / "map.zarr", tmp_path / "one" / "map.zarr")
    shared = metrics_of(run)["shared"]
    assert shared["regions"] > 1 and shared["frames_fused"] == FRAMES
    ours, theirs = metrics_of(run), metrics_of(tmp_path / "one")
    assert ours["points"] == theirs["points"] and ours["sequence"] == theirs["sequence"]
    assert not (run / ".parts").exists()
    assert read_record(run / "map.zarr") is not None


def test_two_processes_give_the_same_bits_one_of_them_killed(out, run, tmp_path, monkeypatch):
    notes: list[str] = []
    monkeypatch.setattr(fusing, "fuse_task", KillsOnce(str(tmp_path / "killed")))
    mapped(out, tmp_path / "run", Workers(2), notes)
    assert (tmp_path / "killed").exists()
    assert any("run again" in note for note in notes)
    np.testing.assert_array_equal(log_odds(tmp_path / "run"), log_odds(run))


class KillsOnce:
    """A task whose worker is killed while it works, the first time."""

    def __init__(self, marker: str) -> None:
        self.marker = marker

    def __call__(self, task):
        if not os.path.exists(self.marker):
            Path(self.marker).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return fuse_task(task)


def test_a_cluster_gives_the_same_bits_and_a_task_may_run_twice(out, run, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        mapped(out, tmp_path / "run", Workers(scheduler=cluster.scheduler_address))
    np.testing.assert_array_equal(log_odds(tmp_path / "run"), log_odds(run))


def test_a_run_that_is_interrupted_goes_on_with_what_is_there(out, run, tmp_path, monkeypatch):
    done: list[int] = []

    def interrupted(task):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(len(task.frames))
        return fuse_task(task)

    monkeypatch.setattr(fusing, "fuse_task", interrupted)
    with pytest.raises(KeyboardInterrupt):
        mapped(out, tmp_path / "run")
    with pytest.raises(JaxmapError, match="holds a run already"):
        mapped(out, tmp_path / "run")
    monkeypatch.setattr(fusing, "fuse_task", fuse_task)
    notes: list[str] = []
    metrics = mapped(out, tmp_path / "run", notes=notes, resume=True)
    assert any(f"{metrics['shared']['regions'] - 2} of" in note for note in notes)
    np.testing.assert_array_equal(log_odds(tmp_path / "run"), log_odds(run))


def moved(out: Path, path: Path, shift_m: float, frames: range, left_out: tuple[int, ...] = ()) -> Path:
    """A file of the poses, some of them shifted and some missing."""
    from jaxmap.mapping.observations import open_observations

    observations = open_observations(out / "observations.zarr")
    poses = observations.T_world_camera.copy()
    poses[frames, 0, 3] += shift_m
    kept = [index for index in range(len(poses)) if index not in left_out]
    times = np.array([frame.timestamp_s for frame in observations.frames])
    write_tum(path, times[kept], poses[kept])
    return path


def test_corrected_poses_fuse_again_what_they_touch_and_give_the_map_made_anew(out, run, tmp_path):
    there = tmp_path / "run"
    shutil.copytree(run, there)
    poses = moved(out, tmp_path / "corrected.tum", 0.4, range(1, 2))
    with pytest.raises(JaxmapError, match="holds a run already"):
        mapped(out, there, poses=poses)
    # Written with fewer digits, the others have moved a little, too: they are brought up to that file first.
    mapped(out, there, poses=moved(out, tmp_path / "same.tum", 0.0, range(0)), update=True)
    metrics = mapped(out, there, poses=poses, update=True)
    mapped(out, tmp_path / "anew", poses=poses)
    np.testing.assert_array_equal(log_odds(there), log_odds(tmp_path / "anew"))
    assert metrics["shared"]["tiles_fused"] < metrics["shared"]["tiles"]
    assert metrics["shared"]["frames_fused"] < FRAMES
    ours, theirs = metrics_of(there), metrics_of(tmp_path / "anew")
    assert ours["points"] == theirs["points"] and ours["voxels"] == theirs["voxels"]


def test_poses_that_miss_frames_leave_them_out_and_say_so(out, run, tmp_path):
    there, notes = tmp_path / "run", []
    shutil.copytree(run, there)
    poses = moved(out, tmp_path / "fewer.tum", 0.0, range(0), left_out=(FRAMES - 1,))
    mapped(out, there, notes=notes, poses=poses, update=True)
    assert any("1 of 16 frames have no pose" in note for note in notes)
    mapped(out, tmp_path / "anew", poses=poses)
    np.testing.assert_array_equal(log_odds(there), log_odds(tmp_path / "anew"))
    assert metrics_of(there)["sequence"]["fused"] == FRAMES - 1


def test_a_damaged_tile_is_named_and_fused_again(out, run, tmp_path):
    there, notes = tmp_path / "run", []
    shutil.copytree(run, there)
    file = max((there / "map.zarr" / "log_odds" / "c").rglob("*"), key=lambda path: path.is_file())
    file.write_bytes(file.read_bytes()[:-20])
    metrics = mapped(out, there, notes=notes, update=True)
    assert any("of the map is damaged: its" in note and "fused again" in note for note in notes)
    assert metrics["shared"]["tiles_fused"] == 1
    np.testing.assert_array_equal(log_odds(there), log_odds(run))


def test_a_frame_that_is_damaged_is_left_out_or_refused(out, tmp_path):
    copy = Path(shutil.copytree(out, tmp_path / "obs"))
    damaged = copy / "observations.zarr" / "f00003" / "disparity" / "c.0.0"
    files = [damaged] if damaged.exists() else list((copy / "observations.zarr" / "f00003" / "disparity").glob("c*"))
    files[0].write_bytes(files[0].read_bytes()[:-20])
    metrics = mapped(copy, tmp_path / "run")
    assert [one["frame"] for one in metrics["sequence"]["skipped"]] == ["f00003"]
    assert metrics["sequence"]["fused"] == FRAMES - 1
    with pytest.raises(JaxmapError, match="f00003"):
        mapped(copy, tmp_path / "strict", strict=True)


def test_what_cannot_be_brought_up_to_date_is_refused(out, run, tmp_path):
    with pytest.raises(UsageError, match="no run to bring up to date"):
        mapped(out, tmp_path / "nothing", update=True)
    with pytest.raises(UsageError, match="another seed"):
        mapped(out, run, update=True, seed=7)
    with pytest.raises(UsageError, match="take fewer workers"):
        config = config_of(out)
        config = replace(config, grid=replace(config.grid, max_memory_gib=1e-4))
        map_observations(str(out), config, RunFolder(tmp_path / "x"), Workers(), print, no_steps)
