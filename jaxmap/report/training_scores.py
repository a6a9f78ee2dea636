"""The scores of a network as HTML: by class, what is taken for what, and how far confidence can be trusted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from jaxmap.labels import class_colours
from jaxmap.report.charts import Chart, Series, line_chart
from jaxmap.report.training_pictures import MISSED, WRONG, rgb, swatch
from jaxmap.report.wording import share_text, value_text

Scores = Mapping[str, Any]
"""What `SegmentationScores.summary` gives, with its `calibration` and the `epoch` where they are known."""

_WIDE = 6
_STRONGEST = 0.6


def score_text(value: object) -> str:
    """A score between 0 and 1 with three digits; a dash where there is none."""
    if not isinstance(value, int | float) or not 0 <= value <= 1:
        return "–"
    return f"{value:.3f}"


def class_table(best: Scores, last: Scores | None, classes: Sequence[str]) -> str:
    """IoU, precision and recall of each class; the IoU of the last epoch beside them where it is another."""
    colours = class_colours(classes)[: len(classes)].tolist()
    heads = [
        "Class",
        "IoU",
        *(["IoU, last"] if last else []),
        "precision",
        "recall",
        f"true {best.get('unit', 'pixel')}s",
        "",
    ]
    body = ""
    for name, colour in zip(classes, colours, strict=True):
        scores = _of_class(best, name)
        iou = scores.get("iou")
        values = [score_text(iou), *([score_text(_of_class(last, name).get("iou"))] if last else [])]
        values += [score_text(scores.get("precision")), score_text(scores.get("recall"))]
        width = 100 * iou if isinstance(iou, int | float) else 0
        body += (
            f'<tr><th scope="row">{swatch(colour)}{escape(name)}</th>'
            + "".join(f"<td>{text}</td>" for text in [*values, value_text(scores.get("pixels"))])
            + f'<td class="bar"><i style="width:{width:.1f}%;background:{rgb(colour)}"></i></td></tr>'
        )
    head = "".join(f'<th scope="col">{text}</th>' for text in heads)
    table = f'<table class="barred"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
    return f"<figure><figcaption>By class</figcaption>{table}</figure>"


def confusion_table(scores: Scores, classes: Sequence[str]) -> str:
    """The confusion matrix in percent of each true class; empty where there is none."""
    counts = scores.get("confusion")
    if not counts:
        return ""
    upright = " upright" if len(classes) > _WIDE else ""
    head = "".join(f'<th scope="col"><span>{escape(name)}</span></th>' for name in classes)
    body = ""
    for row, (name, pixels) in enumerate(zip(classes, counts, strict=True)):
        total = sum(pixels)
        cells = "".join(
            _confusion_cell(count, total, name, other, right=row == column)
            for column, (other, count) in enumerate(zip(classes, pixels, strict=True))
        )
        body += f'<tr><th scope="row">{escape(name)}</th>{cells}</tr>'
    table = (
        f'<table class="confusion{upright}"><thead><tr><th scope="col">true ↓ taken for →</th>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table>"
    )
    return f"<figure><figcaption>Confusion, % of the true class</figcaption>{table}</figure>"


def calibration_chart(scores: Scores) -> str:
    """Accuracy over confidence, and the share of pixels at each confidence; empty where it is not known."""
    bins = [one for one in scores.get("calibration") or () if one[0] > 0]
    total = sum(pixels for pixels, _, _ in bins)
    if not total:
        return ""
    points = sorted((confidence / pixels, correct / pixels, pixels / total) for pixels, confidence, correct in bins)
    series = [
        Series("ideal", [(confidence, confidence) for confidence, _, _ in points], "var(--quiet)"),
        Series("pixels", [(confidence, share) for confidence, _, share in points], "var(--bar)"),
        Series(
            "accuracy", [(confidence, accuracy) for confidence, accuracy, _ in points], "var(--accent)", strong=True
        ),
    ]
    chart = Chart("Accuracy over confidence", "confidence", "share", x_range=(0, 1), y_range=(0, 1))
    error = score_text(scores.get("ece"))
    caption = f"Calibration: confidence is off by {error} on average"
    return f"<figure><figcaption>{caption}</figcaption>{line_chart(chart, series)}</figure>"


def _of_class(scores: Scores | None, name: str) -> Mapping[str, Any]:
    return ((scores or {}).get("classes") or {}).get(name) or {}


def _confusion_cell(count: int, total: int, true: str, taken: str, *, right: bool) -> str:
    if not total:
        return "<td>–</td>"
    share = count / total
    red, green, blue = MISSED if right else WRONG
    title = escape(f"{true} taken for {taken}: {count:,} pixels")
    shade = f"rgba({red},{green},{blue},{_STRONGEST * share:.3f})"
    return f'<td style="background:{shade}" title="{title}">{share_text(share).replace("&nbsp;%", "")}</td>'
