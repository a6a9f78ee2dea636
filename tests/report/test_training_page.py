"""The page of a training run, its charts and pictures."""

from __future__ import annotations

import base64
import html
import io
import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.optimize import minimize
from test_report_browser import browse

from jaxmap.evaluation.segmentation_scores import SegmentationScores
from jaxmap.labels import IGNORE, class_colours
from jaxmap.report import inks
from jaxmap.report.charts import Chart, Mark, Series, line_chart
from jaxmap.report.scales import LOG_RATIO, fitting_scale, linear_scale, spread, thinned, whole_scale
from jaxmap.report.training_page import MAX_EXAMPLES, TrainingRecord, duration_text, training_page
from jaxmap.report.training_pictures import MISSED, PANEL_WIDTH_PX, WRONG, error_picture
from jaxmap.report.training_scores import class_table, confusion_table, score_text

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
    overlay = (NASTY, np.full((*truth.shape, 3), 90, np.uint8), truth, logits.argmax(axis=-1).astype(np.uint8))
    return TrainingRecord(
        title=NASTY,
        classes=classes,
        history=history,
        summary={"best": {**summary, "epoch": 9}, "last": {**summary, "epoch": epochs}},
        facts={"data": NASTY},
        overlays=[overlay, overlay],
        status=f"Stopped: {NASTY}",
    )


def charts_of(page: str) -> dict[str, ElementTree.Element]:
    """The charts of a page by title; well-formed, or this fails."""
    charts = [ElementTree.fromstring(text) for text in re.findall(r"<svg.*?</svg>", page, re.DOTALL)]
    return {chart.attrib["aria-label"]: chart for chart in charts}


def texts(element: ElementTree.Element, kind: str) -> list[str]:
    return ["".join(found.itertext()) for found in element.iter(kind)]


def pictures_of(page: str) -> list[np.ndarray]:
    found = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page)
    return [np.array(Image.open(io.BytesIO(base64.b64decode(one)))) for one in found]


# --- the page


def test_the_page_holds_all_of_a_run() -> None:
    page = training_page(make_record())
    for heading in ("Curves", "Scores", "Examples", "Recipe"):
        assert f"<h2>{heading}</h2>" in page
    charts = charts_of(page)
    assert list(charts) == [
        *("Loss by epoch", "IoU of each class by epoch", "Learning rate by epoch"),
        *("Images per second by epoch", "Accuracy over confidence"),
    ]
    assert {"validation", "training", "best"} <= set(texts(charts["Loss by epoch"], "text"))
    assert {"mean", "sand"} <= set(texts(charts["IoU of each class by epoch"], "text"))
    assert "epoch 3\nvalidation 0.6667\ntraining 0.5" in texts(charts["Loss by epoch"], "title")
    assert "9 of 12" in page and "18&nbsp;min" in page
    assert len(pictures_of(page)) == 8


def test_nothing_is_taken_for_markup_and_nothing_is_fetched() -> None:
    page = training_page(make_record())
    assert NASTY not in page and html.escape(NASTY) in page
    assert not re.findall(r'(?:src|href)="(?!data:)', page) and "url(" not in page


def test_before_and_after_the_first_epoch() -> None:
    first = make_record(1)
    bare = TrainingRecord("run", ("sand", "rock"), [])
    page = training_page(bare)
    assert "No epoch has ended yet." in page and not charts_of(page)
    page = training_page(replace(bare, history=first.history))
    charts = charts_of(page)
    assert list(charts) == ["Loss by epoch", "Learning rate by epoch", "Images per second by epoch"]
    assert len(list(charts["Loss by epoch"].iter("circle"))) == 1
    assert "<h2>Scores</h2>" not in page and "mean IoU" not in page


@pytest.mark.parametrize("value", [None, math.nan, math.inf, -math.inf, 1e300, "x"])
def test_values_that_are_none_are_left_out(value) -> None:
    whole, broken = make_record(), make_record()
    history = [{**row, "train_loss": value if row["epoch"] == 4 else row["train_loss"]} for row in broken.history]
    history.append(dict.fromkeys(history[0], value))
    page = training_page(replace(broken, history=history))
    points = [
        len(next(iter(charts_of(one)["Loss by epoch"].iter("polyline"))).attrib["points"].split(" ")) / 2
        for one in (training_page(whole), page)
    ]
    assert points == [12, 11]
    assert "nan" not in page.split("base64")[0].lower()


def test_numbers_of_numpy_are_numbers() -> None:
    record = make_record()
    history = [{key: np.float32(value) for key, value in row.items()} for row in record.history]
    assert charts_of(training_page(replace(record, history=history))).keys() == charts_of(training_page(record)).keys()


def test_scores_without_a_value() -> None:
    record = make_record()
    summary = SegmentationScores.empty(record.classes).summary()
    page = training_page(replace(record, summary={"best": summary, "last": None}))
    assert "<dd>–</dd>" in page and "Accuracy over confidence" not in charts_of(page)


def test_the_best_epoch_is_found_in_the_history() -> None:
    record = make_record()
    history = [{**row, "mean_iou": 0.9 if row["epoch"] == 6 else row.get("mean_iou")} for row in record.history]
    page = training_page(
        replace(record, history=history, summary={"last": SegmentationScores.empty(CLASSES).summary()})
    )
    assert "<dd>6 of 12</dd>" in page


def test_only_some_examples_are_shown() -> None:
    record = make_record()
    page = training_page(replace(record, overlays=[record.overlays[0]] * (MAX_EXAMPLES + 3)))
    assert len(pictures_of(page)) == 4 * MAX_EXAMPLES


def test_a_long_run_is_drawn_thinned() -> None:
    page = training_page(make_record(5000))
    assert len(page) < 1_000_000
    points = next(iter(charts_of(page)["Loss by epoch"].iter("polyline"))).attrib["points"]
    assert 300 < points.count(" ") < 2000


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


def test_pictures_keep_their_shape_and_place() -> None:
    truth = np.zeros((300, 1200), np.uint8)
    truth[:, 900:] = 1
    record = make_record()
    image = np.repeat(np.where(truth, 200, 20)[..., None], 3, axis=2).astype(np.uint8)
    page = training_page(replace(record, overlays=[("wide", image, truth, np.zeros_like(truth))]))
    pictures = pictures_of(page)
    assert [picture.shape for picture in pictures] == [(120, PANEL_WIDTH_PX, 3)] * 4
    edge = 900 * PANEL_WIDTH_PX // 1200
    # JPEG smears over the 8 pixels around an edge.
    assert (pictures[0][:, edge + 8 :] > 190).all() and (pictures[0][:, : edge - 8] < 30).all()
    assert np.abs(pictures[3][:, edge + 8 :].astype(int) - MISSED).max() < 8


# --- charts

finite = st.floats(-1e12, 1e12, allow_nan=False).filter(lambda value: value == 0 or abs(value) > 1e-12)


@given(finite, finite, st.integers(2, 9))
def test_axes_hold_their_values_at_round_ticks(one, other, at_most) -> None:
    low, high = sorted((one, other))
    scale = linear_scale(low, high, at_most)
    slack = 1e-8 * (scale.high - scale.low) + 1e-9 * max(abs(low), abs(high))
    assert scale.low - slack <= low and high <= scale.high + slack
    assert scale.ticks[0] == scale.low and scale.ticks[-1] == scale.high
    if high - low > 1e-6 * max(abs(low), abs(high)):
        assert 2 <= len(scale.ticks) <= at_most + 3
        steps = np.diff(scale.ticks)
        np.testing.assert_allclose(steps, steps[0], rtol=1e-3)
        digits = steps[0] / 10.0 ** math.floor(math.log10(steps[0] * 1.0001))
        assert min(abs(digits - round_one) for round_one in (1, 2, 5)) < 0.01


@given(st.lists(st.floats(1e-6, 1e6), min_size=1, max_size=5))
def test_wide_positive_values_get_powers_of_ten(values) -> None:
    low, high = min(values), max(values)
    scale = fitting_scale(low, high, 5)
    assert scale.logarithmic == (high / low > LOG_RATIO)
    places = [scale.share(value) for value in sorted(values)]
    assert places == sorted(places) and places[0] > -1e-6 and places[-1] < 1 + 1e-6
    assert scale.logarithmic or scale.low == 0
    factor, words = scale.tick_texts()
    assert len(set(words)) == len(scale.ticks) and (factor == "" or not scale.logarithmic)


@given(st.integers(0, 3000), st.integers(0, 3000))
def test_epochs_have_whole_ticks(one, other) -> None:
    scale = whole_scale(min(one, other), max(one, other))
    assert 1 <= len(scale.ticks) <= 9
    assert all(tick == int(tick) and scale.low <= tick <= scale.high for tick in scale.ticks)


def test_small_values_share_a_power_of_ten() -> None:
    assert linear_scale(0, 1e-3, 5).tick_texts() == (", ×10⁻³", ["0", "0.2", "0.4", "0.6", "0.8", "1"])
    assert linear_scale(0, 1, 2).tick_texts() == ("", ["0", "0.5", "1"])
    assert fitting_scale(2e-5, 3, 6).tick_texts()[1] == ["10⁻⁵", "10⁻⁴", "0.001", "0.01", "0.1", "1", "10"]


@given(st.lists(st.floats(0, 100), max_size=5).map(sorted), st.floats(1, 30))
def test_labels_are_moved_as_little_as_it_takes(places, gap) -> None:
    found = spread(places, gap, 0, 100)
    assert len(found) == len(places)
    assert all(after - before >= gap - 1e-6 for before, after in pairwise(found))
    if not places or gap * (len(places) - 1) > 100:
        return
    assert found[0] >= -1e-9 and found[-1] <= 100 + 1e-6
    constraints = [{"type": "ineq", "fun": lambda x: np.diff(x) - gap}] if len(places) > 1 else []
    start = np.linspace(0, 100, len(places)) if len(places) > 1 else np.array(places)
    twin = minimize(
        lambda x: ((x - places) ** 2).sum(), start, bounds=[(0, 100)] * len(places), constraints=constraints, tol=1e-12
    )
    assert ((np.array(found) - places) ** 2).sum() <= twin.fun + 1e-4


@given(st.integers(1, 500), st.integers(2, 60))
def test_thinning_keeps_the_ends_and_the_order(count, at_most) -> None:
    kept = thinned(range(count), at_most)
    assert len(kept) == min(count, at_most) and kept[0] == 0 and kept[-1] == count - 1
    gaps = np.diff(kept)
    assert (gaps > 0).all() and np.ptp(gaps if len(gaps) else [0]) <= 1


@given(
    st.lists(st.tuples(st.integers(1, 400), st.floats(-1e9, 1e9)), min_size=1, max_size=20, unique_by=lambda p: p[0]),
    st.integers(0, 3),
)
def test_every_point_lies_inside_its_chart(points, empty) -> None:
    series = [Series("line", sorted(points), "red", strong=True), *[Series("none", [], "blue")] * empty]
    chart = ElementTree.fromstring(line_chart(Chart("title", "epoch", "loss", mark=Mark(5, "here")), series))
    _, _, width, height = map(float, chart.attrib["viewBox"].split())
    circles = [(float(one.attrib["cx"]), float(one.attrib["cy"])) for one in chart.iter("circle")]
    assert len(circles) == len(points)
    assert all(0 <= x <= width and 0 <= y <= height for x, y in circles)
    assert [x for x, _ in circles] == sorted(x for x, _ in circles)
    heights = [y for _, y in circles]
    for (_, first), (_, second), above, below in zip(
        series[0].points, series[0].points[1:], heights, heights[1:], strict=False
    ):
        assert (second - first) * (below - above) <= 0  # Upwards is less in SVG.
    assert "none" not in texts(chart, "text")
    assert len(list(chart.iter("title"))) == len(points)


def test_of_many_lines_the_strong_and_the_lowest_are_named() -> None:
    series = [Series(f"class {index}", [(1, index / 40)], "red") for index in range(40)]
    series.append(Series("mean", [(1, 0.9)], "black", strong=True))
    chart = ElementTree.fromstring(line_chart(Chart("title", "epoch", "IoU", y_range=(0, 1)), series))
    named = [text for text in texts(chart, "text") if text.startswith(("class", "mean"))]
    assert named[0] == "mean" and named[-1] == "class 0" and 10 < len(named) < 25
    assert named[1:] == [f"class {index}" for index in reversed(range(len(named) - 1))]


# --- colours


@given(st.tuples(*[st.integers(0, 255)] * 3), st.sampled_from([inks.LIGHT_PANEL, inks.DARK_PANEL]))
def test_inks_can_be_read_on_their_ground(colour, ground) -> None:
    ink = inks.with_contrast(colour, ground)
    assert inks.contrast(ink, ground) >= inks.LEAST_CONTRAST
    assert ink == colour or inks.contrast(colour, ground) < inks.LEAST_CONTRAST


def test_contrast_is_that_of_the_standard() -> None:
    assert inks.contrast((0, 0, 0), (255, 255, 255)) == pytest.approx(21)
    # The lightest grey that WCAG passes on white.
    assert inks.contrast((118, 118, 118), (255, 255, 255)) == pytest.approx(4.54, abs=0.01)


def test_every_class_has_inks_of_its_own() -> None:
    sheet = inks.class_inks(("sand", "rock"))
    assert sheet.count("--class-0:") == sheet.count("--class-1:") == 2
    assert f"--class-1:rgb{tuple(class_colours(('sand', 'rock'))[1].tolist())};" in sheet


@pytest.mark.browser
@pytest.mark.parametrize(("scheme", "size"), [(1, (1280, 1600)), (0, (500, 1600))], ids=["light", "narrow and dark"])
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
