"""The page of a tuning: what the numbers were and became, what that did to scores and calibration, and how it went."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np

from jaxmap.report.charts import Chart, Mark, Series, line_chart
from jaxmap.report.page import page
from jaxmap.report.wording import number_text, value_text

Stage = Mapping[str, Any]
"""One descent: `name best_step history scores calibration parameters`, as the JSON of `jaxmap tune` has it."""

_PARTS = {"held_out": "Held-out ground", "tuned_on": "Ground tuned on"}
_SCORES = {
    "iou": "IoU",
    "precision": "precision",
    "recall": "recall",
    "accuracy": "accuracy",
    "nll": "NLL",
    "brier": "Brier",
    "ece": "calibration error",
}


def tuning_page(title: str, result: Mapping[str, Any]) -> str:
    """The whole page as HTML, which needs no other file and no network.

    Args:
        title: its heading.
        result: what `jaxmap tune` writes into its JSON.
    """
    style = files("jaxmap.report").joinpath("training_page.css").read_text(encoding="utf-8")
    sections = [
        f"<style>{style}</style>",
        _header(title, result),
        *(_stage(stage) for stage in result["stages"]),
        _parameters(result),
        _traverses(result["traverses"]),
        _notes(result["notes"]),
        "<footer>Made by jaxmap.</footer>",
    ]
    return page(title, "".join(sections), drawn=False)


def _header(title: str, result: Mapping[str, Any]) -> str:
    scores = result["stages"][-1]["scores"]["held_out"]
    stats = "".join(
        f"<div><dt>{name}, held out</dt><dd>{_text(scores[key]['before'])} → {_text(scores[key]['after'])}</dd></div>"
        for key, name in (("iou", "IoU"), ("ece", "calibration error"), ("nll", "NLL"))
    )
    line = escape(f"{result['class']}, labels: {result['labeller']}")
    return (
        f'<header><p class="kind">Tuning of fusion</p><h1>{escape(title)}</h1><p>{line}</p>'
        f'<dl class="stats">{stats}</dl></header>'
    )


def _stage(stage: Stage) -> str:
    tables = "".join(_score_table(name, stage["scores"][part]) for part, name in _PARTS.items())
    charts = [
        ("Loss", _losses(stage)),
        *((f"Calibration, {_PARTS[part].lower()}", _calibration(stage, part)) for part in _PARTS),
    ]
    figures = "".join(f"<figure><figcaption>{name}</figcaption>{chart}</figure>" for name, chart in charts if chart)
    return (
        f'<section><h2>{escape(stage["name"].capitalize())}</h2><div class="tables">{tables}</div>'
        f"<p>In brackets the middle nine tenths of 1,000 draws of whole rocks and blocks of ground.</p>"
        f'<div class="charts">{figures}</div></section>'
    )


def _score_table(title: str, scores: Mapping[str, Any]) -> str:
    body = "".join(
        f'<tr><th scope="row">{name}</th>'
        + "".join(f"<td>{_interval_text(scores[key], when)}</td>" for when in ("before", "after", "change"))
        + "</tr>"
        for key, name in _SCORES.items()
    )
    head = "".join(f'<th scope="col">{name}</th>' for name in ("", "before", "after", "change"))
    table = f'<table class="barred"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
    return f"<figure><figcaption>{title}</figcaption>{table}</figure>"


def _interval_text(row: Mapping[str, Any], when: str) -> str:
    interval = row[f"{when}_interval"]
    around = f" ({_text(interval[0])} to {_text(interval[1])})" if interval else ""
    return _text(row[when]) + around


def _losses(stage: Stage) -> str:
    history = stage["history"]
    series = [
        Series("held out", [(row["step"], row["held_out"]) for row in history], "var(--accent)", strong=True),
        Series("tuned on", [(row["step"], row["loss"]) for row in history], "var(--quiet)"),
    ]
    return line_chart(Chart("Loss by step", "step", "loss", mark=Mark(stage["best_step"], "kept")), series)


def _calibration(stage: Stage, part: str) -> str:
    bins = stage["calibration"][part]

    def points(when: str) -> list[tuple[float, float]]:
        return sorted((row["said"], row["true"]) for row in bins[when])

    series = [
        Series("ideal", [(0.0, 0.0), (1.0, 1.0)], "var(--quiet)"),
        Series("before", points("before"), "var(--bar)"),
        Series("after", points("after"), "var(--accent)", strong=True),
    ]
    chart = Chart(
        "How often cells are of the class, by the probability that the map gives them",
        "probability said",
        "share true",
        x_range=(0, 1),
        y_range=(0, 1),
    )
    return line_chart(chart, series)


def _parameters(result: Mapping[str, Any]) -> str:
    columns = [result["before"], *(stage["parameters"] for stage in result["stages"])]
    head = "".join(
        f'<th scope="col">{escape(name)}</th>' for name in ("", "before", *(s["name"] for s in result["stages"]))
    )
    names = dict.fromkeys(name for column in columns for name in column)
    body = "".join(
        f'<tr><th scope="row">{escape(name.replace("_", " "))}</th>'
        + "".join(f"<td>{_numbers_text(column.get(name))}</td>" for column in columns)
        + "</tr>"
        for name in names
    )
    table = f'<div class="list"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    return f"<section><h2>Numbers</h2>{table}</section>"


def _numbers_text(value: Any) -> str:
    """A number; a matrix row by row."""
    if value is None:
        return "–"
    array = np.asarray(value, np.float64)
    if array.ndim > 1:
        return "<br>".join(_numbers_text(row) for row in array)
    return " ".join(number_text(float(f"{number:.3g}")) for number in array.ravel())


def _traverses(traverses: Sequence[Mapping[str, Any]]) -> str:
    rows = "".join(
        f'<tr><th scope="row">{escape(one["sequence"])}</th>'
        + "".join(f"<td>{value_text(one[key])}</td>" for key in ("frames", "cells", "held_out_cells"))
        + "</tr>"
        for one in traverses
    )
    head = "".join(f'<th scope="col">{name}</th>' for name in ("Sequence", "frames", "cells", "held out"))
    table = f'<div class="list"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    return f"<section><h2>Traverses</h2>{table}</section>"


def _notes(notes: Sequence[str]) -> str:
    items = "".join(f"<li>{escape(note)}</li>" for note in notes)
    return f"<section><h2>Notes</h2><ul>{items}</ul></section>" if items else ""


def _text(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"
