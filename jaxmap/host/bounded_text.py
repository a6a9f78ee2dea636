"""Text, YAML and JSON of unknown origin, read within bounds: what is too large, too deep or grows is refused in a line.

A few hundred bytes of YAML can stand for gigabytes (aliases of aliases), and a few thousand brackets overflow the stack
of any reader that calls itself. All YAML and JSON of the package comes through here.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from jaxmap.errors import JaxmapError
from jaxmap.host.files import read_bytes

MOST_TEXT_BYTES = 512 << 20
"""Of a log: ten hours of an IMU at 125 Hz."""
MOST_DIGITS = 40
"""Of a whole number; float64 has 17 digits, 64 bits 20."""

_FIX = "correct or restore the file"


class Bounds(NamedTuple):
    """What a document may hold; nodes count as often as aliases repeat them."""

    text_bytes: int
    depth: int
    nodes: int
    aliases: int = 0


YAML_BOUNDS = Bounds(text_bytes=2 << 20, depth=32, nodes=50_000, aliases=100)
JSON_BOUNDS = Bounds(text_bytes=64 << 20, depth=32, nodes=2_000_000)


def read_text(path: Path, most_bytes: int = MOST_TEXT_BYTES) -> str:
    """The text of a UTF-8 file (a byte order mark is dropped).

    Raises:
        JaxmapError: the file is missing, no regular file, larger than `most_bytes`, or is not text.
    """
    data = read_bytes(path, most_bytes, text=True)
    try:
        return data.decode("utf-8-sig")
    except ValueError as fault:
        raise JaxmapError("not a text file", where=path, fix="give a UTF-8 text file") from fault


def read_yaml(path: Path) -> Any:
    """The content of a YAML file.

    OpenCV's header `%YAML:1.0`, invalid in YAML but present in its files and in EuRoC's, is accepted.

    Raises:
        JaxmapError: what `read_text` and `parse_yaml` refuse.
    """
    text = read_text(path, YAML_BOUNDS.text_bytes)
    if text.startswith("%YAML:"):
        # The line break is kept, so that errors name the right line.
        text = "".join(text.partition("\n")[1:])
    return parse_yaml(text, path)


def parse_yaml(text: str, where: object, bounds: Bounds = YAML_BOUNDS) -> Any:
    """Plain values of YAML: mappings, lists, text, numbers, truth values and nothing. A date stays text.

    Raises:
        JaxmapError: it is malformed (with the line), or beyond its bounds.
    """
    loader = None
    try:
        loader = _Loader(text, bounds)
        content = loader.get_single_data()
    except yaml.MarkedYAMLError as fault:
        mark = fault.problem_mark or fault.context_mark
        place = f"{where} line {mark.line + 1}" if mark else where
        raise JaxmapError(f"malformed YAML ({fault.problem or fault.context})", where=place, fix=_FIX) from fault
    except (yaml.YAMLError, ValueError, ArithmeticError, LookupError, TypeError, AttributeError) as fault:
        # What PyYAML raises where a scalar is not of the kind that its tag says, or a character is not printable.
        reason = " ".join(str(fault).split())[:120]
        raise JaxmapError(f"malformed YAML ({reason})", where=where, fix=_FIX) from fault
    except RecursionError as fault:
        raise JaxmapError("malformed YAML (nested too deep)", where=where, fix=_FIX) from fault
    finally:
        if loader is not None:
            loader.dispose()
    _check_nesting(content, where, bounds)
    return content


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        JaxmapError: what `read_text` and `parse_json` refuse.
    """
    return parse_json(read_text(path, JSON_BOUNDS.text_bytes), path)


def parse_json(text: str, where: object, bounds: Bounds = JSON_BOUNDS) -> Any:
    """Plain values of JSON; NaN and infinity, which JSON has not, are nothing (None).

    Raises:
        JaxmapError: it is malformed, or beyond its bounds.
    """
    try:
        content = json.loads(text, parse_int=_whole, parse_float=_finite, parse_constant=lambda name: None)
    except RecursionError as fault:
        raise JaxmapError("not readable as JSON (nested too deep)", where=where, fix=_FIX) from fault
    except ValueError as fault:
        raise JaxmapError(f"not readable as JSON ({fault})", where=where, fix=_FIX) from fault
    _check_nesting(content, where, bounds)
    return content


def _whole(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:20]} is no finite number")
    return number


def _check_nesting(content: Any, where: object, bounds: Bounds) -> None:
    """Refuses what is nested deep, or too much; without calling itself."""
    level, depth, nodes = [content], 0, 0
    while level:
        nodes += len(level)
        if depth > bounds.depth:
            raise JaxmapError(f"nested deeper than {bounds.depth}", where=where, fix=_FIX)
        if nodes > bounds.nodes:
            raise JaxmapError(f"more values than {bounds.nodes:,}", where=where, fix=_FIX)
        below: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                below += value.values()
            elif isinstance(value, list | tuple | set):
                below += value
        level, depth = below, depth + 1


class _Loader(yaml.SafeLoader):
    """A safe loader that counts while it reads, before anything is built."""

    def __init__(self, text: str, bounds: Bounds) -> None:
        super().__init__(text)
        self._bounds = bounds
        self._depth = self._nodes = self._aliases = 0
        self._sizes: dict[str, int] = {}
        """Nodes below each anchor that has ended."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = self.peek_event()
        before = self._nodes
        if isinstance(event, yaml.AliasEvent):
            self._aliases += 1
            if event.anchor in self.anchors and event.anchor not in self._sizes:
                self._refuse(event, f"*{event.anchor[:40]} stands within what it repeats")
            self._nodes += self._sizes.get(event.anchor, 0)
        self._nodes += 1
        self._depth += 1
        for name, count in (("depth", self._depth), ("nodes", self._nodes), ("aliases", self._aliases)):
            if count > (most := getattr(self._bounds, name)):
                what = {"depth": "nested deeper than", "nodes": "more values than", "aliases": "more aliases than"}
                self._refuse(event, f"{what[name]} {most:,}")
        node = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(event, yaml.NodeEvent) and not isinstance(event, yaml.AliasEvent) and event.anchor is not None:
            self._sizes[event.anchor] = self._nodes - before
        if isinstance(node, yaml.ScalarNode) and node.tag in _NUMBERS and len(node.value) > MOST_DIGITS:
            self._refuse(event, f"a number of {len(node.value):,} digits")
        return node

    def _refuse(self, event: Any, problem: str) -> None:
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)


_PREFIX = "tag:yaml.org,2002:"
_NUMBERS = (f"{_PREFIX}int", f"{_PREFIX}float")
_KINDS = ("null", "bool", "int", "float", "str", "seq", "map")
_Loader.yaml_constructors = {
    tag: make
    for tag, make in yaml.SafeLoader.yaml_constructors.items()
    if tag is None or tag.removeprefix(_PREFIX) in _KINDS
}
# Nothing here is a date, and 2001-99-99 is none either: both stay text.
_Loader.yaml_implicit_resolvers = {
    first: [(tag, pattern) for tag, pattern in resolvers if tag != f"{_PREFIX}timestamp"]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
