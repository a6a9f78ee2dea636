"""The sections of a run's page that `jaxmap evaluate` leaves something for."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import Any

from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import read_json
from jaxmap.report.page import paper, section, table
from jaxmap.report.wording import MISSED_COLUMNS, POSE_COLUMNS, SCORE_COLUMNS, number_text, pose_rows, value_text

_UNREADABLE = (JaxmapError, ValueError, KeyError, TypeError, AttributeError)


def map_score_section(run: Path, remarks: list[str]) -> str:
    """Scores and error map that `jaxmap evaluate` left in a run folder."""
    if not (run / "scores.json").is_file():
        return ""
    try:
        text = _scores(read_json(run / "scores.json"))
    except _UNREADABLE:
        remarks.append("scores.json could not be read: the scores are left out.")
        return ""
    image = paper(run / "errors.png", "Rock that was found, falsely called and missed", remarks)
    return section("Against ground truth", text + image)


def _scores(scores: dict[str, Any]) -> str:
    def listed(title: str, columns: Iterable[tuple[str, str]], rows: Iterable[tuple[str, dict[str, Any]]]) -> str:
        keys, headings = zip(*columns, strict=True)
        cells = [(escape(name), *(value_text(values.get(key)) for key in keys)) for name, values in rows]
        return f'<div class="tables"><figure>{table((title, *headings), cells)}</figure></div>'

    rocks = scores.get("rocks") or {}
    facts = {"cells": scores.get("cells"), "frames": scores.get("frames")}
    facts |= {"rocks in view": rocks.get("count"), "of them missed": rocks.get("missed")}
    size, reach = scores.get("cell_size_m"), scores.get("max_range_m")
    within = f", within {value_text(reach, 'm')}" if reach is not None else ""
    counted = ", ".join(f"{value_text(value)} {name}" for name, value in facts.items() if value is not None)
    rows = [("observed cells", scores), ("all cells in view", scores["in_view"])]
    if "registration" in scores:
        rows.append(("observed, before registration", scores["registration"]["before"]))
    html = (
        f"<p>Scored for {escape(str(scores.get('class')))} in cells of {value_text(size, 'm')}{within}: {counted}.</p>"
        + listed("Counted", SCORE_COLUMNS.items(), rows)
    )
    if "ensemble" in scores:
        ensemble = scores["ensemble"]
        bins = [(f"{number_text(row['from'])} to {number_text(row['to'])}", row) for row in ensemble["reliability"]]
        html += (
            f"<p>Of {value_text(ensemble['cells'])} cells that the map does not call so, "
            f"{value_text(ensemble['missed_cells'])} are; the ensemble expected "
            f"{value_text(float(ensemble['expected_missed_cells']))}.</p>"
        )
        ranked = [("the ensemble", ensemble), ("the map alone", ensemble["map_alone"])]
        html += listed("Missed cells, by", MISSED_COLUMNS.items(), ranked)
        columns = {"cells": "cells", "said": "mean", "true": "truly missed"}
        html += listed("Probability of a miss", columns.items(), bins)
    return html


def pose_score_section(run: Path, remarks: list[str]) -> str:
    """Errors of the poses that `jaxmap evaluate --poses` left in a run folder."""
    if not (run / "pose_scores.json").is_file():
        return ""
    try:
        scores = read_json(run / "pose_scores.json")
        rows = [
            (escape(row["error"]), *(value_text(row[column]) for column in POSE_COLUMNS)) for row in pose_rows(scores)
        ]
        facts = (
            f"{value_text(scores['poses'])} of {value_text(scores['poses_of_run'])} poses were compared over "
            f"{value_text(round(scores['path_length_m'], 1), 'm')}, counted as evo counts."
        )
    except _UNREADABLE:
        remarks.append("pose_scores.json could not be read: the errors of the poses are left out.")
        return ""
    content = table(("Error", *POSE_COLUMNS.values()), rows)
    return section("Poses against true ones", f'<p>{facts}</p><div class="tables"><figure>{content}</figure></div>')
