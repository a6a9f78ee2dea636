"""Line charts as SVG: drawn in the colours of the page, light or dark, and readable without a script."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from itertools import pairwise
from typing import NamedTuple

from jaxmap.report.scales import Scale, fitting_scale, linear_scale, spread, thinned, whole_scale
from jaxmap.report.wording import number_text

WIDTH_PX = 520
MAX_DOTS = 30
MAX_HOVERS = 400

_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 10, 14, 40
_LETTER_PX, _LINE_PX = 6.4, 15

Point = tuple[float, float]


class Series(NamedTuple):
    """A line of a chart.

    Attributes:
        name: its label; empty for a line alone, which is what the y axis says.
        points: x and y, in order of x, all finite.
        colour: of CSS.
        strong: whether it is drawn wider than the others.
    """

    name: str
    points: Sequence[Point]
    colour: str
    strong: bool = False


class Mark(NamedTuple):
    """A dashed upright line at an x, and what it marks."""

    x: float
    text: str


class Chart(NamedTuple):
    """What is drawn around the lines.

    Attributes:
        title: what is shown, for those who cannot see it.
        x_name: heading of the x axis, and of the value in the text shown over a point.
        y_name: heading of the y axis; a unit after a comma.
        height_px: of the drawing, which is `WIDTH_PX` wide and then scaled to its place.
        x_range: of the x axis, or None for whole numbers, such as epochs, that end where the lines do.
        y_range: of the y axis, or None to fit the lines.
        mark: an upright line, or None.
    """

    title: str
    x_name: str
    y_name: str
    height_px: int = 300
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    mark: Mark | None = None


class _Frame(NamedTuple):
    """Where values lie in the drawing."""

    x: Scale
    y: Scale
    left: float
    right: float
    top: float
    bottom: float

    def x_px(self, value: float) -> float:
        return self.left + self.x.share(value) * (self.right - self.left)

    def y_px(self, value: float) -> float:
        return self.bottom - self.y.share(value) * (self.bottom - self.top)


def line_chart(chart: Chart, series: Sequence[Series]) -> str:
    """Lines over a common x, each labelled at its end; empty where there is no point.

    Hovering an x tells every line's value there.

    Args:
        chart: what is drawn around them.
        series: the lines; those without points are left out.
    """
    drawn = [one for one in series if one.points]
    if not drawn:
        return ""
    xs = [x for one in drawn for x, _ in one.points]
    ys = [y for one in drawn for _, y in one.points]
    x_scale = linear_scale(*chart.x_range, 6) if chart.x_range else whole_scale(min(xs), max(xs))
    at_most = max(2, (chart.height_px - _TOP - _BOTTOM) // 36)
    low, high = chart.y_range or (min(ys), max(ys))
    y_scale = linear_scale(low, high, at_most) if chart.y_range else fitting_scale(low, high, at_most)
    labels = max(len(one.name) for one in drawn) * _LETTER_PX + 12
    frame = _Frame(
        *(x_scale, y_scale),
        *(_LEFT, WIDTH_PX - _RIGHT - min(labels, WIDTH_PX / 4), _TOP + _LINE_PX, chart.height_px - _BOTTOM),
    )
    parts = [
        _grid(frame, chart),
        _mark(frame, chart.mark),
        *(_line(frame, one) for one in sorted(drawn, key=lambda one: one.strong)),
        _end_labels(frame, drawn),
        _hovers(frame, chart, drawn),
    ]
    return (
        f'<svg class="chart" viewBox="0 0 {WIDTH_PX} {chart.height_px}" role="img" '
        f'aria-label="{escape(chart.title)}">{"".join(parts)}</svg>'
    )


def _grid(frame: _Frame, chart: Chart) -> str:
    factor, texts = frame.y.tick_texts()
    lines = f'<text class="name" x="{_LEFT - 38}" y="{_TOP}">{escape(chart.y_name)}{factor}</text>'
    for tick, text in zip(frame.y.ticks, texts, strict=True):
        y = frame.y_px(tick)
        lines += f'<path d="M{frame.left} {y:.1f}H{frame.right:.1f}"/>'
        lines += f'<text x="{frame.left - 7}" y="{y + 4:.1f}" text-anchor="end">{text}</text>'
    for tick in frame.x.ticks:
        x, y = frame.x_px(tick), frame.bottom
        lines += f'<path d="M{x:.1f} {y}v4"/>'
        lines += f'<text x="{x:.1f}" y="{y + 17}" text-anchor="middle">{number_text(tick)}</text>'
    middle = (frame.left + frame.right) / 2
    lines += f'<text class="name" x="{middle:.1f}" y="{chart.height_px - 6}" text-anchor="middle">'
    return f'<g class="grid">{lines}{escape(chart.x_name)}</text></g>'


def _mark(frame: _Frame, mark: Mark | None) -> str:
    if mark is None or not frame.x.low <= mark.x <= frame.x.high:
        return ""
    x = frame.x_px(mark.x)
    anchor = "end" if frame.x.share(mark.x) > 0.6 else "start"
    text_x = x + (-5 if anchor == "end" else 5)
    return (
        f'<g class="mark"><path d="M{x:.1f} {frame.top}V{frame.bottom}"/>'
        f'<text x="{text_x:.1f}" y="{frame.bottom - 7}" text-anchor="{anchor}">{escape(mark.text)}</text></g>'
    )


def _line(frame: _Frame, series: Series) -> str:
    places = [f"{frame.x_px(x):.1f} {frame.y_px(y):.1f}" for x, y in series.points]
    strong = " strong" if series.strong else ""
    line = f'<polyline points="{" ".join(places)}"/>' if len(places) > 1 else ""
    dots = ""
    if len(places) <= MAX_DOTS:
        radius = 3 if series.strong or len(places) == 1 else 2.2
        centres = (place.split(" ") for place in places)
        dots = "".join(f'<circle cx="{x}" cy="{y}" r="{radius}"/>' for x, y in centres)
    return f'<g class="line{strong}" style="color:{series.colour}">{line}{dots}</g>'


def _end_labels(frame: _Frame, series: Sequence[Series]) -> str:
    """Names beside the ends of the lines, moved apart; where they are too many, strong and low ones are kept."""
    room = int((frame.bottom - frame.top) // _LINE_PX) + 1
    # Nearest the bottom lies what is worst, which is what one looks for among many.
    named = sorted((one for one in series if one.name), key=lambda one: (not one.strong, one.points[-1][1]))[:room]
    named.sort(key=lambda one: frame.y_px(one.points[-1][1]))
    places = spread([frame.y_px(one.points[-1][1]) for one in named], _LINE_PX, frame.top, frame.bottom)
    most = int((WIDTH_PX - frame.right - 8) / _LETTER_PX)
    return "".join(
        f'<text class="label" style="fill:{one.colour}" x="{frame.right + 8:.1f}" y="{y + 4:.1f}">'
        f"{escape(one.name if len(one.name) <= most else one.name[: most - 1] + '…')}</text>"
        for one, y in zip(named, places, strict=True)
    )


def _hovers(frame: _Frame, chart: Chart, series: Sequence[Series]) -> str:
    """An invisible band around every x whose title tells the values there."""
    values: dict[float, list[str]] = {}
    for one in series:
        for x, y in one.points:
            values.setdefault(x, []).append(f"{one.name or chart.y_name} {number_text(y)}")
    xs = thinned(sorted(values), MAX_HOVERS)
    places = [frame.x_px(x) for x in xs]
    edges = [frame.left, *((a + b) / 2 for a, b in pairwise(places)), frame.right]
    bands = ""
    for x, place, (start, end) in zip(xs, places, pairwise(edges), strict=True):
        told = escape("\n".join([f"{chart.x_name} {number_text(x)}", *values[x]]))
        bands += (
            f'<g><title>{told}</title><path d="M{place:.1f} {frame.top}V{frame.bottom}"/><rect x="{start:.1f}" '
            f'y="{frame.top}" width="{max(end - start, 0):.1f}" height="{frame.bottom - frame.top:.1f}"/></g>'
        )
    return f'<g class="hover">{bands}</g>'
