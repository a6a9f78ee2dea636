"""Writes docs/settings.md: every setting of `jaxmap map`, `train` and `plan`, from the dataclasses that hold them.

python scripts/make_settings_page.py
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import inspect
import sys
import textwrap
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import annotated_types

from jaxmap.host import settings
from jaxmap.planning.options import RoverOptions
from jaxmap.runs.config import MapConfig
from jaxmap.runs.training_plan import TrainConfig

PAGE = Path(__file__).resolve().parents[1] / "docs" / "settings.md"

_USUAL = {settings.Positive: " > 0", settings.NotNegative: " ≥ 0", settings.AnyNumber: "", settings.Place: ""}

HEAD = """# Settings

Generated from the code by `python scripts/make_settings_page.py`; a test compares the two.

A setting has one name in three forms: an option `--grid.voxel-size-m 0.1` of the command line, a key `voxel_size_m` in
the group `grid` of a YAML file (`--config FILE`), and a field in Python. Options override the file. A switch is
`--fusion.carve` or `--fusion.no-carve`. Unknown keys and values out of range are refused. In the tables, `[a, b)` is
a range that includes a and excludes b, and – is a setting that is not given. A number for which no end is named lies
between -1,000,000 and 1,000,000, and one above 0 at 1e-9 or more.
"""


def docstrings(options: type) -> dict[str, str]:
    """The text below each field of a class and of its bases, by name."""
    texts = {}
    for base in reversed(options.__mro__[:-1]):
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(body, ast.ClassDef)
        for node, below in zip(body.body, body.body[1:], strict=False):
            if isinstance(node, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(node.target, ast.Name):
                texts[node.target.id] = " ".join(ast.literal_eval(below.value).split())
    return texts


def bounds(metadata: tuple[Any, ...]) -> str:
    """The range of a number, such as ` > 0` or ` in [0, 1)`; empty where it has none."""
    if metadata and metadata[0] in _USUAL:
        return _USUAL[metadata[0]]
    lower, upper = (), ()
    for entry in metadata:
        for bound in entry if isinstance(entry, annotated_types.GroupedMetadata) else [entry]:
            match bound:
                case annotated_types.Ge(value):
                    lower = ("≥", "[", value)
                case annotated_types.Gt(value):
                    lower = (">", "(", value)
                case annotated_types.Le(value):
                    upper = ("≤", "]", value)
                case annotated_types.Lt(value):
                    upper = ("<", ")", value)
    if lower and upper:
        return f" in {lower[1]}{lower[2]:.9g}, {upper[2]:.10g}{upper[1]}"
    return "".join(f" {sign} {value:g}" for sign, _, value in filter(None, (lower, upper)))


def kind_of(kind: Any) -> str:
    """A type in words: names, choices and ranges."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        return kind_of(arguments[0]) + bounds(arguments[1:])
    if origin is Literal:
        return ", ".join(f"`{choice}`" for choice in arguments)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(kind_of(part) for part in arguments if part is not type(None))
    if origin is tuple and arguments[-1] is Ellipsis:
        return f"several: {kind_of(arguments[0])}"
    if origin is tuple:
        same = len(set(arguments)) == 1
        return f"{len(arguments)} × {kind_of(arguments[0])}" if same else ", ".join(map(kind_of, arguments))
    if origin is dict:
        return " = ".join(kind_of(part) for part in arguments)
    return {str: "text", Path: "path"}.get(kind, getattr(kind, "__name__", str(kind)))


def shown(default: Any) -> str:
    """A default as it is written on the command line."""
    if default is None or default in ((), {}):
        return "–"
    if isinstance(default, bool):
        return "`true`" if default else "`false`"
    if isinstance(default, tuple):
        return f"`{' '.join(map(str, default))}`"
    return f"`{default}`"


def tables(options: Any, prefix: str = "") -> Iterator[str]:
    """A table of the settings of an instance of options, then those of the groups below it, each under a heading."""
    kinds, texts = typing.get_type_hints(type(options), include_extras=True), docstrings(type(options))
    values = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    groups = {name: value for name, value in values.items() if dataclasses.is_dataclass(value)}
    rows = [
        f"| `{prefix}{name}` | {kind_of(kinds[name])} | {shown(value)} | {texts.get(name, '')} |"
        for name, value in values.items()
        if name not in groups
    ]
    yield "\n".join(["| setting | values | default | meaning |", "|---|---|---|---|", *rows])
    for name, group in groups.items():
        if not isinstance(group, MapConfig):
            yield f"### `{prefix}{name}`\n\n{summary(type(group))}"
            yield from tables(group, f"{prefix}{name}.")
            continue
        usual = leaves(MapConfig())
        other = [
            f"`{prefix}{name}.{key}` {shown(value)}" for key, value in leaves(group).items() if value != usual[key]
        ]
        yield f"### `{prefix}{name}`\n\n{texts[name]} Other defaults: {', '.join(other)}."


def leaves(options: Any) -> dict[str, Any]:
    """All settings of an instance of options by their dotted names."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        nested = leaves(value) if dataclasses.is_dataclass(value) else {"": value}
        found |= {f"{field.name}.{key}".rstrip("."): leaf for key, leaf in nested.items()}
    return found


def summary(options: type) -> str:
    """The first paragraph of a class's docstring, on one line."""
    return " ".join((inspect.getdoc(options) or "").partition("\n\n")[0].split())


def page() -> str:
    """The whole page."""
    parts = [HEAD.strip(), "## jaxmap map", summary(MapConfig), *tables(MapConfig())]
    parts += ["## jaxmap train", summary(TrainConfig), *tables(TrainConfig())]
    parts += [
        "## jaxmap plan",
        f"{summary(RoverOptions)} They are given by `--rover FILE` alone.",
        *tables(RoverOptions()),
    ]
    return "\n\n".join(parts) + "\n"


def main() -> int:
    """Writes the page."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    PAGE.write_text(page(), encoding="utf-8")
    print(f"wrote {PAGE}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
