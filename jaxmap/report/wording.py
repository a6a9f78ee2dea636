"""Numbers and names of metrics as people read them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape
from typing import Any

_THIN = "\N{NARROW NO-BREAK SPACE}"
_UNITS = {"m": "m", "px": "px", "ms": "ms", "s": "s", "mib": "MiB", "deg": "°"}
_EXTENTS = {"shape", "voxel_size_m"}
_NAMES = {
    "fx": "Focal length x",
    "fy": "Focal length y",
    "cx": "Principal point x",
    "cy": "Principal point y",
    "doffs": "Disparity offset",
    "crs": "Coordinate reference system",
}

SCORE_COLUMNS = {
    "accuracy": "accuracy",
    "iou": "IoU",
    "precision": "precision",
    "recall": "recall",
    "f1": "F1",
    "coverage": "coverage",
    "tp": "TP",
    "fp": "FP",
    "fn": "FN",
    "tn": "TN",
    "nll": "NLL",
    "brier": "Brier",
    "ece": "ECE",
}
"""Headings of the scores of a map, by their keys (DESIGN: Scores JSON)."""

POSE_COLUMNS = {name: name for name in ("rmse", "mean", "median", "std", "min", "max", "count")}
"""Headings of the errors of poses, by their keys in `evaluation.pose_errors.pose_scores`."""

MISSED_COLUMNS = {
    "auc": "ROC AUC",
    "average_precision": "average precision",
    "nll": "NLL",
    "brier": "Brier",
    "ece": "ECE",
}
"""Headings of the scores of an ensemble, by their keys."""


def name_and_unit(key: str) -> tuple[str, str]:
    """What a key says: `peak_resident_mib` is "Peak resident" in "MiB"."""
    *words, last = key.split("_")
    if last in _UNITS and words and words[-1] != "per":
        return _sentence(words), _UNITS[last]
    return _sentence([*words, last]), ""


def value_text(value: object, unit: str = "", key: str = "") -> str:
    """A value in words, escaped for HTML; a dash where there is none."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        # Extents are multiplied, everything else is listed.
        text = (" × " if key in _EXTENTS else ", ").join(value_text(item) for item in value) or "–"
    elif isinstance(value, int):
        text = _grouped(f"{value:,}")
    elif isinstance(value, float):
        text = number_text(value)
    else:
        text = "–" if value is None or value == "" else escape(str(value))
    return f"{text}&nbsp;{unit}" if unit and text != "–" else text


def number_text(value: float) -> str:
    """A number with four digits that count, or all before the point and two after it."""
    if not math.isfinite(value):
        return "–"
    return _grouped(f"{value:,.2f}".rstrip("0").rstrip(".") if abs(value) >= 1000 else f"{value:.4g}")


def share_text(share: float) -> str:
    """A fraction in percent."""
    return f"{100 * share:.1f}&nbsp;%"


def _grouped(digits: str) -> str:
    return digits.replace(",", _THIN).replace("-", "\N{MINUS SIGN}")


def _sentence(words: list[str]) -> str:
    text = escape(" ".join(words))
    if text in _NAMES:
        return _NAMES[text]
    return text[:1].upper() + text[1:]


def pose_rows(scores: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The errors of poses as rows of a table: what each is of (`error`), and `POSE_COLUMNS`, None where unknown."""
    piece = f"over {scores['way_m']:g} m of the path"
    named = {
        "ate_m": "ATE, m, as they are",
        "ate_aligned_m": "ATE, m, aligned",
        "ate_scaled_m": "ATE, m, aligned with scale",
        "rpe_frame_m": "RPE, m, from frame to frame",
        "rpe_frame_deg": "RPE, deg, from frame to frame",
        "rpe_way_m": f"RPE, m, {piece}",
        "rpe_way_deg": f"RPE, deg, {piece}",
    }
    return [
        {"error": name, **{column: (scores[key] or {}).get(column) for column in POSE_COLUMNS}}
        for key, name in named.items()
    ]
