"""What the commands share: parsing and checking options, lines for the user, progress."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeVar

import tyro
from annotated_types import Interval

from jaxmap.errors import UsageError
from jaxmap.host.settings import count

Arguments = TypeVar("Arguments")

SHORT = {"--relief": ("--relief.combine", "True"), "--no-relief": ("--relief.combine", "False")}
"""Short names of options with their value."""


def parse(
    kind: type[Arguments],
    command: str,
    words: Sequence[str],
    with_config: Callable[[str], Arguments] | None = None,
    default: Arguments | None = None,
) -> Arguments:
    """Parses the options of a command; exits with status 2 where they are wrong.

    Args:
        kind: the dataclass of the options.
        command: its name.
        words: the command line after it.
        with_config: returns the defaults under the configuration that `--config` names.
        default: the defaults, where they are not those of the dataclass.
    """
    defaults: dict[str, Any] = {} if default is None else {"default": default}
    if with_config is not None and (name := _value_of("--config", words)) is not None:
        defaults["default"] = with_config(name)
    words = [long for word in words for long in SHORT.get(word, (word,))]
    return tyro.cli(kind, prog=f"jaxmap {command}", args=words, **defaults)


Workers = count(1024)
"""The bounds of `--workers`."""
Coordinate = Annotated[float, Interval(ge=-1e9, le=1e9)]
"""An east or a north in the coordinate reference system of a map, metres."""


def check_workers(workers: int | None, scheduler: str | None) -> None:
    """Refuses processes of this machine beside those of a cluster.

    Raises:
        UsageError: both are given.
    """
    if scheduler is not None and (workers or 1) > 1:
        raise UsageError("--workers and --scheduler exclude each other", fix="give one of them")


def check_bounds(arguments: object, command: str) -> None:
    """Validates parsed options against the bounds in the annotations of their fields.

    Raises:
        UsageError: names every option that is out of bounds.
    """
    from pydantic import TypeAdapter, ValidationError

    from jaxmap.host.settings import fault_text

    try:
        TypeAdapter(type(arguments)).validate_python(vars(arguments))
    except ValidationError as error:
        faults = []
        for fault in error.errors():
            option = str(fault["loc"][0]).replace("_", "-")
            faults.append(f"--{option} is {str(fault['input'])[:60]}: {fault_text(fault['msg'])}")
        raise UsageError("; ".join(faults), fix=f"see jaxmap {command} --help") from error


def _value_of(option: str, words: Sequence[str]) -> str | None:
    """The value of an option; the last one where it is given twice."""
    value = None
    for index, word in enumerate(words):
        if word == option and index + 1 < len(words):
            value = words[index + 1]
        elif word.startswith(f"{option}="):
            value = word.partition("=")[2]
    return value


class Advance(Protocol):
    """Reports the progress of long work."""

    def __call__(self, done: int, note: str = "") -> None:
        """So many are done; `note` describes the current state."""
        ...


class Console:
    """Lines and progress on stderr, results on stdout."""

    def __init__(self) -> None:
        """A progress bar is drawn only on a terminal; elsewhere a line is printed now and then."""
        from rich.console import Console as RichConsole

        self._rich = RichConsole(stderr=True, highlight=False, soft_wrap=True)

    def notify(self, line: str) -> None:
        """Prints one line for the user."""
        self._rich.print(line, markup=False)

    def result(self, folder: Path, names: Sequence[str]) -> None:
        """Prints where the outputs are."""
        print(f"wrote {folder}/: {', '.join(names)}")

    def table(self, title: str, columns: Mapping[str, str], rows: Sequence[Mapping[str, object]]) -> None:
        """Prints rows as a table on stdout; `columns` names the keys shown and their headings."""
        from rich.console import Console as RichConsole
        from rich.table import Table

        table = Table(title=title, title_justify="left")
        for key, heading in columns.items():
            table.add_column(heading, justify="left" if isinstance(rows[0][key], str) else "right")
        for row in rows:
            table.add_row(*(_cell(row[key]) for key in columns))
        # A file or pipe has no width: the table must not be squeezed into 80 columns there.
        out = RichConsole(highlight=False)
        RichConsole(highlight=False, width=None if out.is_terminal else 200).print(table)

    @contextmanager
    def progress(self, title: str, total: int) -> Iterator[Callable[[object], None]]:
        """Shows progress over `total` frames; yields a function to call after each."""
        with self.steps(title, "frames", total) as advance:
            yield lambda fused: advance(fused.prepared.index + 1)  # type: ignore[attr-defined]

    @contextmanager
    def steps(self, title: str, unit: str, total: int) -> Iterator[Advance]:
        """Shows progress over `total` of `unit`; yields a function to call with the number done, and a note."""
        if not self._rich.is_terminal:
            yield self._plain_steps(title, unit, total)
            return
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn(title), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, TextColumn("{task.fields[note]}"), console=self._rich, transient=True) as bar:
            task = bar.add_task(title, total=total, note="")
            yield lambda done, note="": bar.update(task, completed=done, note=note)

    @contextmanager
    def counted(self, title: str, unit: str) -> Iterator[Callable[[int, int], None]]:
        """Shows progress once there is some; yields a function to call with the number done, and of all."""
        with ExitStack() as stack:
            shown: list[Advance] = []

            def count(done: int, total: int) -> None:
                if not shown:
                    shown.append(stack.enter_context(self.steps(title, unit, total)))
                shown[0](done)

            yield count

    def _plain_steps(self, title: str, unit: str, total: int) -> Advance:
        printed_s = time.monotonic()

        def advance(done: int, note: str = "") -> None:
            nonlocal printed_s
            if time.monotonic() - printed_s > 10:
                printed_s = time.monotonic()
                print(f"{title}: {done} of {total} {unit}{note and f', {note}'}", file=sys.stderr)

        return advance


def _cell(value: object) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:.3g}" if isinstance(value, float) else str(value)
