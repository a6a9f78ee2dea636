"""The scores of a run against ground truth, as a section of its report."""

from __future__ import annotations

import json
from html import escape
from pathlib import Path
from typing import Any

from jaxmap.errors import JaxmapError
from jaxmap.report.inline import inline_image
from jaxmap.report.wording import SCORE_COLUMNS, value_text


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
        body = "".join(_row(name, values) for name, values in rows)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        remarks.append(f"{path.name} could not be read: the scores are left out.")
        return ""
    head = "".join(f'<th scope="col">{name}</th>' for name in ("Counted", *SCORE_COLUMNS.values()))
    table = f'<div class="list"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    return f"<section><h2>Against ground truth</h2><p>{_basis(scores)}</p>{table}{_picture(run, remarks)}</section>"


def _row(name: str, values: dict[str, Any]) -> str:
    cells = "".join(f"<td>{value_text(values.get(key))}</td>" for key in SCORE_COLUMNS)
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
