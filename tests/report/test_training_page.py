"""The page of a training run, its charts and pictures."""

from __future__ import annotations

import base64
import html
import io
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from test_report_browser import browse

from jaxmap.evaluation.segmentation_scores import SegmentationScores
from jaxmap.labels import IGNORE, class_colours
from jaxmap.report import training_charts as charts
from jaxmap.report import training_page as report
from jaxmap.report.page import ACCENT
from jaxmap.report.training_charts import Line, line_chart
from jaxmap.report.training_page import (
    MAX_EXAMPLES,
    MISSED,
    PANEL_WIDTH_PX,
    WRONG,
    TrainingRecord,
    class_table,
    confusion_table,
    duration_text,
    error_picture,
    score_text,
    training_page,
)
from jaxmap.training.validation import ValidationExample

NASTY = '<script>alert("x")</script> & co'
CLASSES = ("sand", NASTY)


def make_record(epochs: int = 12, classes: tuple[str, ...] = CLASSES) -> TrainingRecord:
    """A run that was validated every third epoch."""
    history = []
    for epoch in range(1, epochs + 1):
        row = {"epoch": epoch, "step": 5 * epoch, "learning_rate": 1e-3 / epoch, "train_loss": 1.5 / epoch}
        row |= {"images_per_s": 2.25, "seconds": 90.0}
        if epoch % 3 == 0:
            row |= {"val_loss": 2 / epoch, "mean_iou": 0.5, "accuracy": 0.8}
            row |= {f"iou_{name}": 0.4 + 0.01 * epoch for name in classes}
        history.append(row)
    scores = SegmentationScores.empty(classes)
    rng = np.random.default_rng(0)
    truth = rng.integers(0, len(classes), (30, 600)).astype(np.uint8)
    logits = 2 * np.eye(len(classes))[truth] + rng.normal(size=(*truth.shape, len(classes)))
    scores.add(truth, logits)
    summary = {**scores.summary(), "calibration": scores.calibration.tolist()}
    image, prediction = np.full((*truth.shape, 3), 90, np.uint8), logits.argmax(axis=-1).astype(np.uint8)
    example = ValidationExample(NASTY, image, truth, prediction)
    return TrainingRecord(
        title=NASTY,
        classes=classes,
        history=history,
        summary={"best": {**summary, "epoch": 9}, "last": {**summary, "epoch": epochs}},
        facts={"data": NASTY},
        examples=[example, example],
        status=f"Stopped: {NASTY}",
    )


def charts_of(page: str) -> dict[str, ElementTree.Element]:
    """The charts of a page by title; well-formed, or this fails."""
    charts = [ElementTree.fromstring(text) for text in re.findall(r"<svg.*?</svg>", page, re.DOTALL)]
    return {chart.attrib["aria-label"]: chart for chart in charts}


def texts(chart: ElementTree.Element) -> list[str]:
    return ["".join(found.itertext()) for found in chart.iter("{http://www.w3.org/2000/svg}text")]


@pytest.fixture
def lines(monkeypatch) -> dict[str, Sequence[Line]]:
    """The lines of the charts that are drawn, by title; they are not drawn."""
    drawn: dict[str, Sequence[Line]] = {}

    def chart(title: str, axes: tuple[str, str], lines: Sequence[Line], **options: object) -> str:
        drawn[title] = lines
        return "<svg></svg>"

    monkeypatch.setattr(report, "line_chart", chart)
    return drawn


def pictures_of(page: str) -> list[np.ndarray]:
    found = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page)
    return [np.array(Image.open(io.BytesIO(base64.b64decode(one)))) for one in found]


# --- the page


def test_the_page_holds_all_of_a_run() -> None:
    page = training_page(make_record())
    for heading in ("Curves", "Scores", "Examples", "Recipe"):
        assert f"<h2>{heading}</h2>" in page
    found = charts_of(page)
    assert list(found) == [
        *("Loss by epoch", "IoU of each class by epoch", "Learning rate by epoch"),
        *("Images per second by epoch", "Accuracy over confidence"),
    ]
    assert {"validation", "training", "best", "epoch", "loss"} <= set(texts(found["Loss by epoch"]))
    assert {"mean", "sand"} <= set(texts(found["IoU of each class by epoch"]))
    assert "9 of 12" in page and "18&nbsp;min" in page
    assert len(pictures_of(page)) == 8


def test_nothing_is_taken_for_markup_and_nothing_is_fetched() -> None:
    page = training_page(make_record())
    assert NASTY not in page and html.escape(NASTY) in page
    assert not re.findall(r'(?:src|href)="(?!data:|#)', page) and not re.findall(r"url\((?!#)", page)


def test_before_and_after_the_first_epoch(lines) -> None:
    first = make_record(1)
    bare = TrainingRecord("run", ("sand", "rock"), [])
    page = training_page(bare)
    assert "<h2>Scores</h2>" not in page and "mean IoU" not in page
    assert all(not line.points for chart in lines.values() for line in chart)
    training_page(replace(bare, history=first.history))
    assert {title: [len(line.points) for line in chart] for title, chart in lines.items()} == {
        "Loss by epoch": [0, 1],
        "IoU of each class by epoch": [0, 0, 0],
        "Learning rate by epoch": [1],
        "Images per second by epoch": [1],
    }


def test_without_epochs_there_are_no_charts() -> None:
    page = training_page(TrainingRecord("run", ("sand", "rock"), []))
    assert "No epoch has ended yet." in page and not charts_of(page)


@pytest.mark.parametrize("value", [None, math.nan, math.inf, -math.inf, 1e300, "x"])
def test_values_that_are_none_are_left_out(value, lines) -> None:
    broken = make_record()
    history = [{**row, "train_loss": value if row["epoch"] == 4 else row["train_loss"]} for row in broken.history]
    history.append(dict.fromkeys(history[0], value))
    page = training_page(replace(broken, history=history))
    assert [epoch for epoch, _ in lines["Loss by epoch"][1].points] == [1, 2, 3, *range(5, 13)]
    assert "nan" not in page.split("base64")[0].lower()


def test_numbers_of_numpy_are_numbers(lines) -> None:
    record = make_record()
    history = [{key: np.float32(value) for key, value in row.items()} for row in record.history]
    training_page(replace(record, history=history))
    assert [len(line.points) for line in lines["Loss by epoch"]] == [4, 12]


def test_scores_without_a_value(lines) -> None:
    record = make_record()
    summary = SegmentationScores.empty(record.classes).summary()
    page = training_page(replace(record, summary={"best": summary, "last": None}))
    assert "<dd>–</dd>" in page and "Accuracy over confidence" not in lines


def test_the_best_epoch_is_found_in_the_history(lines) -> None:
    record = make_record()
    history = [{**row, "mean_iou": 0.9 if row["epoch"] == 6 else row.get("mean_iou")} for row in record.history]
    page = training_page(
        replace(record, history=history, summary={"last": SegmentationScores.empty(CLASSES).summary()})
    )
    assert "<dd>6 of 12</dd>" in page


def test_only_some_examples_are_shown(lines) -> None:
    record = make_record()
    page = training_page(replace(record, examples=[record.examples[0]] * (MAX_EXAMPLES + 3)))
    assert len(pictures_of(page)) == 4 * MAX_EXAMPLES


def test_a_long_run_is_drawn_thinned(lines) -> None:
    training_page(make_record(5000))
    points = lines["Loss by epoch"][1].points
    assert len(points) == report.MAX_EPOCHS_DRAWN and points[0][0] == 1 and points[-1][0] == 5000


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.234, "0.234&nbsp;s"), (119, "119&nbsp;s"), (125, "2&nbsp;min"), (7100, "118&nbsp;min"), (9000, "2.5&nbsp;h")],
)
def test_durations(seconds, text) -> None:
    assert duration_text(seconds) == text


# --- scores


def test_tables_say_what_the_summary_says() -> None:
    scores = {
        "confusion": [[90, 10], [0, 0]],
        "classes": {"a": {"iou": 0.9, "precision": 1.0, "recall": 0.9, "pixels": 100}},
    }
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", confusion_table(scores, ("a", "b")))
    assert cells == ["90.0", "10.0", "–", "–"]
    assert "a taken for b: 10 pixels" in confusion_table(scores, ("a", "b"))
    rows = class_table(scores, {"classes": {"a": {"iou": 0.25}}}, ("a", "b")).split("<tr>")
    assert re.findall(r"<td>([^<]*)</td>", rows[2]) == ["0.900", "0.250", "1.000", "0.900", "100"]
    assert re.findall(r"<td>([^<]*)</td>", rows[3]) == ["–"] * 5
    assert score_text(None) == score_text(math.nan) == "–" and score_text(1) == "1.000"


# --- pictures


def test_errors_are_coloured_and_nothing_else() -> None:
    truth = np.array([[0, 0, 1, 1, IGNORE]], np.uint8)
    prediction = np.array([[0, 1, 0, 1, 0]], np.uint8)
    image = np.full((1, 5, 3), 100, np.uint8)
    of_two, of_three = (error_picture(image, truth, prediction, count)[0] for count in (2, 3))
    assert of_two[1].tolist() == list(WRONG) and of_two[2].tolist() == list(MISSED)
    assert of_three[1].tolist() == of_three[2].tolist() == list(WRONG)
    np.testing.assert_array_equal(of_two[[0, 3, 4]], of_three[[0, 3, 4]])
    assert np.ptp(of_two[[0, 3, 4]], axis=1).max() == 0
    assert of_two[4, 0] < 100 < of_two[0, 0] == of_two[3, 0]


def test_pictures_keep_their_shape_and_place(lines) -> None:
    truth = np.zeros((300, 1200), np.uint8)
    truth[:, 900:] = 1
    record = make_record()
    image = np.repeat(np.where(truth, 200, 20)[..., None], 3, axis=2).astype(np.uint8)
    page = training_page(replace(record, examples=[ValidationExample("wide", image, truth, np.zeros_like(truth))]))
    pictures = pictures_of(page)
    assert [picture.shape for picture in pictures] == [(120, PANEL_WIDTH_PX, 3)] * 4
    edge = 900 * PANEL_WIDTH_PX // 1200
    # JPEG smears over the 8 pixels around an edge.
    assert (pictures[0][:, edge + 8 :] > 190).all() and (pictures[0][:, : edge - 8] < 30).all()
    assert np.abs(pictures[3][:, edge + 8 :].astype(int) - MISSED).max() < 8


# --- charts


@pytest.mark.parametrize(
    "values",
    [[0.0], [1e-6], [1e-9, 1e9], [0.0, 0.0], [-3.0, -1.0], [1e29, -1e29], [0.5, 0.4, 0.3]],
    ids=["nothing", "one", "wide", "level", "negative", "huge", "plain"],
)
def test_any_values_can_be_drawn(values) -> None:
    points = [(float(epoch), value) for epoch, value in enumerate(values, 1)]
    drawn = [Line("$x_ & <b>", points, ACCENT), Line("_empty", [], "#0000ff")]
    text = line_chart("a & b", ("epoch", "loss"), drawn, mark=(1, "here"))
    chart = ElementTree.fromstring(text)
    assert chart.attrib["aria-label"] == "a & b"
    assert {"$x_ & <b>", "here", "epoch", "loss"} <= set(texts(chart)) and "_empty" not in texts(chart)
    assert "var(--accent)" in text and ACCENT not in text
    assert text == line_chart("a & b", ("epoch", "loss"), drawn, mark=(1, "here")), "the same text each time"


def test_of_many_lines_the_strong_and_the_lowest_are_named() -> None:
    drawn = [Line(f"class {index}", [(1, index / 40)], "#ff0000") for index in range(40)]
    drawn.append(Line("mean", [(1, 0.9)], "#000000", strong=True))
    chart = ElementTree.fromstring(line_chart("title", ("epoch", "IoU"), drawn, y_range=(0, 1)))
    named = [text for text in texts(chart) if text.startswith(("class", "mean"))]
    assert named == ["mean", *(f"class {index}" for index in reversed(range(15)))]


def test_lines_of_classes_take_the_colours_of_the_page() -> None:
    page = training_page(make_record())
    for index, ink in enumerate(charts.class_inks(CLASSES, charts.LIGHT_PANEL)):
        assert f"--class-{index}:{charts.hex_of(ink)};" in page and f"var(--class-{index})" in page


# --- colours


@given(st.tuples(*[st.integers(0, 255)] * 3), st.sampled_from([charts.LIGHT_PANEL, charts.DARK_PANEL]))
def test_inks_can_be_read_on_their_ground(colour, ground) -> None:
    ink = charts.with_contrast(colour, ground)
    assert charts.contrast(ink, ground) >= charts.LEAST_CONTRAST
    assert ink == colour or charts.contrast(colour, ground) < charts.LEAST_CONTRAST


def test_contrast_is_that_of_the_standard() -> None:
    assert charts.contrast((0, 0, 0), (255, 255, 255)) == pytest.approx(21)
    # The lightest grey that WCAG passes on white.
    assert charts.contrast((118, 118, 118), (255, 255, 255)) == pytest.approx(4.54, abs=0.01)


def test_every_class_has_inks_of_its_own() -> None:
    sheet = charts.class_style(("sand", "rock"))
    assert sheet.count("--class-0:") == sheet.count("--class-1:") == 2
    assert f"--class-1:{charts.hex_of(class_colours(('sand', 'rock'))[1])};" in sheet


@pytest.mark.browser
@pytest.mark.parametrize(
    ("scheme", "size"),
    [pytest.param(1, (1280, 1600), marks=pytest.mark.slow), (0, (500, 1600))],
    ids=["light", "narrow and dark"],
)
def test_the_page_in_a_browser(tmp_path, scheme, size) -> None:
    probe = (
        "<script>document.documentElement.dataset.wider = document.documentElement.scrollWidth > innerWidth</script>"
    )
    page = training_page(make_record()).replace("</body>", f"{probe}</body>")
    (tmp_path / "page.html").write_text(page, encoding="utf-8")
    options = ("--dump-dom", f"--blink-settings=preferredColorScheme={scheme}")
    document, console = browse(tmp_path, tmp_path / "page.html", *options, size=size)
    assert console == []
    assert 'data-images="8/8"' in document and 'data-wider="false"' in document
