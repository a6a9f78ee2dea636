"""The command line: help without heavy imports, every command and option explained, options over files."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest
import yaml
from fixtures import cli, finished_run, map_words, scene_folder, shared_cache  # noqa: F401

import jaxmap
from jaxmap.commands import COMMANDS
from jaxmap.host.cache import cache_folder
from jaxmap.runs.config import MapConfig


def python(program: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(Path(jaxmap.__file__).parents[1])}
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment, check=False)


@pytest.mark.parametrize("words", [["--help"], ["--version"], ["map", "--help"], ["export", "--help"]])
def test_help_and_version_need_neither_jax_nor_opencv(words):
    result = python(
        f"import sys; from jaxmap.commands.main import main\n"
        f"try: main({words!r})\n"
        f"except SystemExit as stop: assert not stop.code\n"
        f"print('LOADED', [name for name in ('jax', 'cv2', 'zarr', 'rasterio', 'matplotlib') if name in sys.modules])"
    )
    assert result.returncode == 0, result.stderr
    assert "LOADED []" in result.stdout


def test_the_version_is_the_packages(cli):
    for word in ("-V", "--version"):
        outcome = cli(word)
        assert (outcome.status, outcome.out) == (0, f"jaxmap {jaxmap.__version__}\n")


@pytest.mark.parametrize("word", ["-h", "--help"])
def test_the_overview_names_every_command(word, cli):
    outcome = cli(word)
    assert outcome.status == 0
    for name, summary in COMMANDS.items():
        assert any(name in line and summary in line for line in outcome.out.splitlines())


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command, cli):
    outcome = cli(command, "--help")
    assert outcome.status == 0
    assert f"jaxmap {command}" in outcome.out
    assert len(outcome.out) > 200


def option_names(kind: type, prefix: str = "") -> list[str]:
    names = []
    for field in fields(kind):
        value = field.default_factory() if callable(field.default_factory) else field.default
        if is_dataclass(value):
            names += option_names(type(value), f"{prefix}{field.name}.")
        else:
            names.append(f"{prefix}{field.name}".replace("_", "-"))
    return names


def test_the_help_of_map_mentions_every_option_and_says_what_it_does(cli, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = cli("map", "--help").out
    for name in [*option_names(MapConfig), "out", "config", "resume", "overwrite", "checkpoint-every-s"]:
        # A switch that is on by default is shown by what turns it off.
        section, _, last = name.rpartition(".")
        assert f"--{name}" in text or f"--{section}.no-{last}" in text, name
    words = " ".join(re.sub(r"[^\x20-\x7e]|\|", " ", text).split())
    assert "Log-odds that a frame with points in a voxel adds to its occupancy" in words
    assert "SEQUENCE" in text.upper()


def test_info_tells_versions_devices_and_folders(cli):
    outcome = cli("info")
    assert outcome.status == 0
    assert jaxmap.__version__ in outcome.out
    assert str(cache_folder()) in outcome.out
    assert "chiodini2020" in outcome.out
    assert "kitti" in outcome.out
    assert "cpu" in outcome.out


def test_the_command_line_goes_before_the_file(cli, scene_folder, tmp_path):
    (tmp_path / "mine.yaml").write_text("labeller: none\nstop: 2\nfusion: {class_hit: 1.25, carve: false}\n")
    words = ["--config", tmp_path / "mine.yaml", "--stop", "1", "--fusion.carve"]
    assert cli(*map_words(scene_folder, tmp_path / "run", *words)).status == 0
    tree = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert (tree["labeller"], tree["stop"], tree["fusion"]["class_hit"], tree["fusion"]["carve"]) == (
        "none",
        1,
        1.25,
        True,
    )


def test_a_switch_can_be_set_to_what_it_is(cli, scene_folder, tmp_path):
    """One command line for every config: a switch is not unknown because the config has turned it already."""
    for number, words in enumerate((["--fusion.carve"], ["--config", "chiodini2020", "--fusion.no-carve"])):
        outcome = cli(*map_words(scene_folder, tmp_path / str(number), "--start", "99", *words))
        assert outcome.status == 1, outcome.err
        assert "select none of 6 frames" in outcome.error


def test_the_place_of_config_among_the_options_does_not_matter(cli, scene_folder, tmp_path):
    (tmp_path / "mine.yaml").write_text("labeller: none\nstop: 1\nfusion: {class_hit: 1.25}\n")
    before, after = tmp_path / "before", tmp_path / "after"
    extra = ["--fusion.class-hit", "1.5"]
    assert cli(*map_words(scene_folder, before, f"--config={tmp_path / 'mine.yaml'}", *extra)).status == 0
    assert cli(*map_words(scene_folder, after, *extra, "--config", tmp_path / "mine.yaml")).status == 0
    assert (before / "config.yaml").read_bytes() == (after / "config.yaml").read_bytes()
    assert yaml.safe_load((before / "config.yaml").read_text())["fusion"]["class_hit"] == 1.5


def test_a_run_ends_with_where_its_outputs_are(cli, scene_folder, tmp_path):
    outcome = cli(*map_words(scene_folder, tmp_path / "run", "--labeller", "none", "--stop", "1"))
    assert outcome.status == 0
    assert outcome.out.splitlines()[-1].startswith(f"wrote {tmp_path / 'run'}/: report.html, map.zarr")
    assert "1 of 1 frames fused" in outcome.err


def test_the_module_runs_as_a_program():
    result = python(
        "import runpy, sys; sys.argv = ['jaxmap', '--version']; runpy.run_module('jaxmap', run_name='__main__')"
    )
    assert result.stdout == f"jaxmap {jaxmap.__version__}\n"
    assert result.returncode == 0


def test_a_reader_that_goes_away_is_no_fault():
    result = python(
        "import os, sys\n"
        "from jaxmap.commands.main import main\n"
        "read, write = os.pipe(); os.close(read); os.dup2(write, 1)\n"
        "status = main(['info']); sys.stdout.flush(); sys.exit(status)"
    )
    assert "Traceback" not in result.stderr
    assert "BrokenPipe" not in result.stderr


def test_the_cache_is_where_the_environment_says(monkeypatch, tmp_path):
    monkeypatch.setenv("JAXMAP_CACHE", str(tmp_path / "mine"))
    assert cache_folder() == tmp_path / "mine"
    monkeypatch.delenv("JAXMAP_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "xdg" / "jaxmap"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_folder() == tmp_path / "home" / ".cache" / "jaxmap"


def test_a_config_named_twice_counts_once(cli, scene_folder, tmp_path):
    """The settings must be those of the config that the run says it has."""
    (tmp_path / "one.yaml").write_text("labeller: none\nstop: 1\n")
    (tmp_path / "two.yaml").write_text("labeller: none\nstop: 2\n")
    words = ["--config", tmp_path / "one.yaml", "--config", tmp_path / "two.yaml"]
    outcome = cli(*map_words(scene_folder, tmp_path / "run", *words))
    if outcome.status == 0:
        assert yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())["stop"] == 2, "the last one counts"
    else:
        assert outcome.status == 2


@pytest.mark.parametrize("form", ["ply", "geotiff", "png", "all"])
def test_export_writes_the_forms_anew(form, cli, finished_run, tmp_path):
    run = Path(shutil.copytree(finished_run, tmp_path / "run"))
    names = {"ply": ["map.ply"], "geotiff": ["bev.tif"], "png": ["bev.png"], "all": ["map.ply", "bev.tif", "bev.png"]}
    before = {name: (run / name).read_bytes() for name in names["all"]}
    for name in names["all"]:
        (run / name).unlink()
    assert cli("export", run, "--format", form).status == 0
    assert [name for name in names["all"] if (run / name).exists()] == names[form]
    assert "map.ply" not in names[form] or (run / "map.ply").read_bytes() == before["map.ply"]


def test_report_writes_the_page_anew(cli, finished_run, tmp_path):
    run = Path(shutil.copytree(finished_run, tmp_path / "run"))
    (run / "report.html").unlink()
    outcome = cli("report", run)
    assert outcome.status == 0
    assert "report.html" in outcome.out
    assert "<html" in (run / "report.html").read_text()
