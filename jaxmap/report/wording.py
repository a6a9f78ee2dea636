"""Numbers and names of metrics as people read them."""

from __future__ import annotations

import math
from html import escape

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
