"""Runs that are cut off, gone on with, or refused; an interrupted run must end as if nothing had happened."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from fixtures import FRAMES, cli, finished_run, map_words, scene_copy, scene_folder, shared_cache  # noqa: F401
from killed import SLOW_DISK, kill_when
from planned_runs import config_of, log_odds, metrics_of, planned
from same_maps import assert_same_bits, check_same_layers
from scenes import write_folder_sequence

from jaxmap.errors import JaxmapError
from jaxmap.geometry.bounds import map_bytes
from jaxmap.mapping import store as map_store
from jaxmap.mapping.sequence import FusedFrame
from jaxmap.mapping.store import load_map, open_map
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.mapping import run_plan
from jaxmap.runs.mapping_plan import plan_run


class Cut(Exception):
    """Stands for whatever ends a run early."""


def cut_after(index: int) -> Callable[[FusedFrame], None]:
    def on_frame(fused: FusedFrame) -> None:
        if fused.prepared.index == index:
            raise Cut

    return on_frame


def run_until(
    sequence: Path, out: Path, index: int, checkpoint_every_s: float = 0.0, *, overwrite: bool = False
) -> None:
    """Maps into `out`, saving after each frame, and is cut off after a frame, before that one is saved."""
    settings = planned(sequence).settings(config_of())
    with pytest.raises(Cut), RunFolder(out).writing(settings, resume=False, overwrite=overwrite) as work:
        run_plan(
            planned(sequence),
            work,
            strict=False,
            checkpoint_every_s=checkpoint_every_s,
            notify=lambda line: None,
            on_frame=cut_after(index),
        )


@pytest.fixture(scope="module")
def run_cut_at_two(scene_folder, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("cut") / "run"
    run_until(scene_folder, out, 2)
    return out


@pytest.fixture
def cut_run(run_cut_at_two, tmp_path) -> Path:
    """A run that was cut off when two frames were saved."""
    return Path(shutil.copytree(run_cut_at_two, tmp_path / "run"))


def assert_same_run(run: Path, whole: Path) -> None:
    np.testing.assert_array_equal(log_odds(run), log_odds(whole))
    assert (run / "poses.tum").read_bytes() == (whole / "poses.tum").read_bytes()
    assert (run / "map.ply").read_bytes() == (whole / "map.ply").read_bytes()
    metrics, expected = metrics_of(run), metrics_of(whole)
    for part in ("sequence", "camera", "grid", "labeller", "points", "voxels"):
        assert metrics[part] == expected[part], part
    progress, expected_progress = (load_map(path / "map.zarr")[1].progress for path in (run, whole))
    for part in ("next_index", "fused", "skipped", "valid_fractions", "points_fused", "complete"):
        assert progress[part] == expected_progress[part], part
    assert all(len(times["kept"]) == times["count"] == FRAMES for times in progress["stages_ms"].values())


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("index", [pytest.param(0, marks=pytest.mark.slow), 4])
def test_a_cut_run_ends_as_if_it_had_not_been_cut(index, cli, scene_folder, finished_run, tmp_path):
    run_until(scene_folder, tmp_path / "run", index)
    saved = load_map(tmp_path / "run" / "map.zarr")[1].progress["next_index"] if index else 0
    assert saved == index
    outcome = cli(*map_words(scene_folder, tmp_path / "run", "--resume"))
    assert outcome.status == 0
    assert index == 0 or f"going on after {index} of {FRAMES} frames" in outcome.err
    assert_same_run(tmp_path / "run", finished_run)


@pytest.mark.slow
def test_an_interrupt_right_after_a_frame_loses_no_picture(cli, scene_folder, finished_run, tmp_path):
    run = tmp_path / "run"

    def interrupt(fused: FusedFrame) -> None:
        if fused.prepared.index == 2:
            raise KeyboardInterrupt

    folder = RunFolder(run)
    folder.begin(planned(scene_folder).settings(config_of()), resume=False, overwrite=False)
    with pytest.raises(KeyboardInterrupt):
        run_plan(
            planned(scene_folder),
            folder,
            strict=False,
            checkpoint_every_s=60.0,
            notify=lambda line: None,
            on_frame=interrupt,
        )
    assert load_map(run / "map.zarr")[1].progress["next_index"] == 3
    assert cli(*map_words(scene_folder, run, "--resume")).status == 0
    pictures = [
        {file.name: file.read_bytes() for file in (folder / "pictures").iterdir()} for folder in (run, finished_run)
    ]
    assert pictures[0] == pictures[1] and len(pictures[0]) >= 9


@pytest.mark.slow
def test_a_run_may_be_cut_twice(cli, scene_folder, finished_run, cut_run):
    folder = RunFolder(cut_run)
    folder.begin(planned(scene_folder).settings(config_of()), resume=True, overwrite=False)
    with pytest.raises(Cut):
        run_plan(
            planned(scene_folder),
            folder,
            strict=False,
            checkpoint_every_s=0.0,
            notify=lambda line: None,
            on_frame=cut_after(4),
        )
    assert cli(*map_words(scene_folder, cut_run, "--resume")).status == 0
    assert_same_run(cut_run, finished_run)


@pytest.mark.slow
def test_a_skipped_frame_is_counted_once_over_a_cut(cli, scene_copy, tmp_path):
    (scene_copy / "right" / "f001.png").unlink()
    run_until(scene_copy, tmp_path / "run", 3)
    assert cli(*map_words(scene_copy, tmp_path / "run", "--resume")).status == 0
    sequence = metrics_of(tmp_path / "run")["sequence"]
    assert sequence["fused"] == FRAMES - 1
    assert [skipped["frame"] for skipped in sequence["skipped"]] == ["f001"]


@pytest.mark.slow
def test_a_killed_process_is_gone_on_with(cli, scene_folder, finished_run, tmp_path):
    # The frames are slowed down, so that the process dies in the middle of the run.
    program = (
        "import sys, time, jaxmap.mapping.devices\n"
        "from jaxmap.commands.main import main\n"
        "fuse = jaxmap.mapping.devices.run_sequence\n"
        "def slowly(*words, **options):\n"
        "    for result in fuse(*words, **options):\n"
        "        yield result\n"
        "        time.sleep(0.5)\n"
        "jaxmap.mapping.devices.run_sequence = slowly\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    run = tmp_path / "run"
    words = map_words(scene_folder, run, "--checkpoint-every-s", "0")
    kill_when(lambda: _saved_frames(run) >= 2, program, words)
    assert 2 <= _saved_frames(run) < FRAMES
    assert not (run / "metrics.json").exists()
    assert cli(*map_words(scene_folder, run, "--resume")).status == 0
    assert_same_run(run, finished_run)
    assert not [path for path in run.iterdir() if path.name.startswith(".")], "no leftovers"


def _saved_frames(run: Path) -> int:
    try:
        return json.loads((run / "map.zarr" / "zarr.json").read_text())["attributes"]["progress"]["next_index"]
    except (OSError, ValueError, KeyError):
        return 0


def test_other_settings_are_refused_by_name(cli, scene_folder, cut_run):
    before = contents(cut_run)
    for words, name in (
        (("--fusion.class-hit", "1.1"), "fusion.class_hit"),
        (("--stride", "2"), "stride"),
        (("--plane.threshold-m", "0.2"), "plane.threshold_m"),
    ):
        outcome = cli(*map_words(scene_folder, cut_run, "--resume", *words))
        assert outcome.status == 2
        assert name in outcome.error
    assert contents(cut_run) == before


@pytest.mark.slow
def test_another_sequence_is_refused(cli, scene_copy, cut_run):
    outcome = cli(*map_words(scene_copy, cut_run, "--resume"))
    assert outcome.status == 2
    assert "sequence" in outcome.error


@pytest.mark.slow
def test_how_often_to_save_is_no_setting_of_the_map(cli, scene_folder, cut_run):
    outcome = cli(*map_words(scene_folder, cut_run, "--resume", "--checkpoint-every-s", "5"))
    assert outcome.status == 0


@pytest.mark.slow
def test_frames_that_are_gone_since_are_noticed(cli, scene_copy, tmp_path):
    """The log counts frames by their index, so the frames must still be those of then."""
    rows = (scene_copy / "times.txt").read_text().splitlines()
    run_until(scene_copy, tmp_path / "run", 4)
    (scene_copy / "times.txt").write_text("\n".join(rows[1:]))
    (scene_copy / "left" / "f000.png").unlink()
    outcome = cli(*map_words(scene_copy, tmp_path / "run", "--resume"))
    assert outcome.status != 0, "f004 was never fused, and f000 is counted"


@pytest.mark.slow
def test_a_sequence_that_grew_does_not_go_on_in_too_small_a_map(cli, scene_folder, tmp_path):
    """Automatic bounds follow the poses, but the map that was saved keeps its own."""
    short = write_folder_sequence(tmp_path / "scene", 3)
    outcome = cli("map", short, "--out", tmp_path / "run", "--labeller", "none", "--grid.voxel-size-m", "0.2")
    assert outcome.status == 0
    shutil.rmtree(short)
    shutil.copytree(scene_folder, short)
    outcome = cli(
        "map", short, "--out", tmp_path / "run", "--labeller", "none", "--grid.voxel-size-m", "0.2", "--resume"
    )
    assert "fault of jaxmap" not in outcome.err
    if outcome.status == 0:
        shape = load_map(tmp_path / "run" / "map.zarr")[0].log_odds.shape[1:]
        assert metrics_of(tmp_path / "run")["sequence"]["fused"] == FRAMES
        assert list(shape) == metrics_of(tmp_path / "run")["grid"]["shape"]


def test_a_used_folder_is_left_alone(cli, scene_folder, cut_run):
    before = contents(cut_run)
    outcome = cli(*map_words(scene_folder, cut_run))
    assert outcome.status == 1
    assert all(way in outcome.error for way in ("--resume", "--overwrite", str(cut_run)))
    assert contents(cut_run) == before


@pytest.mark.slow
def test_overwriting_removes_what_an_earlier_run_has_written(cli, scene_folder, tmp_path):
    run = tmp_path / "run"
    assert cli(*map_words(scene_folder, run)).status == 0
    (run / "mine.txt").write_text("not the run's")
    old = contents(run / "pictures").keys()
    assert cli(*map_words(scene_folder, run, "--overwrite", "--labeller", "none", "--stop", "1")).status == 0
    assert metrics_of(run)["sequence"]["fused"] == 1
    assert log_odds(run).shape[0] == 1
    assert {path.name for path in (run / "pictures").iterdir()} == {"000000_left.png", "000000_disparity.png"}
    assert len(old) > 2
    assert (run / "mine.txt").read_text() == "not the run's"


@pytest.fixture
def earlier_run(finished_run, tmp_path):
    """A folder that holds a run already."""
    run = Path(shutil.copytree(finished_run, tmp_path / "run"))
    (run / "map.ply").write_text("of the earlier run")
    return run


def test_a_run_that_fuses_nothing_leaves_the_one_it_was_to_replace(cli, scene_copy, earlier_run):
    before = contents(earlier_run)
    for image in (scene_copy / "right").iterdir():
        image.write_bytes(b"")
    outcome = cli(*map_words(scene_copy, earlier_run, "--overwrite"))
    assert outcome.status == 1
    assert contents(earlier_run) == before and not (earlier_run / ".new").exists()


@pytest.mark.slow
def test_an_overwriting_run_that_was_cut_off_is_gone_on_with(cli, scene_folder, finished_run, earlier_run):
    before = contents(earlier_run)
    run_until(scene_folder, earlier_run, 3, overwrite=True)
    assert {path: text for path, text in contents(earlier_run).items() if ".new" not in path.parts} == before
    outcome = cli(*map_words(scene_folder, earlier_run, "--resume", "--stride", "2"))
    assert outcome.status == 2 and "another stride" in outcome.error
    outcome = cli(*map_words(scene_folder, earlier_run))
    assert outcome.status == 1 and "holds a run already" in outcome.error
    outcome = cli(*map_words(scene_folder, earlier_run, "--resume"))
    assert outcome.status == 0 and "going on after 3" in outcome.err
    assert_same_run(earlier_run, finished_run)
    assert not [path for path in earlier_run.iterdir() if path.name.startswith(".")]


@pytest.mark.slow
def test_an_overwriting_run_that_is_killed_leaves_the_one_before_it(cli, scene_folder, finished_run, earlier_run):
    before = contents(earlier_run)
    words = map_words(scene_folder, earlier_run, "--overwrite", "--checkpoint-every-s", "0")
    kill_when((earlier_run / ".new" / "map.zarr").exists, SLOW_DISK, words)
    assert before.items() <= contents(earlier_run).items()
    assert cli(*map_words(scene_folder, earlier_run, "--resume")).status == 0
    assert_same_run(earlier_run, finished_run)


def test_a_run_that_was_whole_when_its_process_was_killed_is_put_in_place(cli, finished_run, earlier_run):
    shutil.copytree(finished_run, earlier_run / ".whole")
    assert cli("report", earlier_run).status == 0
    assert_same_run(earlier_run, finished_run)


@pytest.mark.slow
def test_overwriting_and_resuming_exclude_each_other(cli, scene_folder, cut_run):
    outcome = cli(*map_words(scene_folder, cut_run, "--resume", "--overwrite"))
    assert outcome.status == 2, "one of the two is not done"


@pytest.mark.slow
def test_a_complete_run_is_gone_on_with_to_the_same_end(cli, scene_folder, finished_run, tmp_path):
    run = tmp_path / "run"
    assert cli(*map_words(scene_folder, run)).status == 0
    (run / "map.ply").unlink()
    outcome = cli(*map_words(scene_folder, run, "--resume"))
    assert outcome.status == 0
    assert "complete already" in outcome.err
    assert_same_run(run, finished_run)


@pytest.mark.slow
def test_resuming_in_an_empty_folder_starts(cli, scene_folder, finished_run, tmp_path):
    (tmp_path / "run").mkdir()
    assert cli(*map_words(scene_folder, tmp_path / "run", "--resume")).status == 0
    assert_same_run(tmp_path / "run", finished_run)


def test_a_damaged_checkpoint_is_an_error_and_is_kept(cli, scene_folder, cut_run):
    chunk = max((cut_run / "map.zarr").rglob("*"), key=lambda path: path.stat().st_size * path.is_file())
    chunk.write_bytes(chunk.read_bytes()[:-20] + bytes(20))
    before = contents(cut_run)
    outcome = cli(*map_words(scene_folder, cut_run, "--resume"))
    assert outcome.status == 1
    assert "map.zarr" in outcome.error
    assert contents(cut_run) == before


@pytest.mark.slow
def test_a_full_disk_leaves_the_last_checkpoint(cli, scene_folder, finished_run, tmp_path, monkeypatch):
    write, saves = map_store._write_group, []

    def write_twice(folder: Path, *content: object) -> None:
        saves.append(folder)
        write(folder, *content)
        if len(saves) > 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(map_store, "_write_group", write_twice)
        outcome = cli(*map_words(scene_folder, tmp_path / "run", "--checkpoint-every-s", "0"))
    assert outcome.status == 1
    assert "disk full" in outcome.error
    assert "map.zarr" in outcome.error
    assert load_map(tmp_path / "run" / "map.zarr")[1].progress["next_index"] == 2
    assert not (tmp_path / "run" / "metrics.json").exists()
    assert cli(*map_words(scene_folder, tmp_path / "run", "--resume")).status == 0
    assert_same_run(tmp_path / "run", finished_run)


@pytest.mark.slow
@pytest.mark.parametrize("writer", ["write_exports", "write_poses"])
def test_a_full_disk_at_the_end_leaves_a_map_to_resume(writer, cli, scene_folder, finished_run, tmp_path, monkeypatch):
    import jaxmap.runs.mapping

    def full(*_: object, **__: object) -> None:
        raise JaxmapError("disk full", where="bev.tif", fix="free some space or write to another disk")

    with monkeypatch.context() as patched:
        patched.setattr(jaxmap.runs.mapping, writer, full)
        assert cli(*map_words(scene_folder, tmp_path / "run")).status == 1
    assert cli(*map_words(scene_folder, tmp_path / "run", "--resume")).status == 0
    assert_same_run(tmp_path / "run", finished_run)


@pytest.mark.slow
@pytest.mark.parametrize("interrupted", [None, 3])
def test_a_map_in_tiles_has_the_bits_of_the_whole_one(scene_folder, tmp_path, interrupted):
    words = {"grid": {"voxel_size_m": 0.05, "lower_m": [-8, -8, -2], "upper_m": [16, 16, 2]}, "labeller": "plane"}
    whole_config = config_of(**words)
    plan = plan_run(str(scene_folder), whole_config, lambda line: None, in_tiles=True)
    assert plan.block_shape is None
    folder = RunFolder(tmp_path / "whole")
    folder.begin(plan.settings(whole_config), resume=False, overwrite=False)
    run_plan(plan, folder, strict=True, checkpoint_every_s=60.0, notify=lambda line: None, report=False)

    limit_gib = map_bytes(plan.grid, len(plan.labeller.classes)) / 2**30 * 0.9
    tiled_config = config_of(**words | {"grid": {**words["grid"], "max_memory_gib": limit_gib}})
    plan = plan_run(str(scene_folder), tiled_config, lambda line: None, in_tiles=True)
    assert plan.block_shape is not None
    assert np.prod(plan.block_shape) < np.prod(plan.grid.shape)
    tiled = RunFolder(tmp_path / "tiled")
    tiled.begin(plan.settings(tiled_config), resume=False, overwrite=False)

    def interrupt(fused):
        if fused.prepared.index == interrupted:
            raise KeyboardInterrupt

    with suppress(KeyboardInterrupt):
        run_plan(plan, tiled, strict=True, checkpoint_every_s=0.0, notify=print, on_frame=interrupt, report=False)
    if interrupted is not None:
        plan = plan_run(str(scene_folder), tiled_config, lambda line: None, in_tiles=True)
        run_plan(plan, tiled, strict=True, checkpoint_every_s=0.0, notify=print, report=False)
    expected, _ = load_map(folder.map)
    found, _ = load_map(tiled.map)
    assert_same_bits(found, expected)
    assert found.surface is not None and found.surface.any()
    assert open_map(tiled.map).attributes.progress["complete"]
    assert check_same_layers(tiled.map, folder.map) > 100
