"""`jaxmap explain`: which frames and pixels made a cell of a map what it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from annotated_types import Interval

from jaxmap.commands.console import Console, Coordinate, check_bounds, parse

if TYPE_CHECKING:
    import numpy as np

    from jaxmap.report.explain_page import Explanation

_MOST_ROWS = 40


@dataclass(frozen=True)
class ExplainArguments:
    """Tell which frames and pixels made a cell of a map what it is, and what each added to its log-odds, by class.

    The frames that can have seen the cell are read, matched and labelled again, by the run's own settings, and fused
    into this cell alone; together they give just what the map holds. Writes explain.html into the run folder.
    """

    run: tyro.conf.Positional[Path]
    """A run folder, as jaxmap map has written it; its sequence must still be there."""
    at: tuple[Coordinate, Coordinate]
    """East and north of the cell, metres in the map's coordinate reference system (x and y where it has none)."""
    radius_m: Annotated[float, Interval(gt=0, le=10)] | None = None
    """All columns of voxels so near along both axes, together, in place of the one at the point."""
    out: Path | None = None
    """HTML file to write; by default explain.html in the run folder."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(ExplainArguments, "explain", words)
    check_bounds(arguments, "explain")

    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.report.explain_page import write_explanation
    from jaxmap.runs.explaining import explain_cell, find_cell, frames_of, plan_again

    keep_compiled_programs()
    console = Console()
    cell = find_cell(arguments.run, arguments.at, arguments.radius_m)
    plan = plan_again(arguments.run, cell, lambda line: None)
    numbers = frames_of(cell, plan)
    with console.steps("explaining", "frames", len(numbers)) as advance:
        explained = explain_cell(arguments.run, cell, plan, numbers, advance)
    _print(console, explained)
    path = write_explanation(arguments.out or arguments.run / "explain.html", explained)
    console.result(path.parent, [path.name])
    return 0


def _print(console: Console, explained: Explanation) -> None:
    """The frames as a table: the first of those that added most, in their order, and the sum of all."""
    chosen = sorted(explained.parts, key=lambda part: -abs(part.evidence).max())[:_MOST_ROWS]
    names = {"frame": "frame", "range": "range, m", "pixels": "pixels", "free": "seen through"}
    channels = {name: name for name in explained.channels}

    def row(name: str, numbers: np.ndarray, *more: str) -> dict[str, object]:
        shown = dict(zip(("range", "pixels", "free"), more or ("", "", ""), strict=True))
        evidence = zip(explained.channels, (f"{value:+.2f}" for value in numbers), strict=True)
        return {"frame": name, **shown, **dict(evidence)}

    rows = [
        row(part.name, part.evidence, f"{part.range_m:.2f}", f"{int(part.inside.sum())}", f"{part.seen_through}")
        for part in explained.parts
        if any(part is one for one in chosen)
    ]
    if (others := len(explained.parts) - len(rows)) > 0:
        rest = explained.evidence - sum((part.evidence for part in chosen), start=0 * explained.evidence)
        rows.append(row(f"{others} others", rest))
    rows += [row("prior", explained.priors), row("the map", explained.evidence + explained.priors)]
    console.table(f"{explained.verdict}: {explained.place}; {explained.note()}", {**names, **channels}, rows)
