"""Every faulty input ends in one line that says what, where and what to do, and in the right exit status.

The lines are kept in snapshots/cli_errors.txt; JAXMAP_UPDATE_SNAPSHOTS=1 pytest tests/test_cli_errors.py
writes them anew.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from fixtures import cli, finished_run, map_words, scene_copy, scene_folder, shared_cache  # noqa: F401
from PIL import Image
from scenes import CAMERA

import jaxmap

SNAPSHOT = Path(__file__).parent / "snapshots" / "cli_errors.txt"

Damage = Callable[[Path, Path], list[str] | None]
"""Takes the scene and an empty folder, and returns words for the command line."""


def rewrite(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    path.write_text("".join(f"{line}\n" for line in change(path.read_text().splitlines())))


def with_camera(**changes: object) -> Damage:
    def damage(scene: Path, folder: Path) -> None:
        (scene / "camera.yaml").write_text(yaml.safe_dump({**CAMERA, **changes}))

    return damage


def with_yaml(text: str) -> Damage:
    def damage(scene: Path, folder: Path) -> list[str]:
        (folder / "mine.yaml").write_text(text)
        return ["--config", str(folder / "mine.yaml")]

    return damage


def with_words(*words: str) -> Damage:
    return lambda scene, folder: list(words)


def missing_right(scene: Path, folder: Path) -> list[str]:
    (scene / "right" / "f002.png").unlink()
    return ["--strict"]


def missing_left(scene: Path, folder: Path) -> None:
    (scene / "left" / "f002.png").unlink()


def truncated(scene: Path, folder: Path) -> list[str]:
    image = scene / "left" / "f001.png"
    image.write_bytes(image.read_bytes()[:4000])
    return ["--strict"]


def no_image(scene: Path, folder: Path) -> list[str]:
    (scene / "right" / "f000.png").write_bytes(b"no picture at all")
    return ["--strict"]


def smaller_right(scene: Path, folder: Path) -> list[str]:
    Image.fromarray(np.zeros((90, 160), np.uint8)).save(scene / "right" / "f000.png")
    return ["--strict"]


def smaller_pair(scene: Path, folder: Path) -> list[str]:
    for side in ("left", "right"):
        Image.fromarray(np.zeros((90, 160), np.uint8)).save(scene / side / "f003.png")
    return ["--strict"]


def all_unreadable(scene: Path, folder: Path) -> None:
    for image in (scene / "right").iterdir():
        image.write_bytes(b"no picture at all")


def times_back(scene: Path, folder: Path) -> None:
    rewrite(scene / "times.txt", lambda lines: [*lines[:2], lines[3], lines[2], *lines[4:]])


def pose_times_back(scene: Path, folder: Path) -> None:
    rewrite(scene / "poses.tum", lambda lines: [*lines[:2], lines[3], lines[2], *lines[4:]])


def no_times(scene: Path, folder: Path) -> None:
    (scene / "times.txt").unlink()
    rewrite(scene / "poses.tum", lambda lines: lines[:-1])


def nan_time(scene: Path, folder: Path) -> None:
    rewrite(scene / "times.txt", lambda lines: [*lines[:2], "nan", *lines[3:]])


def nan_pose(scene: Path, folder: Path) -> None:
    rewrite(scene / "poses.tum", lambda lines: [*lines[:3], re.sub(r" \S+", " nan", lines[3], count=1), *lines[4:]])


def long_quaternion(scene: Path, folder: Path) -> None:
    rewrite(scene / "poses.tum", lambda lines: [*lines[:3], lines[3].rsplit(" ", 1)[0] + " 3", *lines[4:]])


def skewed_pose(scene: Path, folder: Path) -> list[str]:
    rows = ["1 0 0 0 0 0 1 0 0 -1 0 1"] * 5 + ["1 0 0.4 0 0 0 1 0 0 -1 0 1"]
    (folder / "poses.txt").write_text("\n".join(rows))
    return ["--poses", str(folder / "poses.txt")]


def no_poses(scene: Path, folder: Path) -> None:
    (scene / "poses.tum").unlink()


def other_clock(scene: Path, folder: Path) -> None:
    rewrite(scene / "times.txt", lambda lines: [str(float(line) + 1000) for line in lines])


def no_calibration(scene: Path, folder: Path) -> None:
    (scene / "camera.yaml").unlink()


def swapped(scene: Path, folder: Path) -> None:
    (scene / "left").rename(scene / "aside")
    (scene / "right").rename(scene / "left")
    (scene / "aside").rename(scene / "right")


def no_images(scene: Path, folder: Path) -> None:
    for image in (scene / "left").iterdir():
        image.unlink()


def labels(damage: Callable[[Path], None]) -> Damage:
    def spoil(scene: Path, folder: Path) -> list[str]:
        damage(scene / "labels")
        return ["--labeller", "files", "--labels", str(scene / "labels"), "--strict"]

    return spoil


def missing_label(folder: Path) -> None:
    (folder / "f002.png").unlink()


def first_label_missing(folder: Path) -> None:
    (folder / "f000.png").unlink()


def small_label(folder: Path) -> None:
    Image.fromarray(np.zeros((60, 80), np.uint8)).save(folder / "f000.png")


def strange_label(folder: Path) -> None:
    Image.fromarray(np.full((120, 160), 7, np.uint8)).save(folder / "f000.png")


def colour_label(folder: Path) -> None:
    Image.fromarray(np.zeros((120, 160, 3), np.uint8)).save(folder / "f000.png")


def wild_probabilities(folder: Path) -> None:
    for file in list(folder.iterdir()):
        file.unlink()
        np.save(folder / f"{file.stem}.npy", np.full((120, 160, 3), 0.7, np.float32))


MAP_FAULTS: dict[str, tuple[int, Damage]] = {
    "missing right image": (1, missing_right),
    "missing left image": (1, missing_left),
    "truncated image": (1, truncated),
    "not an image": (1, no_image),
    "left and right of different size": (1, smaller_right),
    "one pair of another size": (1, smaller_pair),
    "all frames unreadable": (1, all_unreadable),
    "images of another size than the calibration": (1, with_camera(image_size_px=[320, 240])),
    "times not increasing": (1, times_back),
    "pose times not increasing": (1, pose_times_back),
    "no times": (1, no_times),
    "NaN time": (1, nan_time),
    "NaN pose": (1, nan_pose),
    "quaternion without unit norm": (1, long_quaternion),
    "non-rigid pose": (1, skewed_pose),
    "no poses": (1, no_poses),
    "poses of another clock": (1, other_clock),
    "no such pose file": (1, with_words("--poses", "nowhere/poses.tum")),
    "zero baseline": (1, with_camera(baseline_m=0.0)),
    "negative baseline": (1, with_camera(baseline_m=-0.12)),
    "NaN focal length": (1, with_camera(fx_px=float("nan"))),
    "no calibration": (1, no_calibration),
    "unknown calibration key": (1, with_camera(baseline=0.1)),
    "left and right swapped": (1, swapped),
    "no images": (1, no_images),
    "no frame selected": (1, with_words("--start", "9")),
    "unknown data set": (2, with_words("--dataset", "mars")),
    "another data set": (1, with_words("--dataset", "kitti")),
    "unknown keys in the config": (2, with_yaml("grid: {voxel_size: 0.1}\nlabeler: plane\n")),
    "out of range in the config": (2, with_yaml("fusion: {occupancy_prior: 1.5}\nstride: 0\n")),
    "NaN in the config": (2, with_yaml("depth: {max_m: .nan}\n")),
    "wrong type in the config": (2, with_yaml("grid: 3\n")),
    "keys that are no text in the config": (2, with_yaml("1.5: 3\nnull: 2\n")),
    "malformed YAML": (2, with_yaml("grid: [0.1\nstride: 1\n")),
    "a config that is a list": (2, with_yaml("- 1\n")),
    "unknown config": (2, with_words("--config", "chiodini2019")),
    "out of range on the command line": (2, with_words("--plane.threshold-m", "-1")),
    "unknown class": (2, with_words("--plane.off-plane", "boulder")),
    "nearest depth beyond the farthest": (2, with_words("--depth.min-m", "9")),
    "odd disparities": (2, with_words("--stereo.num-disparities", "20")),
    "even block": (2, with_words("--stereo.block-size", "4")),
    "matrix of another size": (2, with_yaml("fusion: {class_increments: [[1, 0], [0, 1]]}\n")),
    "penalties the wrong way round": (2, with_words("--stereo.p1", "9", "--stereo.p2", "3")),
    "too large a map": (1, with_words("--grid.max-memory-gib", "1e-4")),
    "voxels too small to be counted": (1, with_words("--grid.voxel-size-m", "1e-6")),
    "bounds the wrong way round": (2, with_words("--grid.lower-m", "3", "0", "0")),
    "files without a folder": (2, with_words("--labeller", "files")),
    "no such folder of labels": (1, with_words("--labeller", "files", "--labels", "nowhere")),
    "missing label": (1, labels(missing_label)),
    "first label missing": (1, labels(first_label_missing)),
    "label of another size": (1, labels(small_label)),
    "class out of range": (1, labels(strange_label)),
    "label in colours": (1, labels(colour_label)),
    "probabilities over 1": (1, labels(wild_probabilities)),
}


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
    # The decoder's own words differ from version to version.
    told[name] = re.sub(r"\((image file is truncated|unrecognized data stream|broken PNG)[^;]*\)", "(<decoder>)", line)
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
        ("export",),
        ("export", "run", "--format", "stl"),
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
    import jaxmap.mapping

    def broken(*_: object) -> None:
        raise ZeroDivisionError("one\ntwo")

    monkeypatch.setattr(jaxmap.mapping, "plan_run", broken)
    outcome = cli(*map_words(scene_folder, tmp_path / "run"))
    assert outcome.status == 1
    assert "ZeroDivisionError: one two" in outcome.error
    assert "--debug" in outcome.error


def test_an_interrupt_is_one_line(cli, scene_folder, tmp_path, monkeypatch):
    import jaxmap.mapping

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(jaxmap.mapping, "plan_run", interrupted)
    outcome = cli(*map_words(scene_folder, tmp_path / "run"))
    assert outcome.status == 130
    assert "--resume" in outcome.error


def test_debug_shows_the_traceback():
    words = [sys.executable, "-m", "jaxmap", "map", "nowhere", "--out", "nothing"]
    environment = {**os.environ, "PYTHONPATH": str(Path(jaxmap.__file__).parents[1])}
    plain = subprocess.run(words, capture_output=True, text=True, env=environment, check=False)
    debug = subprocess.run([*words, "--debug"], capture_output=True, text=True, env=environment, check=False)
    assert (plain.returncode, debug.returncode) == (1, 1)
    assert plain.stderr.startswith("error: ")
    assert plain.stderr.count("\n") == 1
    assert "Traceback" in debug.stderr
    assert "JaxmapError" in debug.stderr
