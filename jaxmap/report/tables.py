"""The metrics of a run as HTML tables; keys that nobody knows here are shown all the same."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

from jaxmap.labels import class_colours
from jaxmap.report.wording import name_and_unit, number_text, share_text, value_text

_TITLES = {
    "camera": "Camera",
    "grid": "Grid",
    "times": "Time",
    "points": "Points",
    "voxels": "Voxels",
    "ensemble": "Ensemble",
    "memory": "Memory",
    "sequence": "Sequence",
}
_ELSEWHERE = {"skipped", "notes", "stages", "by_class"}


def metric_tables(metrics: dict[str, Any], classes: Sequence[str]) -> str:
    """All metrics, one table for each group."""
    stages = group(metrics, "times").get("stages")
    by_class = group(metrics, "voxels").get("by_class")
    wide = _stage_table(stages) if isinstance(stages, dict) and stages else ""
    if isinstance(by_class, dict) and by_class:
        wide += _class_table(by_class, classes)
    tables = []
    others = [key for key in metrics if key not in _TITLES]
    for key in [*_TITLES, *others]:
        if isinstance(metrics.get(key), dict):
            tables.append(_table(_TITLES.get(key, name_and_unit(key)[0]), metrics[key]))
    tables.append(_table("Other", {key: metrics[key] for key in others if not isinstance(metrics[key], dict)}))
    return f'<div class="tables">{wide}<div class="cards">{"".join(tables)}</div></div>'


def group(metrics: dict[str, Any], key: str) -> dict[str, Any]:
    """A group of metrics; empty where it is absent or no group."""
    value = metrics.get(key)
    return value if isinstance(value, dict) else {}


def _stage_table(stages: dict[str, Any]) -> str:
    rows = {name: stage for name, stage in stages.items() if isinstance(stage, dict)}
    totals = {name: _number(stage.get("total_s")) for name, stage in rows.items()}
    most = max(totals.values(), default=0.0) or 1.0
    body = "".join(
        f'<tr><th scope="row">{escape(str(name).replace("_", " "))}</th>'
        + "".join(f"<td>{_cell(stage.get(key))}</td>" for key in ("median_ms", "p95_ms", "total_s"))
        + f'<td class="bar"><i style="width:{100 * totals[name] / most:.1f}%"></i></td></tr>'
        for name, stage in rows.items()
    )
    head = "".join(f'<th scope="col">{name}</th>' for name in ("Stage", "median, ms", "95 %, ms", "total, s", ""))
    return _barred_table("Stages", head, body)


def _class_table(by_class: dict[str, Any], classes: Sequence[str]) -> str:
    colours = dict(zip(classes, class_colours(classes).tolist(), strict=False))
    counts = {name: _number(count) for name, count in by_class.items()}
    total = sum(counts.values()) or 1.0
    body = ""
    for name, count in counts.items():
        red, green, blue = colours.get(name, class_colours(())[0].tolist())
        colour = f"rgb({red},{green},{blue})"
        body += (
            f'<tr><th scope="row"><i class="swatch" style="background:{colour}"></i>{escape(str(name))}</th>'
            f"<td>{value_text(by_class[name])}</td><td>{share_text(count / total)}</td>"
            f'<td class="bar"><i style="width:{100 * count / total:.1f}%;background:{colour}"></i></td></tr>'
        )
    head = "".join(f'<th scope="col">{name}</th>' for name in ("Class", "voxels", "share", ""))
    return _barred_table("Occupied voxels by class", head, body)


def _barred_table(title: str, head: str, body: str) -> str:
    table = f'<table class="barred"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
    return f"<figure><figcaption>{title}</figcaption>{table}</figure>"


def _table(title: str, values: dict[str, Any]) -> str:
    rows = "".join(_row(key, value) for key, value in values.items() if key not in _ELSEWHERE)
    return f"<figure><figcaption>{title}</figcaption><table><tbody>{rows}</tbody></table></figure>" if rows else ""


def _row(key: str, value: object, prefix: str = "") -> str:
    if isinstance(value, dict):
        return "".join(_row(inner, item, f"{prefix}{key} ") for inner, item in value.items())
    name, unit = name_and_unit(f"{prefix}{key}")
    if isinstance(value, float) and key.endswith("fraction"):
        return f'<tr><th scope="row">{name}</th><td>{share_text(value)}</td></tr>'
    return f'<tr><th scope="row">{name}</th><td>{value_text(value, unit, key)}</td></tr>'


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else 0.0


def _cell(value: object) -> str:
    return number_text(float(value)) if isinstance(value, int | float) else "–"
