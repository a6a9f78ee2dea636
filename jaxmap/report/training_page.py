"""The page of a training run, rewritten while it goes on: scores, curves, examples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from numbers import Real

import numpy as np
from jaxtyping import UInt8

from jaxmap.report.charts import Chart, Mark, Series, line_chart
from jaxmap.report.inks import class_inks
from jaxmap.report.page import page
from jaxmap.report.scales import thinned
from jaxmap.report.training_pictures import example_panels, legend
from jaxmap.report.training_scores import Scores, calibration_chart, class_table, confusion_table, score_text
from jaxmap.report.wording import number_text, value_text

MAX_EXAMPLES = 8
MAX_EPOCHS_DRAWN = 800
MAX_CLASSES_BESIDE = 6
LARGEST = 1e30

Overlay = tuple[str, UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"], UInt8[np.ndarray, "H W"]]
Row = Mapping[str, float | int | None]


@dataclass(frozen=True)
class TrainingRecord:
    """What is known of a training run so far.

    Attributes:
        title: its heading.
        classes: names in the order of the labels.
        history: one row for each epoch, in order: `epoch`, `step`, `learning_rate`, `train_loss`,
            `images_per_s`, `seconds` (of this epoch), and where it was validated `val_loss`,
            `mean_iou`, `accuracy`, `iou_CLASS`. Whatever is missing, None or not finite is left out.
        summary: scores in validation by `"best"` and `"last"`, each as `SegmentationScores.summary` gives
            them, with `epoch` and `calibration` (rows of pixels, summed confidence, correct pixels) if wanted.
        facts: what was trained and how, as names and texts.
        overlays: name, image, true labels and the network's labels of some examples.
        status: one sentence shown at the top, such as why the run stopped; may be empty.
    """

    title: str
    classes: tuple[str, ...]
    history: Sequence[Row]
    summary: Mapping[str, Scores] = field(default_factory=dict)
    facts: Mapping[str, str] = field(default_factory=dict)
    overlays: Sequence[Overlay] = ()
    status: str = ""


def training_page(record: TrainingRecord) -> str:
    """The whole page as HTML, which needs no other file and no network."""
    style = files("jaxmap.report").joinpath("training_page.css").read_text(encoding="utf-8")
    sections = [
        f"<style>{style}{class_inks(record.classes)}</style>",
        _header(record),
        _curves(record),
        _scores(record),
        _examples(record),
        _facts(record.facts),
        "<footer>Made by jaxmap.</footer>",
    ]
    return page(record.title, "".join(sections), drawn=False)


def _header(record: TrainingRecord) -> str:
    banner = f'<p class="banner">{escape(record.status)}</p>' if record.status else ""
    stats = "".join(f"<div><dt>{name}</dt><dd>{text}</dd></div>" for name, text in _stats(record))
    classes = escape(", ".join(record.classes))
    return (
        f'<header><p class="kind">Training</p><h1>{escape(record.title)}</h1><p>{classes}</p>{banner}'
        f'<dl class="stats">{stats}</dl></header>'
    )


def _stats(record: TrainingRecord) -> list[tuple[str, str]]:
    best, rows, epoch = _best(record), record.history, _best_epoch(record)
    stats: list[tuple[str, str | None]] = []
    if best:
        stats += [
            ("mean IoU", score_text(best.get("mean_iou"))),
            (f"{best.get('unit', 'pixel')} accuracy", score_text(best.get("accuracy"))),
        ]
        stats += [("calibration error", score_text(best.get("ece")))]
    losses, rates, times = (_values(rows, key) for key in ("train_loss", "images_per_s", "seconds"))
    count = value_text(len(rows))
    stats += [
        ("training loss", _three_digits(losses[-1]) if losses else None),
        ("epochs", count) if epoch is None else ("best epoch", f"{number_text(epoch)} of {count}"),
        ("images/s", _three_digits(sorted(rates)[len(rates) // 2]) if rates else None),
        ("time", duration_text(sum(times)) if times else None),
    ]
    return [(name, text) for name, text in stats if text is not None]


def _three_digits(value: float) -> str:
    return number_text(float(f"{value:.3g}"))


def duration_text(seconds: float) -> str:
    """A duration in seconds, minutes or hours, to three digits at most."""
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return value_text(float(f"{seconds / size:.3g}") if unit == "h" else round(seconds / size), unit)
    return value_text(float(f"{seconds:.3g}"), "s")


def _curves(record: TrainingRecord) -> str:
    rows = thinned(record.history, MAX_EPOCHS_DRAWN)
    epoch = _best_epoch(record)
    mark = Mark(epoch, "best") if epoch is not None and len(rows) > 1 else None

    def series(key: str, name: str, colour: str, *, strong: bool = False) -> Series:
        return Series(name, _points(rows, key), colour, strong)

    losses = [series("val_loss", "validation", "var(--accent)", strong=True)]
    losses.append(series("train_loss", "training", "var(--quiet)"))
    ious = [series(f"iou_{name}", name, f"var(--class-{index})") for index, name in enumerate(record.classes)]
    ious.append(series("mean_iou", "mean", "var(--ink)", strong=True))
    charts = {
        "Loss": line_chart(Chart("Loss by epoch", "epoch", "loss", mark=mark), losses),
        "Intersection over union": line_chart(
            Chart("IoU of each class by epoch", "epoch", "IoU", y_range=(0, 1), mark=mark), ious
        ),
        "Learning rate": line_chart(
            # Never logarithmic: a schedule is known by its shape.
            Chart(
                "Learning rate by epoch",
                "epoch",
                "learning rate",
                190,
                y_range=(0, max(_values(rows, "learning_rate"), default=0)),
            ),
            [series("learning_rate", "", "var(--accent)", strong=True)],
        ),
        "Speed": line_chart(
            Chart("Images per second by epoch", "epoch", "images/s", 190),
            [series("images_per_s", "", "var(--accent)", strong=True)],
        ),
    }
    figures = "".join(
        f"<figure><figcaption>{caption}</figcaption>{chart}</figure>" for caption, chart in charts.items() if chart
    )
    if not figures:
        return "<section><h2>Curves</h2><p>No epoch has ended yet.</p></section>"
    return f'<section><h2>Curves</h2><div class="charts">{figures}</div></section>'


def _scores(record: TrainingRecord) -> str:
    best = _best(record)
    if not best:
        return ""
    last = record.summary.get("last")
    other = last if last and last.get("epoch") != best.get("epoch") else None
    images, pixels = value_text(best.get("images")), value_text(best.get("pixels"))
    told = f"Validation: {images} images, {pixels} labelled {best.get('unit', 'pixel')}s"
    epoch = _best_epoch(record)
    when = f", after epoch {number_text(epoch)}" if epoch is not None else ""
    tables = (
        f'<div class="tables">{class_table(best, other, record.classes)}{confusion_table(best, record.classes)}</div>'
    )
    wide = " wide" if len(record.classes) > MAX_CLASSES_BESIDE else ""
    return (
        f'<section><h2>Scores</h2><div class="scores{wide}">{tables}{calibration_chart(best)}</div>'
        f"<p>{told}{when}.</p></section>"
    )


def _examples(record: TrainingRecord) -> str:
    shown = record.overlays[:MAX_EXAMPLES]
    if not shown:
        return ""
    frames = "".join(example_panels(*overlay, record.classes) for overlay in shown)
    return f'<section><h2>Examples</h2>{legend(record.classes)}<div class="frames">{frames}</div></section>'


def _facts(facts: Mapping[str, str]) -> str:
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td>{escape(str(text))}</td></tr>' for name, text in facts.items()
    )
    if not rows:
        return ""
    return f'<section><h2>Recipe</h2><div class="list"><table><tbody>{rows}</tbody></table></div></section>'


def _best(record: TrainingRecord) -> Scores:
    return record.summary.get("best") or record.summary.get("last") or {}


def _best_epoch(record: TrainingRecord) -> float | None:
    """The epoch of the best scores: as they say themselves, or else that of the greatest mean IoU."""
    if (epoch := _number(_best(record).get("epoch"))) is not None:
        return epoch
    return max(_points(record.history, "mean_iou"), key=lambda point: point[1], default=(None, 0))[0]


def _points(rows: Sequence[Row], key: str) -> list[tuple[float, float]]:
    pairs = ((_number(row.get("epoch")), _number(row.get(key))) for row in rows)
    return [(epoch, value) for epoch, value in pairs if epoch is not None and value is not None]


def _values(rows: Sequence[Row], key: str) -> list[float]:
    return [number for row in rows if (number := _number(row.get(key))) is not None]


def _number(value: object) -> float | None:
    """A value that can be drawn; a loss beyond `LARGEST` has left every scale."""
    number = float(value) if isinstance(value, Real) else float("nan")
    return number if abs(number) < LARGEST else None
