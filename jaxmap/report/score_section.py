"""The scores of a run against ground truth, as a section of its report."""

from __future__ import annotations

import json
from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import Any

from jaxmap.errors import JaxmapError
from jaxmap.report.inline import inline_image
from jaxmap.report.wording import MISSED_COLUMNS, SCORE_COLUMNS, number_text, value_text


def score_section(run: Path, remarks: list[str]) -> str:
    """What `jaxmap evaluate` left in a run folder: a table and the error map; empty where it left nothing.

    What cannot be read is left out and told in `remarks`.
    """
    path = run / "scores.json"
    if not path.is_file():
        return ""
    try:
        scores = json.loads(path.read_text(encoding="utf-8"))
        rows = [("observed cells", scores), ("all cells in view", scores["in_view"])]
        if "registration" in scores:
            rows.append(("observed, before registration", scores["registration"]["before"]))
        body = "".join(_row(name, values, SCORE_COLUMNS) for name, values in rows)
        ensemble = _ensemble(scores["ensemble"]) if "ensemble" in scores else ""
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        remarks.append(f"{path.name} could not be read: the scores are left out.")
        return ""
    table = _table(("Counted", *SCORE_COLUMNS.values()), body)
    parts = f"<p>{_basis(scores)}</p>{table}{ensemble}{_picture(run, remarks)}"
    return f"<section><h2>Against ground truth</h2>{parts}</section>"


def _table(headings: Iterable[str], body: str) -> str:
    head = "".join(f'<th scope="col">{name}</th>' for name in headings)
    return f'<div class="list"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _ensemble(scores: dict[str, Any]) -> str:
    """How well the ensemble tells missed cells, and how often it is right by what it says."""
    rows = [("the ensemble", scores), ("the map alone", scores["map_alone"])]
    ranking = _table(
        ("Missed cells, by", *MISSED_COLUMNS.values()),
        "".join(_row(name, values, MISSED_COLUMNS) for name, values in rows),
    )
    bins = "".join(
        _row(f"{number_text(part['from'])} to {number_text(part['to'])}", part, ("cells", "said", "true"))
        for part in scores["reliability"]
    )
    told = (
        f"Of {value_text(scores['cells'])} cells that the map does not call so, {value_text(scores['missed_cells'])} "
        f"are; the ensemble expected {value_text(float(scores['expected_missed_cells']))}."
    )
    return f"<p>{told}</p>{ranking}" + _table(("Probability of a miss", "cells", "mean", "truly missed"), bins)


def _row(name: str, values: dict[str, Any], columns: Iterable[str]) -> str:
    cells = "".join(f"<td>{value_text(values.get(key))}</td>" for key in columns)
    return f'<tr><th scope="row">{escape(name)}</th>{cells}</tr>'


def _basis(scores: dict[str, Any]) -> str:
    rocks = scores.get("rocks")
    facts = [("cells", scores.get("cells")), ("frames", scores.get("frames"))]
    if isinstance(rocks, dict):
        facts += [("rocks in view", rocks.get("count")), ("of them missed", rocks.get("missed"))]
    told = ", ".join(f"{value_text(value)} {name}" for name, value in facts if value is not None)
    size, reach = scores.get("cell_size_m"), scores.get("max_range_m")
    within = f", within {value_text(reach, 'm')}" if reach is not None else ""
    return f"Scored for {escape(str(scores.get('class')))} in cells of {value_text(size, 'm')}{within}: {told}."


def _picture(run: Path, remarks: list[str]) -> str:
    path = run / "errors.png"
    if not path.is_file():
        return ""
    try:
        return f'<div class="paper">{inline_image(path, "Found, imagined and missed rock, from above")}</div>'
    except JaxmapError:
        remarks.append(f"{path.name} could not be read and is left out.")
        return ""
