"""A run that replaces another: whatever ends the process, the folder holds the old run or the new one."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import pytest

import jaxmap.host.replacement as replacement
from jaxmap.errors import JaxmapError
from jaxmap.host.output_folder import locked
from jaxmap.host.replacement import Replacement

OLD = {"map.txt": "old", "only_old.txt": "old", "zarr/0": "old", "zarr/1": "old", "pictures/1.png": "old"}
NEW = {"map.txt": "new", "only_new.txt": "new", "zarr/0": "new", "pictures/2.png": "new"}
MINE = {"mine.txt": "mine", "pictures/holiday.png": "mine"}


class Killed(BaseException):
    """Stands for a process that is no more."""


def write(folder: Path, texts: dict[str, str]) -> None:
    for name, text in texts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def contents(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write(tmp_path, OLD | MINE)
    return tmp_path


def of(folder: Path) -> Replacement:
    names = ("map.txt", "only_old.txt", "only_new.txt", "zarr", "pictures/1.png", "pictures/2.png")
    return Replacement(folder, lambda: [folder / name for name in names])


def replace(folder: Path, keep: bool = False) -> None:
    run = of(folder)
    run.discard()
    with run.written(lambda: keep):
        write(run.new, NEW)


def test_a_whole_run_takes_the_place_of_the_old_and_the_rest_stays(folder):
    replace(folder)
    assert contents(folder) == NEW | MINE
    replace(folder)
    assert contents(folder) == NEW | MINE


@pytest.mark.parametrize("function", ["rename", "replace", "rmtree"])
@pytest.mark.parametrize("call", range(7))
def test_a_process_killed_at_any_call_leaves_the_old_run_or_the_new(function, call, folder, monkeypatch):
    owner = replacement.shutil if function == "rmtree" else os
    real, calls = getattr(owner, function), iter(range(100))

    def killing(*paths: Path, **options: bool) -> None:
        if next(calls) == call:
            raise Killed
        real(*paths, **options)

    with monkeypatch.context() as patch, suppress(Killed):
        patch.setattr(owner, function, killing)
        replace(folder, keep=True)
    of(folder).settle_for_reading()
    found = {name: text for name, text in contents(folder).items() if not name.startswith(".new/")}
    assert found in (OLD | MINE, NEW | MINE)


@pytest.mark.parametrize("keep", [False, True])
@pytest.mark.parametrize("kind", [JaxmapError, KeyboardInterrupt, Killed])
def test_a_run_that_fails_changes_nothing_and_is_kept_where_it_is_worth_it(keep, kind, folder):
    with pytest.raises(kind), of(folder).written(lambda: keep):
        write(of(folder).new, NEW)
        raise kind("stop")
    kept = {f".new/{name}": text for name, text in NEW.items()} if keep else {}
    assert contents(folder) == OLD | MINE | kept


def test_whoever_reads_does_not_meddle_with_a_process_that_settles(folder):
    write(folder / ".whole", NEW)
    with locked(folder):
        of(folder).settle_for_reading()
        assert contents(folder).items() >= OLD.items()
    of(folder).settle_for_reading()
    assert contents(folder) == NEW | MINE


def test_what_the_system_refuses_is_told_and_done_later(folder, monkeypatch):
    def refuse(*_: Path) -> None:
        raise PermissionError(13, "refused")

    with monkeypatch.context() as patch:
        patch.setattr(replacement, "sync", refuse)
        with pytest.raises(JaxmapError, match="no permission to write"):
            replace(folder)
    of(folder).settle()
    assert contents(folder) == NEW | MINE


def test_results_are_written_beside_those_there_and_the_best_is_told(folder):
    told: list[str] = []
    with of(folder).place("map.txt", told.append) as place:
        write(place, NEW)
    assert contents(folder) == NEW | MINE and not told
    with pytest.raises(KeyboardInterrupt), of(folder).place("map.txt", told.append) as place:
        write(place, {"map.txt": "best so far"})
        raise KeyboardInterrupt
    assert (folder / "map.txt").read_text() == "new" and (place / "map.txt").read_text() == "best so far"
    assert told == [f"stopped; what was to be replaced stays, the best so far is in {place}"]
    with of(folder / "other").place("map.txt", told.append) as place:
        assert place == folder / "other", "where there is nothing to replace"
