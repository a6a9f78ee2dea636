"""Options and settings: frozen dataclasses that check themselves, read strictly from YAML files and plain values."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, TypeVar, dataclass_transform

import pydantic.dataclasses
from annotated_types import Interval
from pydantic import ConfigDict, TypeAdapter, ValidationError

from jaxmap.errors import JaxmapError, UsageError
from jaxmap.host.files import config_folder

Config = TypeVar("Config")

_MOST_NAMED = 6
"""Faults that one message names."""

LARGEST = 1e6
"""No number of metres, pixels, seconds or log-odds that means anything is larger; counts have bounds of their own."""

Positive = Interval(ge=1e-9, le=LARGEST)
NotNegative = Interval(ge=0, le=LARGEST)
AnyNumber = Interval(ge=-LARGEST, le=LARGEST)
CellSize = Interval(ge=1e-3, le=1e3)
"""Edge of a cell in metres: below, a site has more cells than memory."""
Probability = Interval(gt=0, lt=1)
Seed = Interval(ge=0, lt=2**31)
Place = Interval(ge=-(2**31), lt=2**31)
"""A place in a sequence, counted from its end where it is negative."""


def count(most: int, least: int = 1) -> Interval:
    """The bounds of a number of things."""
    return Interval(ge=least, le=most)


@dataclass_transform(frozen_default=True)
def options(section: str = "") -> Callable[[type[Config]], type[Config]]:
    """Makes a frozen dataclass whose fields are checked whenever one is made, from Python, YAML or the command line.

    Args:
        section: where it stands in a configuration; errors name its fields below it. Empty at the top.

    Raises:
        UsageError: on making one of unknown keys or illegal values.
    """

    def decorate(kind: type[Config]) -> type[Config]:
        made: Any = pydantic.dataclasses.dataclass(
            kind, frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False)
        )
        initialise = made.__init__

        def checked(self: Any, *args: Any, **values: Any) -> None:
            try:
                initialise(self, *args, **values)
            except ValidationError as error:
                raise UsageError(_complaints(error, section), fix="choose a valid value") from error

        made.__init__ = checked
        return made

    return decorate


class Settings(Generic[Config]):
    """Reads the settings of one command.

    Args:
        kind: their dataclass.
        command: its name.
        folder: where its configurations lie below `config_folder`.
        given: keys that a run writes into its resolved configuration and the command line names.
    """

    def __init__(self, kind: type[Config], command: str, *, folder: str = ".", given: tuple[str, ...] = ()) -> None:
        self._adapter: TypeAdapter[Config] = TypeAdapter(kind)
        self._command, self._given = command, given
        self._folder = config_folder() / folder

    def load(self, name_or_path: str) -> Config:
        """Reads a YAML file, or the one of that name which comes with jaxmap.

        Raises:
            UsageError: no such file, not YAML, an unknown key, or a value out of range.
        """
        tree, path = self.read(name_or_path)
        return self.check(tree, where=path)

    def read(self, name_or_path: str) -> tuple[dict[str, Any], Path]:
        """The keys and values that such a file names, not yet checked, and its path.

        Raises:
            UsageError: no such file, or not YAML.
        """
        from jaxmap.host.bounded_text import read_yaml

        path = Path(name_or_path)
        if not path.exists():
            path = self._folder / (name_or_path if name_or_path.endswith(".yaml") else f"{name_or_path}.yaml")
        if not path.is_file():
            known = ", ".join(sorted(file.stem for file in self._folder.glob("*.yaml")))
            raise UsageError(f"no config {name_or_path!r}", fix=f"give a YAML file or one of: {known}")
        try:
            tree = read_yaml(path)
        except JaxmapError as error:
            raise UsageError(error.what, where=error.where, fix=error.fix) from error
        if not isinstance(tree or {}, dict):
            raise UsageError(f"holds a {type(tree).__name__}, not keys and values", where=path, fix="write key: value")
        return {key: value for key, value in (tree or {}).items() if key not in self._given}, path

    def check(self, tree: dict[str, Any], where: object = "the command line") -> Config:
        """Builds the settings from plain values, strictly.

        Raises:
            UsageError: names unknown keys and values out of range.
        """
        try:
            return self._adapter.validate_python(tree)
        except ValidationError as error:
            raise UsageError(_complaints(error), where=where, fix=f"see jaxmap {self._command} --help") from error

    def tree(self, config: Config) -> dict[str, Any]:
        """Settings as plain values, for YAML and JSON."""
        return self._adapter.dump_python(config, mode="json")


def fault_text(message: str) -> str:
    """What is wrong with a value, in the words of pydantic."""
    message = message.replace("or equal to 0.000000001", "0, by 1e-9 or more")
    return message[:1].lower() + message[1:]


def _complaints(error: ValidationError, section: str = "") -> str:
    """One clause for each fault, by its dotted key below the section."""
    clauses: dict[str, str] = {}
    for fault in error.errors():
        # Branches of a union appear in the location; they are not part of the key.
        parts = [section] if section else []
        parts += [str(part) for part in fault["loc"] if isinstance(part, int) or part.isidentifier()]
        key = ".".join(parts)
        if fault["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
            clauses[key] = f"unknown key {key}"
        else:
            value = repr(fault["input"])
            clauses.setdefault(key, f"{key} is {value[:60]}: {fault_text(fault['msg'])}")
    named, more = list(clauses.values())[:_MOST_NAMED], len(clauses) - _MOST_NAMED
    return "; ".join([*named, f"and {more} more"] if more > 0 else named)
