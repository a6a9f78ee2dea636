"""The command line: every command and option explained, options over files, outputs named at the end."""

from __future__ import annotations

import re
import shutil
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest
from fixtures import cli, finished_run, map_words, scene_folder, shared_cache  # noqa: F401

import jaxmap
from jaxmap.commands import COMMANDS
from jaxmap.errors import JaxmapError
from jaxmap.host.cache import cache_folder
from jaxmap.runs.config import MapConfig


def test_the_version_is_the_packages(cli):
    for word in ("-V", "--version"):
        outcome = cli(word)
        assert (outcome.status, outcome.out) == (0, f"jaxmap {jaxmap.__version__}\n")


def test_every_command_is_named_in_the_overview_and_has_help(cli):
    for word in ("-h", "--help"):
        outcome = cli(word)
        assert outcome.status == 0
        for name, summary in COMMANDS.items():
            assert any(name in line and summary in line for line in outcome.out.splitlines())
    for command in COMMANDS:
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


def test_info_prints_versions_devices_and_folders(cli):
    outcome = cli("info")
    assert outcome.status == 0
    assert jaxmap.__version__ in outcome.out
    assert str(cache_folder()) in outcome.out
    assert "chiodini2020" in outcome.out
    assert "kitti" in outcome.out
    assert "cpu" in outcome.out


@pytest.fixture
def settings_of(cli, monkeypatch, tmp_path):
    """The settings that a command line of map comes to; nothing is mapped."""

    def settings(*words: object) -> MapConfig:
        planned = []

        def plan_run(_: str, config: MapConfig, *more: object, **options: object) -> None:
            planned.append(config)
            raise JaxmapError("far enough")

        monkeypatch.setattr("jaxmap.runs.mapping_plan.plan_run", plan_run)
        outcome = cli(*map_words("scene", tmp_path / "run", *words))
        assert outcome.error == "far enough"
        return planned[0]

    return settings


def test_the_command_line_takes_precedence_over_the_file(settings_of, tmp_path):
    (tmp_path / "mine.yaml").write_text("labeller: none\nstop: 2\nfusion: {class_hit: 1.25, carve: false}\n")
    config = settings_of("--config", tmp_path / "mine.yaml", "--stop", "1", "--fusion.carve")
    assert (config.labeller, config.stop, config.fusion.class_hit, config.fusion.carve) == ("none", 1, 1.25, True)


def test_a_switch_can_be_set_to_what_it_is(settings_of):
    """One command line for every config: a switch is not unknown because the config has turned it already."""
    assert settings_of("--fusion.carve").fusion.carve is True
    assert settings_of("--config", "chiodini2020", "--fusion.no-carve").fusion.carve is False


def test_relief_has_a_short_name(settings_of):
    assert settings_of("--labeller", "deeplab", "--relief").relief.combine is True
    assert settings_of("--relief.combine", "True", "--relief.weight", "0.5").relief.combine is True
    assert settings_of("--no-relief").relief.combine is False
    assert settings_of().relief.combine is None


def test_the_place_of_config_among_the_options_does_not_matter(settings_of, tmp_path):
    (tmp_path / "mine.yaml").write_text("labeller: none\nfusion: {class_hit: 1.25}\n")
    extra = ("--fusion.class-hit", "1.5")
    before = settings_of(f"--config={tmp_path / 'mine.yaml'}", *extra)
    after = settings_of(*extra, "--config", tmp_path / "mine.yaml")
    assert before == after
    assert (before.labeller, before.fusion.class_hit) == ("none", 1.5)


def test_of_a_config_given_twice_the_last_one_counts(settings_of, tmp_path):
    for number in (1, 2):
        (tmp_path / f"{number}.yaml").write_text(f"stop: {number}\n")
    assert settings_of("--config", tmp_path / "1.yaml", "--config", tmp_path / "2.yaml").stop == 2


def test_a_run_ends_with_where_its_outputs_are(cli, scene_folder, tmp_path):
    outcome = cli(*map_words(scene_folder, tmp_path / "run"))
    assert outcome.status == 0
    assert outcome.out.splitlines()[-1].startswith(f"wrote {tmp_path / 'run'}/: report.html, map.zarr")
    assert "6 of 6 frames fused" in outcome.err


def test_the_cache_is_where_the_environment_says(monkeypatch, tmp_path):
    monkeypatch.setenv("JAXMAP_CACHE", str(tmp_path / "mine"))
    assert cache_folder() == tmp_path / "mine"
    monkeypatch.delenv("JAXMAP_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "xdg" / "jaxmap"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_folder() == tmp_path / "home" / ".cache" / "jaxmap"


def test_export_writes_the_forms_again(cli, finished_run, tmp_path):
    run = Path(shutil.copytree(finished_run, tmp_path / "run"))
    every = ["map.ply", "bev.tif", "bev.png"]
    names = {"png": every[2:], "ply geotiff": every[:2], "": every}
    before = (run / "map.ply").read_bytes()
    for forms, written in names.items():
        for name in every:
            (run / name).unlink(missing_ok=True)
        assert cli("export", run, *(["--format", *forms.split()] if forms else [])).status == 0
        assert [name for name in every if (run / name).exists()] == written
    assert (run / "map.ply").read_bytes() == before


def test_report_writes_the_page_again(cli, finished_run, tmp_path):
    run = Path(shutil.copytree(finished_run, tmp_path / "run"))
    (run / "report.html").unlink()
    outcome = cli("report", run)
    assert outcome.status == 0
    assert "report.html" in outcome.out
    assert "<html" in (run / "report.html").read_text()
