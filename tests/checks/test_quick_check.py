"""The quick check that other commands begin with: notes, or a stop before anything is written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes import write_folder_sequence

from jaxmap.checks.check import CheckReport
from jaxmap.checks.finding import Finding
from jaxmap.commands.main import main
from jaxmap.runs.config import MapConfig
from jaxmap.runs.mapping_plan import plan_run


def change(folder: Path, changed) -> None:
    """Writes the right images anew."""
    for path in (folder / "right").glob("*.png"):
        Image.fromarray(changed(np.asarray(Image.open(path)))).save(path)


@pytest.fixture
def off(tmp_path: Path) -> Path:
    """A sequence whose right images are three rows off."""
    folder = write_folder_sequence(tmp_path / "seq", 3)
    change(folder, lambda image: np.roll(image, 3, axis=0))
    return folder


def test_findings_are_noted_and_kept_in_the_plan(off):
    lines: list[str] = []
    plan = plan_run(str(off), MapConfig(labeller="none"), lines.append)
    assert [finding.kind for finding in plan.findings] == ["vertical-disparity"]
    assert sum("--stereo.align" in line for line in lines) == 1


@pytest.mark.parametrize(
    "words",
    [
        ["map", "--labeller", "none"],
        ["refine"],
    ],
)
def test_strict_commands_stop_before_anything_is_written(off, tmp_path, capsys, words):
    out = tmp_path / "out"
    assert main([words[0], str(off), "--out", str(out), *words[1:], "--strict"]) == 1
    assert "--stereo.align" in capsys.readouterr().err
    assert not out.exists() or not any(path.is_file() and path.name != ".lock" for path in out.iterdir())


def test_strict_lets_pass_what_is_merely_worth_knowing(off, monkeypatch):
    found = Finding("blurred-images", False, 0.7, "the left image is blurred", "clean the lens")
    monkeypatch.setattr("jaxmap.runs.checking.check_sequence", lambda *given: CheckReport((found,), {}))
    lines: list[str] = []
    plan = plan_run(str(off), MapConfig(labeller="none", strict=True), lines.append)
    assert plan.findings == (found,)
    assert "note: the left image is blurred; clean the lens (blurred-images, 70% sure)" in lines


@pytest.mark.slow
def test_a_sequence_of_black_images_ends_with_status_1_and_names_them(tmp_path, capsys):
    folder = write_folder_sequence(tmp_path / "seq", 2)
    change(folder, np.zeros_like)
    assert main(["map", str(folder), "--out", str(tmp_path / "out"), "--labeller", "none"]) == 1
    told = capsys.readouterr().err
    assert "the right image is black" in told and "f000" in told


@pytest.mark.slow
def test_metrics_hold_findings_and_alignment(off, tmp_path):
    out = tmp_path / "out"
    words = ["map", str(off), "--labeller", "none", "--depth.max-m", "4"]
    assert main([*words, "--out", str(out / "as-is")]) == 0
    metrics = json.loads((out / "as-is" / "metrics.json").read_text())
    assert metrics["sequence"]["findings"][0]["kind"] == "vertical-disparity"
    assert main([*words, "--out", str(out / "aligned"), "--stereo.align", "--strict"]) == 0
    metrics = json.loads((out / "aligned" / "metrics.json").read_text())
    assert "findings" not in metrics["sequence"]
    about_x, about_y, about_z = metrics["camera"]["alignment_rad"]
    assert abs(about_x) == pytest.approx(3 / 140, rel=0.1) and about_y == 0 and abs(about_z) < 0.005
