"""An error of any command is one line that says what, where and what to do, and has the right exit status.

About twenty faults, of every command and both exit statuses, go through the whole command line; all others are tested
where they arise (test_faults.py). The lines are kept in snapshots/cli_errors.txt; JAXMAP_UPDATE_SNAPSHOTS=1 pytest -n 0
tests/commands/test_cli_errors.py writes them anew.
"""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from faults import all_unreadable, truncated, worded_pose
from fixtures import (
    cli,  # noqa: F401
    finished_run,  # noqa: F401
    map_words,
    named_options,
    options_of,
    scene_copy,  # noqa: F401
    scene_folder,  # noqa: F401
    shared_cache,  # noqa: F401
    unknown_options,
)
from kept_texts import KeptTexts
from network_faults import IMPORT_FAULTS, SEGMENT_FAULTS, segment_words, write_inputs
from training_data import TRAIN_FAULTS, write_data
from tune_faults import TUNE_FAULTS

import jaxmap
from jaxmap.commands import COMMANDS

TEXTS = KeptTexts("cli_errors.txt")


class Given(NamedTuple):
    """What a faulty command line may use: the scene, to be damaged; an empty folder; a finished run, to be read."""

    scene: Path
    folder: Path
    run: Path


def mapped(given: Given, *words: object, damage: Callable[[Path, Path], object] | None = None) -> list[str]:
    if damage is not None:
        damage(given.scene, given.folder)
    return map_words(given.scene, given.folder / "run", *words)


def config_of(given: Given, text: str) -> Path:
    (given.folder / "mine.yaml").write_text(text)
    return given.folder / "mine.yaml"


def newer(given: Given) -> Path:
    """The finished run, as a later version of jaxmap might write it."""
    run = Path(shutil.copytree(given.run, given.folder / "newer"))
    group = run / "map.zarr" / "zarr.json"
    tree = json.loads(group.read_text())
    tree["attributes"]["format_version"] += 1
    group.write_text(json.dumps(tree))
    return run


def copied(given: Given) -> Path:
    return Path(shutil.copytree(given.run, given.folder / "copy"))


def without_metrics(given: Given) -> Path:
    run = Path(shutil.copytree(given.run, given.folder / "no_metrics"))
    (run / "metrics.json").unlink()
    return run


def damaged_observations(given: Given) -> Path:
    folder = given.folder / "observations.zarr"
    folder.mkdir()
    (folder / "zarr.json").write_text('{"zarr_format": 3, "node_type": "group", "attributes": {}}')
    return folder


def below_a_file(given: Given) -> Path:
    (given.folder / "file").write_text("")
    return given.folder / "file" / "run"


def trained(given: Given, fault: str, *words: object) -> list[object]:
    data = write_data(given.folder / "data")
    return ["train", data, "--out", given.folder / "run", *(TRAIN_FAULTS[fault][1](data, given.folder) or []), *words]


ENDS = ("--start", 0, 0, "--goal", 1, 1)

FAULTS: dict[str, tuple[int, Callable[[Given], list]]] = {
    "unknown command": (2, lambda given: ["mapp"]),
    "check: no sequence": (1, lambda given: ["check", given.folder / "nowhere"]),
    "perceive: no sequence": (1, lambda given: ["perceive", given.folder / "nowhere", "--out", given.folder / "run"]),
    "map: damaged observations": (1, lambda given: ["map", damaged_observations(given), "--out", given.folder / "run"]),
    "map: pose with a word": (1, lambda given: mapped(given, damage=worded_pose)),
    "map: truncated image, strictly": (1, lambda given: mapped(given, "--strict", damage=truncated)),
    "map: all frames unreadable": (1, lambda given: mapped(given, damage=all_unreadable)),
    "map: out lies in a file": (1, lambda given: ["map", given.scene, "--out", below_a_file(given)]),
    "map: unknown key": (2, lambda given: mapped(given, "--config", config_of(given, "labeler: plane\n"))),
    "map: out of range": (2, lambda given: mapped(given, "--plane.threshold-m", "-1")),
    "view: no run": (1, lambda given: ["view", given.folder / "nowhere", "--save", given.folder / "f.rrd"]),
    "evaluate: no run": (1, lambda given: ["evaluate", given.folder / "nowhere", given.folder / "truth.tif"]),
    "plan: no run": (1, lambda given: ["plan", given.folder / "nowhere", *ENDS]),
    "plan: unknown rover": (2, lambda given: ["plan", given.run, *ENDS, "--rover", "sparrow"]),
    "explain: outside the map": (2, lambda given: ["explain", copied(given), "--at", "-900", "0"]),
    "merge: one run": (2, lambda given: ["merge", given.run, "--out", given.folder / "run"]),
    "export: newer map": (1, lambda given: ["export", newer(given)]),
    "report: no metrics": (1, lambda given: ["report", without_metrics(given)]),
    "demo: out lies in a file": (1, lambda given: ["demo", "--out", below_a_file(given)]),
    "segment: truncated model": (
        1,
        lambda given: segment_words(
            write_inputs(given.folder), *(SEGMENT_FAULTS["truncated model"][1](given.folder) or [])
        ),
    ),
    "segment: no images": (2, lambda given: ["segment", "--model", "m.safetensors", "--out", "out"]),
    "segment: scores without masks": (
        2,
        lambda given: ["segment", "a.png", "--model", "m.safetensors", "--out", "out", "--scores", "scores.json"],
    ),
    "weights: truncated checkpoint": (1, lambda given: IMPORT_FAULTS["truncated checkpoint"][1](given.folder)),
    "weights: unknown name": (2, lambda given: IMPORT_FAULTS["unknown public weights"][1](given.folder)),
    "train: one mask missing": (1, lambda given: trained(given, "one mask missing", "--classes", "sand", "rock")),
    "train: unknown keys in the config": (2, lambda given: trained(given, "unknown keys in the config")),
    "tune: no ground truth": (1, lambda given: TUNE_FAULTS["tune: truth missing"][1](given.scene, given.folder)),
    "tune: out is there": (2, lambda given: TUNE_FAULTS["tune: out is there"][1](given.scene, given.folder)),
    "refine: one frame": (1, lambda given: ["refine", given.scene, "--out", given.folder / "run", "--stop", 1]),
    "refine: out of range": (
        2,
        lambda given: ["refine", given.scene, "--out", given.folder / "run", "--sigma-position-m", -1],
    ),
    "simulate: out of range": (2, lambda given: ["simulate", "--out", given.folder / "run", "--frames", 0]),
}
"""The exit status and the words of each; `info` takes no input that could be wrong."""


BEGUN = {"map: truncated image, strictly", "map: all frames unreadable"}
"""Found when the run has begun: its folder holds its settings, and perhaps a checkpoint."""


def files_of(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_one_line(name, scene_copy, finished_run, tmp_path, cli, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, words = FAULTS[name]
    given = Given(scene_copy, tmp_path / "given", finished_run)
    given.folder.mkdir()
    words = words(given)
    before = files_of(tmp_path)
    outcome = cli(*words)
    assert outcome.status == status, outcome
    assert "fault of jaxmap" not in outcome.error
    assert ";" in outcome.error, "says what to do"
    assert len(outcome.error) < 600
    after = files_of(tmp_path)
    assert {path: after[path] for path in before} == before, "no input is touched"
    written = {path.name for path in after.keys() - before.keys()}
    assert not written or (name in BEGUN and "metrics.json" not in written), "no result is written"
    TEXTS.compare(name, f"{outcome.status} {outcome.error}", tmp=tmp_path)


def test_the_kept_texts_are_those_of_the_faults():
    assert TEXTS.names == FAULTS.keys()
    assert {name.split(":")[0] for name in FAULTS} == (COMMANDS.keys() | {"unknown command"}) - {"info"}


def test_what_the_parser_refuses_has_status_2(cli, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    to_map = ("map", "sample:motorcycle", "--out", "run")
    for words in (
        ("map",),
        (*to_map, "--no-such-option"),
        (*to_map, "--stride", "two"),
        (*to_map, "--labeller", "oracle"),
        (*to_map, "--config"),
        (*to_map, "--deeplab.class-map", "car"),
        ("info", "now"),
        ("export", "run", "--format", "stl"),
        ("segment", "a.png", "--model", "m.safetensors", "--out", "out", "--size", "64"),
        ("weights", "import", "a.pth", "--out", "m.safetensors", "--output-stride", "4"),
        ("weights", "fetch"),
    ):
        outcome = cli(*words)
        assert outcome.status == 2 and outcome.err, words
        assert "Traceback" not in outcome.err
    assert list(tmp_path.iterdir()) == []


def test_no_arguments_show_the_commands_with_status_2(cli):
    outcome = cli()
    assert outcome.status == 2
    assert "usage: jaxmap COMMAND" in outcome.out + outcome.err


@pytest.mark.slow
def test_a_faulty_frame_is_reported_and_skipped_unless_strict(cli, scene_copy, tmp_path):
    truncated(scene_copy, tmp_path)
    outcome = cli(*map_words(scene_copy, tmp_path / "run"))
    assert outcome.status == 0
    assert "5 of 6 frames fused" in outcome.err
    assert "skipped f001: " in outcome.err
    assert str(scene_copy / "left" / "f001.png") in outcome.err


def test_a_faulty_input_leaves_the_run_that_is_there(cli, scene_copy, finished_run, tmp_path):
    run = Path(shutil.copytree(finished_run, tmp_path / "run"))
    before = files_of(run)
    worded_pose(scene_copy, tmp_path)
    for words in (("--overwrite",), ("--resume",), ("--overwrite", "--grid.max-memory-gib", "1e-4")):
        assert cli(*map_words(scene_copy, run, *words)).status == 1
    assert files_of(run) == before


@pytest.mark.parametrize(
    ("raised", "status", "line"),
    [
        (ZeroDivisionError("one\ntwo"), 1, "ZeroDivisionError: one two; this is a fault of jaxmap: --debug"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_a_fault_of_our_own_and_an_interrupt_are_one_line_too(raised, status, line, cli, scene_folder, monkeypatch):
    def broken(*_: object, **options: object) -> None:
        raise raised

    monkeypatch.setattr("jaxmap.runs.mapping_plan.plan_run", broken)
    outcome = cli(*map_words(scene_folder, "run"))
    assert outcome.status == status
    assert outcome.error.startswith(line)


def raised_texts() -> Iterator[tuple[Path, str]]:
    """Every text that is handed to an error."""
    for path in Path(jaxmap.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("Error"):
                parts = (part.value for part in ast.walk(node) if isinstance(part, ast.Constant))
                yield from ((path, part) for part in parts if isinstance(part, str))


def test_an_error_names_only_options_that_some_command_has():
    known = frozenset().union(*map(options_of, COMMANDS))
    named = [(path.name, option) for path, text in raised_texts() for option in named_options(text)]
    assert len(named) > 50
    assert [one for one in named if one[1] not in known] == []


def test_options_of_another_command_are_found():
    assert unknown_options("error: no codes; name them: --remap 1=sand", "train") == {"--remap"}
    assert not unknown_options("error: no codes; name them: --map-truth.remap 1=sand", "train")
    assert not unknown_options("error: no CRS; say it with jaxmap map --crs", "evaluate")
    assert unknown_options("error: no CRS; say it with jaxmap map --remap", "evaluate") == {"--remap"}


def test_debug_shows_the_traceback():
    """In a process of its own, which also shows that the package runs as a program."""
    words = ["simulate", "--out", "nothing", "--frames", "0", "--debug"]
    environment = {**os.environ, "PYTHONPATH": str(Path(jaxmap.__file__).parents[1])}
    debug = subprocess.run(
        [sys.executable, "-m", "jaxmap", *words], capture_output=True, text=True, env=environment, check=False
    )
    assert debug.returncode == 1
    assert "Traceback" in debug.stderr
    assert "UsageError" in debug.stderr
