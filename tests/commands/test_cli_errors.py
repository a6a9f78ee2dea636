"""Every faulty input ends in one line that says what, where and what to do, and in the right exit status.

The lines are kept in snapshots/cli_errors.txt; JAXMAP_UPDATE_SNAPSHOTS=1 pytest tests/commands/test_cli_errors.py
writes them anew.
"""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from faults import MAP_FAULTS, nan_pose, truncated
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
from network_faults import IMPORT_FAULTS, SEGMENT_FAULTS, segment_words, write_inputs
from training_data import CLASSES, TRAIN_FAULTS, write_data
from tune_faults import TUNE_FAULTS

import jaxmap
from jaxmap.commands import COMMANDS

SNAPSHOT = Path(__file__).parents[1] / "snapshots" / "cli_errors.txt"

NAMED = {
    "one pair of another size": "f003",
    "left and right of different size": "f000",
    "label of another size": "f000.png",
    "missing right image": "f002.png",
    "NaN pose": "line 4",
}
"""What an error must name."""


@pytest.fixture(scope="module")
def told():
    """Collects the lines of all cases; they are written at the end where that is asked for."""
    lines: dict[str, str] = {}
    yield lines
    if os.environ.get("JAXMAP_UPDATE_SNAPSHOTS"):
        SNAPSHOT.parent.mkdir(exist_ok=True)
        SNAPSHOT.write_text("".join(f"{name}\n    {line}\n" for name, line in sorted({**kept(), **lines}.items())))


def kept() -> dict[str, str]:
    lines = SNAPSHOT.read_text().splitlines() if SNAPSHOT.exists() else []
    return {name: line.strip() for name, line in zip(lines[::2], lines[1::2], strict=True)}


def compare(name: str, line: str, tmp_path: Path, told: dict[str, str]) -> None:
    line = line.replace(str(tmp_path), "<tmp>")
    # The decoders' own words differ from version to version.
    words = "image file is truncated|unrecognized data stream|broken PNG|Error while deserializing"
    told[name] = re.sub(rf"\(({words})[^;]*\)", "(<decoder>)", line)
    if not os.environ.get("JAXMAP_UPDATE_SNAPSHOTS"):
        assert told[name] == kept().get(name, "JAXMAP_UPDATE_SNAPSHOTS=1 writes it")


@pytest.mark.parametrize("name", MAP_FAULTS)
def test_a_fault_of_map_is_one_line(name, scene_copy, tmp_path, cli, told, monkeypatch):
    monkeypatch.chdir(tmp_path)
    expected, damage = MAP_FAULTS[name]
    words = damage(scene_copy, tmp_path) or []
    outcome = cli(*map_words(scene_copy, tmp_path / "run", *words))
    assert outcome.status == expected, outcome
    assert "fault of jaxmap" not in outcome.error
    assert len(outcome.error) < 400
    assert ";" in outcome.error, "says what to do"
    assert NAMED.get(name, "") in outcome.error, "says where"
    assert not (tmp_path / "run" / "metrics.json").exists()
    compare(name, f"{outcome.status} {outcome.error}", tmp_path, told)


def files_of(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", SEGMENT_FAULTS)
def test_a_fault_of_segment_is_one_line(name, tmp_path, cli, told):
    expected, spoil = SEGMENT_FAULTS[name]
    more = spoil(write_inputs(tmp_path)) or []
    before = files_of(tmp_path)
    outcome = cli(*segment_words(tmp_path, *more))
    assert outcome.status == expected, outcome
    assert "fault of jaxmap" not in outcome.error
    assert ";" in outcome.error, "says what to do"
    compare(name, f"{outcome.status} {outcome.error}", tmp_path, told)
    assert files_of(tmp_path) == before, "nothing is written and no input is touched"


@pytest.mark.parametrize("name", IMPORT_FAULTS)
def test_a_fault_of_weights_is_one_line(name, tmp_path, cli, told):
    expected, make = IMPORT_FAULTS[name]
    words = make(tmp_path)
    before = files_of(tmp_path)
    outcome = cli(*words)
    assert outcome.status == expected, outcome
    assert "fault of jaxmap" not in outcome.error
    assert ";" in outcome.error, "says what to do"
    assert len(outcome.error) < 600
    compare(name, f"{outcome.status} {outcome.error}", tmp_path, told)
    assert files_of(tmp_path) == before, "nothing is written and no input is touched"


@pytest.mark.parametrize("name", TRAIN_FAULTS)
def test_a_fault_of_train_is_one_line(name, tmp_path, cli, told, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = write_data(tmp_path / "data")
    expected, spoil = TRAIN_FAULTS[name]
    words = spoil(data, tmp_path) or []
    before = files_of(tmp_path)
    classes = () if "--classes" in words or "--config" in words else ("--classes", *CLASSES)
    outcome = cli("train", data, "--out", tmp_path / "run", *classes, *words)
    assert outcome.status == expected, outcome
    assert "fault of jaxmap" not in outcome.error
    assert len(outcome.error) < 400
    assert ";" in outcome.error, "says what to do"
    compare(f"train: {name}", f"{outcome.status} {outcome.error}", tmp_path, told)
    assert files_of(tmp_path) == before, "nothing is written and no input is touched"


def test_a_batch_that_the_devices_cannot_share_is_one_line(tmp_path, cli, told, monkeypatch):
    import jax

    monkeypatch.setattr(jax, "local_device_count", lambda: 3)
    data = write_data(tmp_path / "data")
    outcome = cli("train", data, "--out", tmp_path / "run", "--classes", *CLASSES, "--batch-size", "8")
    assert outcome.status == 2
    compare("train: batch not shared by the devices", f"{outcome.status} {outcome.error}", tmp_path, told)


@pytest.mark.parametrize("name", TUNE_FAULTS)
def test_a_fault_of_tune_is_one_line(name, scene_folder, tmp_path, cli, told):
    expected, damage = TUNE_FAULTS[name]
    words = damage(scene_folder, tmp_path)
    before = files_of(tmp_path)
    outcome = cli(*words)
    assert outcome.status == expected, outcome
    assert "fault of jaxmap" not in outcome.error
    assert len(outcome.error) < 400
    assert ";" in outcome.error, "says what to do"
    assert files_of(tmp_path) == before
    compare(name, f"{outcome.status} {outcome.error}".replace(str(scene_folder), "<scene>"), tmp_path, told)


def faulty_command(name: str, tmp_path: Path, finished: Path) -> tuple[int, list[str]]:
    """Faults that need no damaged sequence: exit status and words."""
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    newer = Path(shutil.copytree(finished, tmp_path / "newer"))
    group = newer / "map.zarr" / "zarr.json"
    tree = json.loads(group.read_text())
    tree["attributes"]["format_version"] += 1
    group.write_text(json.dumps(tree))
    no_metrics = Path(shutil.copytree(finished, tmp_path / "no_metrics"))
    (no_metrics / "metrics.json").unlink()
    sample = ["map", "sample:motorcycle", "--out", str(tmp_path / "run")]
    return {
        "no such folder": (1, ["map", str(tmp_path / "nowhere"), "--out", str(tmp_path / "run")]),
        "a file for a folder": (1, ["map", str(tmp_path / "file"), "--out", str(tmp_path / "run")]),
        "an empty folder": (1, ["map", str(tmp_path / "empty"), "--out", str(tmp_path / "run")]),
        "unknown sample": (1, ["map", "sample:car", "--out", str(tmp_path / "run")]),
        "a sample as a data set": (2, [*sample, "--dataset", "kitti"]),
        "one bound alone": (2, [*sample, "--grid.lower-m", "0", "0", "0"]),
        "out is a file": (1, ["map", "sample:motorcycle", "--out", str(tmp_path / "file")]),
        "out lies in a file": (1, ["map", "sample:motorcycle", "--out", str(tmp_path / "file" / "run")]),
        "export of a newer map": (1, ["export", str(newer)]),
        "report of a newer map": (1, ["report", str(newer)]),
        "export of no run": (1, ["export", str(tmp_path / "empty")]),
        "report of no run": (1, ["report", str(tmp_path / "empty")]),
        "report of no folder": (1, ["report", str(tmp_path / "nowhere")]),
        "report without metrics": (1, ["report", str(no_metrics)]),
        "unknown command": (2, ["mapp"]),
        "segment without images": (2, ["segment", "--model", "m.safetensors", "--out", "out"]),
        "scores without masks": (
            2,
            ["segment", "a.png", "--model", "m.safetensors", "--out", "out", "--scores", "scores.json"],
        ),
    }[name]


@pytest.mark.parametrize(
    "name",
    [
        "no such folder",
        "a file for a folder",
        "an empty folder",
        "unknown sample",
        "a sample as a data set",
        "one bound alone",
        "out is a file",
        "out lies in a file",
        "export of a newer map",
        "report of a newer map",
        "export of no run",
        "report of no run",
        "report of no folder",
        "report without metrics",
        "unknown command",
        "segment without images",
        "scores without masks",
    ],
)
def test_a_wrong_command_is_one_line(name, tmp_path, finished_run, cli, told):
    expected, words = faulty_command(name, tmp_path, finished_run)
    before = {path.name: path.read_bytes() for path in (tmp_path / "newer").iterdir() if path.is_file()}
    outcome = cli(*words)
    assert outcome.status == expected, outcome
    assert "fault of jaxmap" not in outcome.error
    compare(name, f"{outcome.status} {outcome.error}", tmp_path, told)
    assert before == {path.name: path.read_bytes() for path in (tmp_path / "newer").iterdir() if path.is_file()}
    assert (tmp_path / "file").read_text() == ""
    assert list((tmp_path / "empty").iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [
        ("map",),
        ("map", "sample:motorcycle"),
        ("map", "sample:motorcycle", "--out", "run", "--no-such-option"),
        ("map", "sample:motorcycle", "--out", "run", "--stride", "two"),
        ("map", "sample:motorcycle", "--out", "run", "--labeller", "oracle"),
        ("map", "sample:motorcycle", "--out", "run", "--config"),
        ("map", "sample:motorcycle", "--out", "run", "--deeplab.class-map", "car"),
        ("export",),
        ("export", "run", "--format", "stl"),
        ("segment", "a.png"),
        ("segment", "a.png", "--model", "m.safetensors", "--out", "out", "--size", "64"),
        ("weights", "import", "a.pth"),
        ("weights", "import", "a.pth", "--out", "m.safetensors", "--output-stride", "4"),
        ("weights", "fetch"),
    ],
)
def test_what_the_parser_refuses_has_status_2(words, cli, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = cli(*words)
    assert outcome.status == 2
    assert outcome.err
    assert "Traceback" not in outcome.err
    assert list(tmp_path.iterdir()) == []


def test_no_arguments_show_the_commands_with_status_2(cli):
    outcome = cli()
    assert outcome.status == 2
    assert "usage: jaxmap COMMAND" in outcome.out + outcome.err


def test_every_unknown_key_is_named(cli, scene_folder, tmp_path):
    (tmp_path / "mine.yaml").write_text("gird: {}\ngrid: {size: 1}\nfusion: {carved: true}\n")
    outcome = cli(*map_words(scene_folder, tmp_path / "run", "--config", tmp_path / "mine.yaml"))
    assert all(key in outcome.error for key in ("gird", "grid.size", "fusion.carved"))


def test_a_faulty_frame_without_strict_is_told_and_passed_over(cli, scene_copy, tmp_path):
    truncated(scene_copy, tmp_path)
    outcome = cli(*map_words(scene_copy, tmp_path / "run"))
    assert outcome.status == 0
    assert "5 of 6 frames fused" in outcome.err
    assert "skipped f001: " in outcome.err
    assert str(scene_copy / "left" / "f001.png") in outcome.err


def test_a_faulty_input_leaves_the_run_that_is_there(cli, scene_copy, finished_run, tmp_path):
    run = Path(shutil.copytree(finished_run, tmp_path / "run"))
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    nan_pose(scene_copy, tmp_path)
    for words in (("--overwrite",), ("--resume",), ("--overwrite", "--grid.max-memory-gib", "1e-4")):
        assert cli(*map_words(scene_copy, run, *words)).status == 1
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


def test_a_fault_of_our_own_is_one_line_too(cli, scene_folder, tmp_path, monkeypatch):
    import jaxmap.runs.mapping_plan

    def broken(*_: object) -> None:
        raise ZeroDivisionError("one\ntwo")

    monkeypatch.setattr(jaxmap.runs.mapping_plan, "plan_run", broken)
    outcome = cli(*map_words(scene_folder, tmp_path / "run"))
    assert outcome.status == 1
    assert "ZeroDivisionError: one two" in outcome.error
    assert "--debug" in outcome.error


def test_an_interrupt_is_one_line(cli, scene_folder, tmp_path, monkeypatch):
    import jaxmap.runs.mapping_plan

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(jaxmap.runs.mapping_plan, "plan_run", interrupted)
    outcome = cli(*map_words(scene_folder, tmp_path / "run"))
    assert outcome.status == 130
    assert outcome.error == "interrupted"


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


def as_program(*words: object) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(Path(jaxmap.__file__).parents[1])}
    program = [sys.executable, "-m", "jaxmap", *map(str, words)]
    return subprocess.run(program, capture_output=True, text=True, env=environment, check=False)


def test_more_voxels_than_64_bits_can_count_are_refused(scene_folder, tmp_path):
    """In a process of its own: an allocation that wraps round aborts the interpreter."""
    result = as_program(*map_words(scene_folder, tmp_path / "run", "--grid.voxel-size-m", "1e-6"))
    assert result.returncode == 1
    assert result.stderr.splitlines()[-1].startswith("error: a map of 4000000 x 5200000 x 1500000 voxels takes")


def test_debug_shows_the_traceback():
    plain, debug = (as_program("map", "nowhere", "--out", "nothing", *more) for more in ((), ("--debug",)))
    assert (plain.returncode, debug.returncode) == (1, 1)
    assert plain.stderr.startswith("error: ")
    assert plain.stderr.count("\n") == 1
    assert "Traceback" in debug.stderr
    assert "JaxmapError" in debug.stderr
