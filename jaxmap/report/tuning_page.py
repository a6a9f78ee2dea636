"""The page of a tuning: parameters, scores and calibration before and after, and the course of the loss."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxmap.report.page import (
    ACCENT,
    BAR,
    INK,
    LINE,
    QUIET,
    figure,
    header,
    notes_section,
    page,
    section,
    svg_of,
    table,
)
from jaxmap.report.wording import number_text, value_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
    stages, scores = result["stages"], result["stages"][-1]["scores"]["held_out"]
    stats = [
        (f"{name}, held out", f"{_text(scores[key]['before'])} → {_text(scores[key]['after'])}")
        for key, name in (("iou", "IoU"), ("ece", "calibration error"), ("nll", "NLL"))
    ]
    columns = [result["before"], *(stage["parameters"] for stage in stages)]
    names = dict.fromkeys(name for column in columns for name in column)
    parameters = [
        (escape(name.replace("_", " ")), *(_numbers_text(column.get(name)) for column in columns)) for name in names
    ]
    traverses = [
        (escape(one["sequence"]), *(value_text(one[key]) for key in ("frames", "cells", "held_out_cells")))
        for one in result["traverses"]
    ]
    body = [
        header("Tuning of fusion", title, f"{result['class']}, labels: {result['labeller']}", stats),
        *map(_stage, stages),
        section("Parameters", _listed(("", "before", *(escape(stage["name"]) for stage in stages)), parameters)),
        section("Traverses", _listed(("Sequence", "frames", "cells", "held out"), traverses)),
        notes_section(result["notes"]),
        "<footer>Made by jaxmap.</footer>",
    ]
    return page(title, "".join(body), drawn=False)


def _listed(headings: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    return f'<div class="list">{table(headings, rows, "plain")}</div>'


def _stage(stage: Stage) -> str:
    tables = ""
    for part, title in _PARTS.items():
        scores = stage["scores"][part]
        rows = [
            (name, *(_interval_text(scores[key], when) for when in ("before", "after", "change")))
            for key, name in _SCORES.items()
        ]
        tables += figure(table(("", "before", "after", "change"), rows), title)
    charts = figure(_losses(stage), "Loss") + "".join(
        figure(_calibration(stage["calibration"][part]), f"Calibration, {title.lower()}")
        for part, title in _PARTS.items()
    )
    return section(
        escape(stage["name"].capitalize()),
        f'<div class="tables">{tables}</div>'
        "<p>In brackets the middle nine tenths of 1,000 bootstrap samples of whole rocks and blocks of ground.</p>"
        f'<div class="charts">{charts}</div>',
    )


def _chart(x_name: str, y_name: str) -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(5.2, 3.1), layout="constrained")
    axes = drawing.add_subplot()
    axes.set_xlabel(x_name, color=QUIET)
    axes.set_ylabel(y_name, color=QUIET)
    axes.tick_params(color=LINE, labelcolor=QUIET)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.spines["bottom"].set_color(LINE)
    axes.grid(axis="y", color=LINE)
    return drawing, axes


def _losses(stage: Stage) -> str:
    history = stage["history"]
    steps, best = [row["step"] for row in history], stage["best_step"]
    drawing, axes = _chart("step", "loss")
    axes.plot(steps, [row["loss"] for row in history], color=QUIET, label="tuned on")
    axes.plot(steps, [row["held_out"] for row in history], color=ACCENT, linewidth=2.4, label="held out")
    axes.axvline(best, color=QUIET, linestyle=":", linewidth=1, label=f"kept, step {best}")
    axes.legend(frameon=False, labelcolor=INK)
    return svg_of(drawing, "Loss by step")


def _calibration(bins: Mapping[str, Any]) -> str:
    drawing, axes = _chart("predicted probability", "observed share")
    axes.plot([0, 1], [0, 1], color=QUIET, linestyle=":", linewidth=1, label="ideal")
    looks: dict[str, Any] = {"before": dict(color=BAR), "after": dict(color=ACCENT, linewidth=2.4)}
    for when, look in looks.items():
        points = sorted((row["said"], row["true"]) for row in bins[when])
        axes.plot(*zip(*points, strict=True) if points else ((), ()), marker="o", markersize=3.5, label=when, **look)
    axes.set(xlim=(0, 1), ylim=(0, 1))
    axes.legend(frameon=False, labelcolor=INK)
    return svg_of(drawing, "How often cells are of the class, by the probability that the map gives them")


def _interval_text(row: Mapping[str, Any], when: str) -> str:
    interval = row[f"{when}_interval"]
    around = f" ({_text(interval[0])} to {_text(interval[1])})" if interval else ""
    return _text(row[when]) + around


def _numbers_text(value: Any) -> str:
    """A number; a matrix row by row."""
    if value is None:
        return "–"
    array = np.asarray(value, np.float64)
    if array.ndim > 1:
        return "<br>".join(_numbers_text(row) for row in array)
    return " ".join(number_text(float(f"{number:.3g}")) for number in array.ravel())


def _text(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"
