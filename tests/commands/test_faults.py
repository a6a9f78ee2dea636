"""Faults where they arise: each raises a JaxmapError that says what, where and what to do; nothing is written.

Their texts are kept in snapshots/faults.txt; JAXMAP_UPDATE_SNAPSHOTS=1 pytest -n 0 tests/commands/test_faults.py writes
them anew. How an error of any of them reaches the user is the subject of test_cli_errors.py.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax
import pytest
from faults import CONFIG_FAULTS, FRAME_FAULTS, SEQUENCE_FAULTS, SETTINGS_FAULTS
from fixtures import scene_copy, scene_folder, shared_cache  # noqa: F401
from kept_texts import KeptTexts
from network_faults import IMPORT_FAULTS, SEGMENT_FAULTS, segment_words, write_inputs
from planned_runs import planned
from training_data import CLASSES, TRAIN_FAULTS, write_data
from tune_faults import TUNE_FAULTS

import jaxmap.commands.export
import jaxmap.commands.report
import jaxmap.commands.segment
import jaxmap.commands.train
import jaxmap.commands.tune
import jaxmap.commands.weights
from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.errors import JaxmapError
from jaxmap.host.output_folder import locked
from jaxmap.mapping.sequence import prepare_frames
from jaxmap.runs.config import load_config

TEXTS = KeptTexts("faults.txt")

NAMED = {
    "one pair of another size": "f003",
    "left and right of different size": "f000",
    "label of another size": "f000.png",
    "missing right image": "f002.png",
    "pose with a word": "line 4",
    "NaN pose, strictly": "line 4",
}
"""What an error must name."""


def check_fault(name: str, status: int, call: Callable[[], object], most: int = 400, **folders: Path) -> None:
    """Calls what must raise, in at most so many letters, and compares the text with the one that is kept."""
    with pytest.raises(JaxmapError) as caught:
        call()
    error = caught.value
    assert error.exit_code == status, error
    assert error.what and error.fix, "says what is wrong and what to do"
    assert NAMED.get(name, "") in str(error), "says where"
    assert len(str(error)) < most
    TEXTS.compare(name, f"{status} {error}", **folders)


def files_of(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", SEQUENCE_FAULTS)
def test_opening_a_sequence(name, scene_copy, tmp_path):
    status, damage = SEQUENCE_FAULTS[name]
    options = ReadOptions(**(damage(scene_copy, tmp_path) or {}))
    check_fault(name, status, lambda: open_sequence(scene_copy, options), tmp=tmp_path)


def test_opening_what_is_no_sequence(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    faults = {
        "no such folder": (1, tmp_path / "nowhere", "auto"),
        "a file for a folder": (1, tmp_path / "file", "auto"),
        "an empty folder": (1, tmp_path / "empty", "auto"),
        "unknown sample": (1, "sample:car", "auto"),
        "a sample as a data set": (2, "sample:motorcycle", "kitti"),
    }
    for name, (status, source, dataset) in faults.items():
        options = ReadOptions(dataset=dataset)
        check_fault(name, status, lambda source=source, options=options: open_sequence(source, options), tmp=tmp_path)


@pytest.mark.parametrize("name", FRAME_FAULTS)
def test_reading_a_frame(name, scene_copy, tmp_path):
    status, damage = FRAME_FAULTS[name]
    plan = planned(scene_copy, **(damage(scene_copy, tmp_path) or {}))

    def read_all() -> None:
        for prepared in prepare_frames(plan.sequence, plan.front_end, plan.label_folder):
            if prepared.fault is not None:
                raise prepared.fault

    check_fault(name, status, read_all, tmp=tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", SETTINGS_FAULTS)
def test_planning_a_map(name, scene_copy, tmp_path):
    status, damage = SETTINGS_FAULTS[name]
    settings = damage(scene_copy, tmp_path) or {}
    check_fault(name, status, lambda: planned(scene_copy, **settings), tmp=tmp_path)


@pytest.mark.parametrize("name", CONFIG_FAULTS)
def test_reading_a_config(name, tmp_path):
    (tmp_path / "mine.yaml").write_text(CONFIG_FAULTS[name])
    check_fault(name, 2, lambda: load_config(str(tmp_path / "mine.yaml")), tmp=tmp_path)


def test_naming_a_config_that_is_not_there():
    check_fault("unknown config", 2, lambda: load_config("chiodini2019"))


def test_every_unknown_key_is_named(tmp_path):
    (tmp_path / "mine.yaml").write_text("gird: {}\ngrid: {size: 1}\nfusion: {carved: true}\n")
    with pytest.raises(JaxmapError) as caught:
        load_config(str(tmp_path / "mine.yaml"))
    assert all(key in str(caught.value) for key in ("gird", "grid.size", "fusion.carved"))


def test_writing_into_what_is_no_folder(tmp_path):
    (tmp_path / "file").write_text("")
    for name, out in (("out is a file", tmp_path / "file"), ("out lies in a file", tmp_path / "file" / "run")):
        check_fault(name, 1, locked(out).__enter__, tmp=tmp_path)
    assert (tmp_path / "file").read_text() == ""


def test_reading_what_is_no_run(tmp_path):
    (tmp_path / "empty").mkdir()
    export, report = jaxmap.commands.export.main, jaxmap.commands.report.main
    check_fault("export of no run", 1, lambda: export([str(tmp_path / "empty")]), tmp=tmp_path)
    check_fault("report of no run", 1, lambda: report([str(tmp_path / "empty")]), tmp=tmp_path)
    check_fault("report of no folder", 1, lambda: report([str(tmp_path / "nowhere")]), tmp=tmp_path)
    assert list((tmp_path / "empty").iterdir()) == []


@pytest.mark.parametrize("name", SEGMENT_FAULTS)
def test_segmenting(name, tmp_path):
    status, spoil = SEGMENT_FAULTS[name]
    words = segment_words(tmp_path, *(spoil(write_inputs(tmp_path)) or []))
    before = files_of(tmp_path)
    check_fault(name, status, lambda: jaxmap.commands.segment.main(words[1:]), 800, tmp=tmp_path)
    assert files_of(tmp_path) == before, "nothing is written and no input is touched"


@pytest.mark.parametrize("name", IMPORT_FAULTS)
def test_importing_weights(name, tmp_path):
    status, make = IMPORT_FAULTS[name]
    words = make(tmp_path)
    before = files_of(tmp_path)
    check_fault(name, status, lambda: jaxmap.commands.weights.main(words[1:]), 600, tmp=tmp_path)
    assert files_of(tmp_path) == before, "nothing is written and no input is touched"


def train_words(data: Path, out: Path, words: list[str]) -> list[str]:
    classes = () if "--classes" in words or "--config" in words else ("--classes", *CLASSES)
    return [str(word) for word in (data, "--out", out, *classes, *words)]


@pytest.mark.parametrize("name", TRAIN_FAULTS)
def test_training(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = write_data(tmp_path / "data")
    status, spoil = TRAIN_FAULTS[name]
    words = train_words(data, tmp_path / "run", spoil(data, tmp_path) or [])
    before = files_of(tmp_path)
    check_fault(f"train: {name}", status, lambda: jaxmap.commands.train.main(words), tmp=tmp_path)
    assert files_of(tmp_path) == before, "nothing is written and no input is touched"


def test_training_a_batch_that_the_devices_cannot_share(tmp_path, monkeypatch):
    monkeypatch.setattr(jax, "local_device_count", lambda: 3)
    words = train_words(write_data(tmp_path / "data"), tmp_path / "run", ["--batch-size", "8"])
    check_fault("train: batch not shared by the devices", 2, lambda: jaxmap.commands.train.main(words), tmp=tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", TUNE_FAULTS)
def test_tuning(name, scene_folder, tmp_path):
    status, damage = TUNE_FAULTS[name]
    words = [*damage(scene_folder, tmp_path), "--stop", "2"]
    before = files_of(tmp_path)
    check_fault(name, status, lambda: jaxmap.commands.tune.main(words[1:]), tmp=tmp_path, scene=scene_folder)
    assert files_of(tmp_path) == before, "nothing is written and no input is touched"


def test_the_kept_texts_are_those_of_the_faults():
    tables = (SEQUENCE_FAULTS, FRAME_FAULTS, SETTINGS_FAULTS, CONFIG_FAULTS, SEGMENT_FAULTS, IMPORT_FAULTS, TUNE_FAULTS)
    here = {
        *("no such folder", "a file for a folder", "an empty folder", "unknown sample", "a sample as a data set"),
        *("unknown config", "out is a file", "out lies in a file", "train: batch not shared by the devices"),
        *("export of no run", "report of no run", "report of no folder"),
    }
    assert TEXTS.names == here.union(*tables, (f"train: {name}" for name in TRAIN_FAULTS))
