"""The page of a training run, rewritten while it proceeds: curves, scores, examples, recipe."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from numbers import Real
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from jaxmap.labels import IGNORE, class_colours
from jaxmap.report.page import ACCENT, BAR, INK, page
from jaxmap.report.pictures import overlay_labels
from jaxmap.report.training_charts import LIGHT_PANEL, QUIET, Line, class_inks, class_style, hex_of, line_chart
from jaxmap.report.wording import number_text, share_text, value_text
from jaxmap.training.validation import ValidationExample

MAX_EXAMPLES = 8
MAX_EPOCHS_DRAWN = 800
MAX_CLASSES_BESIDE = 6
"""Tables of more classes take the whole width."""
LARGEST = 1e30
"""Greater losses are not drawn: no scale would show the others."""
PANEL_WIDTH_PX = 480

WRONG, MISSED = (213, 94, 0), (0, 114, 178)
"""Vermilion and blue, which colour-blind people can distinguish (Okabe & Ito 2008)."""

Scores = Mapping[str, Any]
"""As `SegmentationScores.summary`, with its `calibration` and the `epoch` where they are known."""
Row = Mapping[str, float | int | None]
Pixels = UInt8[np.ndarray, "H W 3"]
Labels = UInt8[np.ndarray, "H W"]


@dataclass(frozen=True)
class TrainingRecord:
    """What the page shows of a training run.

    Attributes:
        title: its heading.
        classes: names in the order of the labels.
        history: one row for each epoch, in order: `epoch`, `step`, `learning_rate`, `train_loss`,
            `images_per_s`, `seconds` (of this epoch), and where it was validated `val_loss`,
            `mean_iou`, `accuracy`, `iou_CLASS`. Values that are missing, None or not finite are left out.
        summary: scores in validation by `"best"` and `"last"`, each as `SegmentationScores.summary` gives
            them, optionally with `epoch` and `calibration` (rows of pixels, summed confidence, correct pixels).
        facts: data and recipe, as names and texts.
        examples: images with true and predicted labels.
        status: one sentence shown at the top, such as why the run stopped; may be empty.
    """

    title: str
    classes: tuple[str, ...]
    history: Sequence[Row]
    summary: Mapping[str, Scores] = field(default_factory=dict)
    facts: Mapping[str, str] = field(default_factory=dict)
    examples: Sequence[ValidationExample] = ()
    status: str = ""

    @property
    def best(self) -> Scores:
        """The best scores, or else the last ones."""
        return self.summary.get("best") or self.summary.get("last") or {}

    @property
    def best_epoch(self) -> float | None:
        """The epoch of the best scores, or else that of the greatest mean IoU."""
        if (epoch := _number(self.best.get("epoch"))) is not None:
            return epoch
        return max(_points(self.history, "mean_iou"), key=lambda point: point[1], default=(None, 0))[0]


def training_page(record: TrainingRecord) -> str:
    """The whole page as HTML, which needs no other file and no network."""
    style = files("jaxmap.report").joinpath("training_page.css").read_text(encoding="utf-8")
    sections = [
        f"<style>{style}{class_style(record.classes)}</style>",
        _header(record),
        _curves(record),
        _scores(record),
        _examples(record),
        _facts(record.facts),
        "<footer>Made by jaxmap.</footer>",
    ]
    return page(record.title, "".join(sections), drawn=False)


def _header(record: TrainingRecord) -> str:
    best, rows = record.best, record.history
    losses, rates, times = (_values(rows, key) for key in ("train_loss", "images_per_s", "seconds"))
    stats: dict[str, str] = {}
    if best:
        stats["mean IoU"] = score_text(best.get("mean_iou"))
        stats[f"{best.get('unit', 'pixel')} accuracy"] = score_text(best.get("accuracy"))
        stats["calibration error"] = score_text(best.get("ece"))
    if losses:
        stats["training loss"] = number_text(float(f"{losses[-1]:.3g}"))
    if record.best_epoch is None:
        stats["epochs"] = value_text(len(rows))
    else:
        stats["best epoch"] = f"{number_text(record.best_epoch)} of {value_text(len(rows))}"
    if rates:
        stats["images/s"] = number_text(float(f"{sorted(rates)[len(rates) // 2]:.3g}"))
    if times:
        stats["time"] = duration_text(sum(times))
    banner = f'<p class="banner">{escape(record.status)}</p>' if record.status else ""
    cells = "".join(f"<div><dt>{name}</dt><dd>{text}</dd></div>" for name, text in stats.items())
    return (
        f'<header><p class="kind">Training</p><h1>{escape(record.title)}</h1>'
        f'<p>{escape(", ".join(record.classes))}</p>{banner}<dl class="stats">{cells}</dl></header>'
    )


def duration_text(seconds: float) -> str:
    """A duration in seconds, minutes or hours, to three digits at most."""
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return value_text(float(f"{seconds / size:.3g}") if unit == "h" else round(seconds / size), unit)
    return value_text(float(f"{seconds:.3g}"), "s")


def score_text(value: object) -> str:
    """A score between 0 and 1 with three digits; a dash where there is none."""
    if not isinstance(value, int | float) or not 0 <= value <= 1:
        return "–"
    return f"{value:.3f}"


def _points(rows: Sequence[Row], key: str) -> list[tuple[float, float]]:
    pairs = ((_number(row.get("epoch")), _number(row.get(key))) for row in rows)
    return [(epoch, value) for epoch, value in pairs if epoch is not None and value is not None]


def _values(rows: Sequence[Row], key: str) -> list[float]:
    return [number for row in rows if (number := _number(row.get(key))) is not None]


def _number(value: object) -> float | None:
    """A value that can be drawn, or None."""
    number = float(value) if isinstance(value, Real) else float("nan")
    return number if abs(number) < LARGEST else None


# --- curves


def _curves(record: TrainingRecord) -> str:
    rows, epoch = record.history, record.best_epoch
    if len(rows) > MAX_EPOCHS_DRAWN:
        rows = [rows[index] for index in np.linspace(0, len(rows) - 1, MAX_EPOCHS_DRAWN).round().astype(int)]
    mark = (epoch, "best") if epoch is not None and len(rows) > 1 else None
    colours = [hex_of(ink) for ink in class_inks(record.classes, LIGHT_PANEL)]

    def line(key: str, name: str = "", colour: str = ACCENT, *, strong: bool = True) -> Line:
        return Line(name, _points(rows, key), colour, strong)

    losses = [line("val_loss", "validation"), line("train_loss", "training", QUIET, strong=False)]
    ious = [
        line(f"iou_{name}", name, colour, strong=False) for name, colour in zip(record.classes, colours, strict=True)
    ]
    ious.append(line("mean_iou", "mean", INK))
    variables = {colour: f"--class-{index}" for index, colour in enumerate(colours)}
    # Never logarithmic: a schedule is recognised by its shape.
    rates = (0.0, 1.05 * max(_values(rows, "learning_rate"), default=0.0) or 1.0)
    charts = {
        "Loss": line_chart("Loss by epoch", ("epoch", "loss"), losses, mark=mark),
        "Intersection over union": line_chart(
            "IoU of each class by epoch", ("epoch", "IoU"), ious, y_range=(0, 1), mark=mark, variables=variables
        ),
        "Learning rate": line_chart(
            "Learning rate by epoch",
            ("epoch", "learning rate"),
            [line("learning_rate")],
            height_px=190,
            y_range=rates,
        ),
        "Speed": line_chart("Images per second by epoch", ("epoch", "images/s"), [line("images_per_s")], height_px=190),
    }
    figures = "".join(
        f"<figure><figcaption>{caption}</figcaption>{chart}</figure>" for caption, chart in charts.items() if chart
    )
    if not figures:
        return "<section><h2>Curves</h2><p>No epoch has ended yet.</p></section>"
    return f'<section><h2>Curves</h2><div class="charts">{figures}</div></section>'


# --- scores


def _scores(record: TrainingRecord) -> str:
    best, last = record.best, record.summary.get("last")
    if not best:
        return ""
    other = last if last and last.get("epoch") != best.get("epoch") else None
    images, pixels = value_text(best.get("images")), value_text(best.get("pixels"))
    when = f", after epoch {number_text(record.best_epoch)}" if record.best_epoch is not None else ""
    tables = class_table(best, other, record.classes) + confusion_table(best, record.classes)
    wide = " wide" if len(record.classes) > MAX_CLASSES_BESIDE else ""
    return (
        f'<section><h2>Scores</h2><div class="scores{wide}"><div class="tables">{tables}</div>'
        f"{calibration_chart(best)}</div>"
        f"<p>Validation: {images} images, {pixels} labelled {best.get('unit', 'pixel')}s{when}.</p></section>"
    )


def class_table(best: Scores, last: Scores | None, classes: Sequence[str]) -> str:
    """IoU, precision and recall of each class; the IoU of the last epoch beside them where it is another."""

    def of_class(scores: Scores | None, name: str) -> Mapping[str, Any]:
        return ((scores or {}).get("classes") or {}).get(name) or {}

    heads = ["Class", "IoU", *(["IoU, last"] if last else []), "precision", "recall"]
    heads += [f"true {best.get('unit', 'pixel')}s", ""]
    body = ""
    for name, colour in zip(classes, class_colours(classes).tolist(), strict=False):
        scores = of_class(best, name)
        iou = scores.get("iou")
        values = [score_text(iou), *([score_text(of_class(last, name).get("iou"))] if last else [])]
        values += [score_text(scores.get("precision")), score_text(scores.get("recall"))]
        width = 100 * iou if isinstance(iou, int | float) else 0
        body += (
            f'<tr><th scope="row">{swatch(colour)}{escape(name)}</th>'
            + "".join(f"<td>{text}</td>" for text in [*values, value_text(scores.get("pixels"))])
            + f'<td class="bar"><i style="width:{width:.1f}%;background:{hex_of(colour)}"></i></td></tr>'
        )
    head = "".join(f'<th scope="col">{text}</th>' for text in heads)
    table = f'<table class="barred"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
    return f"<figure><figcaption>By class</figcaption>{table}</figure>"


def confusion_table(scores: Scores, classes: Sequence[str]) -> str:
    """The confusion matrix in percent of each true class; empty where there is none."""
    counts = scores.get("confusion")
    if not counts:
        return ""

    def cell(row: int, column: int) -> str:
        total, count = sum(counts[row]), counts[row][column]
        if not total:
            return "<td>–</td>"
        red, green, blue = MISSED if row == column else WRONG
        title = escape(f"{classes[row]} taken for {classes[column]}: {count:,} pixels")
        shade = f"rgba({red},{green},{blue},{0.6 * count / total:.3f})"
        text = share_text(count / total).replace("&nbsp;%", "")
        return f'<td style="background:{shade}" title="{title}">{text}</td>'

    indices = range(len(classes))
    head = "".join(f'<th scope="col"><span>{escape(name)}</span></th>' for name in classes)
    body = "".join(
        f'<tr><th scope="row">{escape(classes[row])}</th>{"".join(cell(row, column) for column in indices)}</tr>'
        for row in indices
    )
    upright = " upright" if len(classes) > MAX_CLASSES_BESIDE else ""
    return (
        "<figure><figcaption>Confusion, % of the true class</figcaption>"
        f'<table class="confusion{upright}"><thead><tr><th scope="col">true ↓ predicted →</th>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></figure>"
    )


def calibration_chart(scores: Scores) -> str:
    """Accuracy over confidence, and the share of pixels at each confidence; empty where it is not known."""
    bins = [one for one in scores.get("calibration") or () if one[0] > 0]
    total = sum(pixels for pixels, _, _ in bins)
    if not total:
        return ""
    points = sorted((confidence / pixels, correct / pixels, pixels / total) for pixels, confidence, correct in bins)
    lines = [
        Line("ideal", [(confidence, confidence) for confidence, _, _ in points], QUIET),
        Line("pixels", [(confidence, share) for confidence, _, share in points], BAR),
        Line("accuracy", [(confidence, accuracy) for confidence, accuracy, _ in points], ACCENT, strong=True),
    ]
    caption = f"Calibration: confidence is off by {score_text(scores.get('ece'))} on average"
    axes = ("confidence", "share")
    chart = line_chart("Accuracy over confidence", axes, lines, x_range=(0, 1), y_range=(0, 1))
    return f"<figure><figcaption>{caption}</figcaption>{chart}</figure>"


def swatch(colour: Sequence[int]) -> str:
    """A small square of a colour."""
    return f'<i class="swatch" style="background:{hex_of(colour)}"></i>'


# --- examples and recipe


def _examples(record: TrainingRecord) -> str:
    shown, classes = record.examples[:MAX_EXAMPLES], record.classes
    if not shown:
        return ""
    entries = list(zip(classes, class_colours(classes).tolist(), strict=False))
    if len(classes) == 2:
        entries += [(f"{classes[1]} missed", MISSED), (f"{classes[1]} where there is none", WRONG)]
    else:
        entries.append(("error", WRONG))
    legend = "".join(f"<span>{swatch(colour)}{escape(text)}</span>" for text, colour in entries)
    frames = "".join(example_panels(example, classes) for example in shown)
    return f'<section><h2>Examples</h2><p class="legend">{legend}</p><div class="frames">{frames}</div></section>'


def example_panels(example: ValidationExample, classes: Sequence[str]) -> str:
    """Four pictures of an example in a row, as HTML: image, true labels, predicted ones, and errors."""
    image, truth, prediction = _smaller(example)
    panels = {
        "Image": image,
        "Truth": overlay_labels(image, truth, classes),
        "Network": overlay_labels(image, prediction, classes),
        "Error": error_picture(image, truth, prediction, len(classes)),
    }
    figures = ""
    for caption, picture in panels.items():
        buffer, (height, width) = io.BytesIO(), picture.shape[:2]
        # JPEG without chroma subsampling is several times faster than WebP, and the page is written often.
        Image.fromarray(picture).save(buffer, "jpeg", quality=88, subsampling=0)
        source = f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
        alt = escape(f"{caption}, {example.name}")
        figures += (
            f'<figure><img src="{source}" alt="{alt}" width="{width}" height="{height}">'
            f"<figcaption>{caption}</figcaption></figure>"
        )
    return f'<div class="frame"><h3>{escape(example.name)}</h3><div class="row quad">{figures}</div></div>'


def error_picture(image: Pixels, truth: Labels, prediction: Labels, class_count: int) -> Pixels:
    """The image in pale grey with errors in colour; pixels without a true label are dark.

    Errors are `WRONG`; of two classes, missed pixels of the second are `MISSED`.
    """
    grey = np.array(Image.fromarray(image).convert("L"))
    unlabelled = truth == IGNORE
    level = np.where(unlabelled, grey * 0.35, 130 + grey * 0.45)
    picture = np.repeat(level[..., None], 3, axis=2)
    wrong = (prediction != truth) & ~unlabelled
    picture[wrong] = WRONG
    if class_count == 2:
        picture[wrong & (truth == 1)] = MISSED
    return picture.astype(np.uint8)


def _smaller(example: ValidationExample) -> tuple[Pixels, Labels, Labels]:
    """Image and labels, at most `PANEL_WIDTH_PX` wide."""
    height, width = example.truth.shape
    if width <= PANEL_WIDTH_PX:
        return example.image, example.truth, example.prediction
    size = PANEL_WIDTH_PX, max(1, round(height * PANEL_WIDTH_PX / width))
    rows = (np.arange(size[1]) + 0.5) * height // size[1]
    columns = (np.arange(size[0]) + 0.5) * width // size[0]
    nearest = np.ix_(rows.astype(int), columns.astype(int))
    image = np.array(Image.fromarray(example.image).resize(size, Image.Resampling.BOX))
    return image, example.truth[nearest], example.prediction[nearest]


def _facts(facts: Mapping[str, str]) -> str:
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td>{escape(str(text))}</td></tr>' for name, text in facts.items()
    )
    if not rows:
        return ""
    return f'<section><h2>Recipe</h2><div class="list"><table><tbody>{rows}</tbody></table></div></section>'
