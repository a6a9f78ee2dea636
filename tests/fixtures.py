"""Fixtures of the command-line tests: one cache folder, one small sequence, one finished run.

Import them by name into a test module. They are made once for the whole session, by one of its processes for all.
"""

from __future__ import annotations

import fcntl
import importlib
import os
import re
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest
import tyro
from checked_once import check_once
from scenes import write_folder_sequence

from jaxmap.commands import COMMANDS
from jaxmap.commands.console import SHORT
from jaxmap.commands.main import main
from jaxmap.host.cache import cache_folder

FRAMES = 6

GRID = ("--grid.lower-m", "-2", "0", "-0.5", "--grid.upper-m", "2", "5.2", "1")
"""Bounds that hold the scene: every run of the suite has the same shape, so that the step is compiled once."""


class Outcome(NamedTuple):
    """What a command gave back."""

    status: int
    out: str
    err: str

    @property
    def error(self) -> str:
        """The one error line, without `error: `; it must be there, and be the last line."""
        lines = [line for line in self.err.splitlines() if line]
        assert [line for line in lines if line.startswith("error: ")] == lines[-1:], self.err
        assert "Traceback" not in self.err + self.out, self.err
        return lines[-1].removeprefix("error: ")


Run = Callable[..., Outcome]


@pytest.fixture(scope="session", autouse=True)
def shared_cache() -> Path:
    """Compiled programs are kept here, for all processes of a run; never in the user's cache."""
    check_once()
    return cache_folder()


@pytest.fixture(scope="session")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames of the scene as a plain folder; only to be read."""
    return _scene_folder(tmp_path_factory.getbasetemp())


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory: pytest.TempPathFactory, shared_cache: Path) -> Path:
    """The run folder of the scene under the defaults; only to be read."""
    return _finished_run(tmp_path_factory.getbasetemp())


@pytest.fixture
def scene_copy(scene_folder: Path, tmp_path: Path) -> Path:
    """The scene, to be damaged."""
    return Path(shutil.copytree(scene_folder, tmp_path / "scene"))


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command in this process; what it tells may name no option that the command has not."""

    def run(*words: object) -> Outcome:
        capsys.readouterr()
        try:
            status = main([str(word) for word in words])
        except SystemExit as stop:
            return Outcome(stop.code if isinstance(stop.code, int) else 1, *capsys.readouterr())
        outcome = Outcome(status, *capsys.readouterr())
        if words and words[0] in COMMANDS:
            assert not unknown_options(outcome.err, str(words[0])), outcome.err
        return outcome

    return run


def unknown_options(text: str, command: str) -> set[str]:
    """The options named in what a command tells that it has not; after `jaxmap OTHER`, those that OTHER has not."""
    unknown = set()
    for line in text.splitlines():
        first, *others = re.split(rf"\bjaxmap (?=(?:{'|'.join(COMMANDS)})\b)", line)
        for asked, part in [(command, first), *((other.split()[0].strip("`.,;:"), other) for other in others)]:
            unknown |= named_options(part) - options_of(asked)
    return unknown


def named_options(text: str) -> set[str]:
    """The options that a text names."""
    return set(re.findall(r"(?<![\w-])--[a-z][\w.-]*\w", text))


@cache
def options_of(command: str) -> frozenset[str]:
    """The options of a command, as its help shows them, and the one that every command takes."""
    module = importlib.import_module(f"jaxmap.commands.{command}")
    kinds = [kind for name, kind in vars(module).items() if name.endswith("Arguments")]
    actions = [action for kind in kinds for action in tyro.extras.get_parser(kind)._actions]
    return frozenset(option for action in actions for option in action.option_strings) | {"--debug", *SHORT}


def map_words(sequence: object, out: object, *more: object) -> list[str]:
    """The command line that maps the scene."""
    labelled = () if any(str(word).startswith(("--labeller", "--config")) for word in more) else ("--labeller", "plane")
    return [str(word) for word in ("map", sequence, "--out", out, *GRID, *labelled, *more)]


def made_once(base: Path, name: str, make: Callable[[Path], object]) -> Path:
    """A folder that the first process of the session to ask makes; the others wait for it."""
    # A process of xdist has a folder of its own in that of the session.
    session = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder, made = session / name, session / f"{name}.made"
    with open(session / f"{name}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            make(folder)
            made.touch()
    return folder


@cache
def _scene_folder(base: Path) -> Path:
    return made_once(base, "scene", lambda folder: write_folder_sequence(folder, FRAMES))


@cache
def _finished_run(base: Path) -> Path:
    def make(out: Path) -> None:
        assert main(map_words(_scene_folder(base), out)) == 0

    return made_once(base, "finished_run", make)
