"""The page of `jaxmap demo`: what the rover saw, the map in 3D and from above, the scores, and where each map errs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from jaxmap.evaluation.evaluate import Evaluation
from jaxmap.labels import class_colours
from jaxmap.mapping.columns import top_down_of
from jaxmap.report.drive_view import drive_section
from jaxmap.report.error_map import verdict_colours, write_error_map, write_truth_map
from jaxmap.report.page import figure, header, inline_image, section, table, write_page
from jaxmap.report.run_contents import RunContents, read_run
from jaxmap.report.top_down import HALF, UNOBSERVED_COLOUR, map_sheet, top_down_picture

Row = Mapping[str, Any]


class ScoredRun(NamedTuple):
    """A row of the table.

    `row` holds the scores with `run`, the folder, and `map`, the name; `backdrop` is the orthomosaic on the cells of
    the evaluation.
    """

    row: Row
    evaluation: Evaluation
    backdrop: UInt8[np.ndarray, "BI BJ 3"]


def write_demo_page(out: Path, title: str, columns: Mapping[str, str], runs: Sequence[ScoredRun]) -> Path:
    """Writes `OUT/report.html` with its pictures, and returns its path.

    Args:
        out: the folder of the demo, in which the runs lie.
        title: what was mapped.
        columns: heading of each key of the rows that is shown.
        runs: the last one is shown in 3D with its key frame.

    Raises:
        JaxmapError: a run is missing or broken, or the page cannot be written.
    """
    last = runs[-1]
    shown = read_run(out / str(last.row["run"]))
    grid = shown.reader.grid
    top = top_down_of(shown.reader, *shown.source.fusion, (slice(0, grid.shape[0]), slice(0, grid.shape[1])))
    box_m = map_sheet(np.zeros((0, 0, 3)), top, grid, shown.trajectory_world, legend=()).box_m
    look: dict[str, Any] = dict(box_m=box_m, layout=HALF)
    names = (shown.classes, shown.trajectory_world)
    top_down_picture(top, grid, *names, out / "map.png", layout=HALF)
    write_truth_map(out / "truth.png", last.evaluation, last.backdrop, **look)
    errors, verdicts = "", {}
    for run in runs:
        path, name = out / f"{run.row['run']}.png", str(run.row["map"])
        write_error_map(path, run.evaluation, run.backdrop, **look)
        errors += _picture(path, f"Errors: {name}", f"{_linked(run.row)}: IoU {_number(run.row['iou'])}")
        verdicts |= verdict_colours(run.evaluation)
    above = _picture(out / "map.png", "Top-down map", f"The map ({escape(str(last.row['map']))}) and the rover's path")
    above += _picture(out / "truth.png", "Ground truth", "Orthomosaic, at another time of day, with the true rocks")
    classes = shown.classes
    there = {name: class_colours(classes)[index] for index, name in enumerate(classes) if (top.label == index).any()}
    bodies = [
        _head(title, columns, shown, last.row),
        drive_section(shown, out / "report.html"),
        section(
            "Map and ground truth",
            _legend(there | {"not observed": UNOBSERVED_COLOUR}) + f'<div class="pairs">{above}</div>',
        ),
        section("Scores", f'<div class="tables"><figure>{_scores(columns, runs)}</figure></div>{_meaning(last.row)}'),
        section("Where each map is right and wrong", _legend(verdicts) + f'<div class="pairs">{errors}</div>'),
    ]
    return write_page(out / "report.html", title, "".join(bodies), drawn=len(shown.voxels.label) > 0)


def _head(title: str, columns: Mapping[str, str], shown: RunContents, row: Row) -> str:
    lead = (
        f"{shown.reader.frames_fused} stereo frames and the rover's poses become a 3D semantic voxel map: by "
        "the two labellers of Chiodini et al. (2020) under their fusion rule, and by jaxmap's own. Each map is scored "
        "against a labelled orthomosaic."
    )
    # The largest rocks, and all: stones are many, and few of them are found.
    counts = [key for key in list(columns)[1:] if " of " in str(row[key])]
    stats: list[tuple[str, str | None]] = [
        *((f"{key} of rock", _number(row[key.lower()])) for key in ("IoU", "Precision", "Recall")),
        *(("rocks found" if key == "found" else f"found {columns[key]}", row[key]) for key in counts[:1] + counts[-1:]),
        ("frames/s", _number(row["frames_per_s"])),
    ]
    return header("jaxmap demo", title, lead, stats)


def _scores(columns: Mapping[str, str], runs: Sequence[ScoredRun]) -> str:
    """The table; the greatest number of a column is bold."""
    name, *keys = columns
    cells = [[_number(run.row[key]) for key in keys] for run in runs]
    for column, key in enumerate(keys):
        numbers = [run.row[key] if isinstance(run.row[key], float) else -np.inf for run in runs]
        if max(numbers) > min(numbers):
            best = cells[int(np.argmax(numbers))]
            best[column] = f"<b>{best[column]}</b>"
    rows = [(_linked(run.row), *row) for run, row in zip(runs, cells, strict=True)]
    return table([escape(columns[key]) for key in (name, *keys)], rows)


def _meaning(row: Row) -> str:
    """What the figures of the table mean."""
    share, reach_m = row["rocks"]["found_share"], row["max_range_m"] or row["view_range_m"]
    return (
        "<p>The first two are fused by the paper's rule; DeepLabv3+ is the bundled network in both of its rows. "
        f"Cells of {row['cell_size_m']:g} m within {reach_m:g} m of the camera. A rock is found where the map calls "
        f"at least {share:.0%} of its area in view rock. Frames/s: the whole pipeline, with stereo matching.</p>"
    )


def _legend(colours: Mapping[str, Sequence[int]]) -> str:
    entries = (
        f'<span><i class="swatch" style="background:rgb({r},{g},{b})"></i>{escape(name)}</span>'
        for name, (r, g, b) in colours.items()
    )
    return f'<p class="legend">{"".join(entries)}</p>'


def _linked(row: Row) -> str:
    return f'<a href="{escape(str(row["run"]))}/report.html">{escape(str(row["map"]))}</a>'


def _number(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.2f}" if abs(value) < 10 else f"{value:.0f}"
    return escape("–" if value is None else str(value))


def _picture(path: Path, alt: str, caption: str) -> str:
    return figure(f"{inline_image(path, alt, width_px=1100)}", caption)
