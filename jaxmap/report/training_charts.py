"""Line charts of the training page, drawn by matplotlib in the colours of the page, light or dark."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jaxmap.labels import class_colours
from jaxmap.report.page import LINE, QUIET, THEME, svg_of

WIDTH_PX, FONT_PX = 520, 12
MAX_DOTS = 30
MAX_NAMES = 16
LOG_RATIO = 30
"""Values that span a larger factor are drawn on a logarithmic axis."""
LEAST_CONTRAST = 3.0
"""Of lines and large text, as WCAG 2.1 demands."""
LIGHT_PANEL, DARK_PANEL = (255, 255, 255), (27, 30, 36)
"""Background of the page's panels, as in page.css."""


Rgb = tuple[int, ...]


class Line(NamedTuple):
    """A line of a chart: its name, x and y in order of x, and its colour on a light page."""

    name: str
    points: Sequence[tuple[float, float]]
    colour: str
    strong: bool = False


def line_chart(
    title: str,
    axes: tuple[str, str],
    lines: Sequence[Line],
    *,
    height_px: int = 300,
    x_range: tuple[float, float] | None = None,
    y_range: tuple[float, float] | None = None,
    mark: tuple[float, str] | None = None,
    variables: Mapping[str, str] | None = None,
) -> str:
    """Lines over a common x as SVG, their names beside them; empty where no line has points.

    Args:
        title: of the chart, for those who cannot see it.
        axes: names of x and y.
        lines: those without points are left out.
        height_px: of the chart, which is `WIDTH_PX` wide.
        x_range: of the x axis; by default that of the points, which are whole numbers.
        y_range: of the y axis; by default it begins at 0, or is logarithmic where values span more than `LOG_RATIO`.
        mark: x of a dashed vertical line, and its name.
        variables: see `svg_of`, beside those of the page.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    lines = [line for line in lines if line.points]
    if not lines:
        return ""
    figure = Figure(figsize=(WIDTH_PX / 72, height_px / 72), layout="constrained")
    with rc_context({"font.size": FONT_PX}):
        plot = figure.add_subplot()
        for line in sorted(lines, key=lambda line: line.strong):
            dots = {"marker": "o", "markersize": 5 if line.strong else 4} if len(line.points) <= MAX_DOTS else {}
            width = 2.6 if line.strong else 1.6
            plot.plot(*zip(*line.points, strict=True), color=line.colour, linewidth=width, clip_on=False, **dots)
        # Where there is no room for all names, those of strong and of low lines are kept: the worst matter most.
        named = sorted((line for line in lines if line.name), key=lambda line: (not line.strong, line.points[-1][1]))
        at_most = min(MAX_NAMES, height_px // 18)
        named = sorted(named[:at_most], key=lambda line: -line.points[-1][1])
        for place, line in enumerate(named):
            name = line.name if len(line.name) <= 20 else f"{line.name[:19]}…"
            words = {"transform": plot.transAxes, "va": "top", "fontweight": "bold", "parse_math": False}
            plot.text(1.03, 1 - place * 18 / (height_px - 50), name, color=line.colour, **words)
        ys = [y for line in lines for _, y in line.points]
        if y_range is not None:
            plot.set_ylim(*y_range)
        elif min(ys) > 0 and max(ys) / min(ys) > LOG_RATIO:
            plot.set_yscale("log")
        else:
            plot.set_ylim(1.05 * min(0.0, *ys), 1.05 * max(0.0, *ys) or 1.0)
        if x_range is not None:
            plot.set_xlim(*x_range)
        else:
            plot.xaxis.set_major_locator(MaxNLocator(8, integer=True))
        if mark is not None:
            plot.axvline(mark[0], color=QUIET, linewidth=1, linestyle="--", zorder=1)
            end = mark[0] > sum(plot.get_xlim()) / 2
            place = {
                "xycoords": ("data", "axes fraction"),
                "textcoords": "offset points",
                "ha": "right" if end else "left",
            }
            plot.annotate(mark[1], (mark[0], 0.03), (-5 if end else 5, 0), color=QUIET, parse_math=False, **place)
        plot.set_xlabel(axes[0], color=QUIET)
        plot.set_title(axes[1], color=QUIET, loc="left", fontsize="medium")
        plot.tick_params(colors=QUIET, labelcolor=QUIET, which="both", left=False)
        plot.yaxis.get_offset_text().set_color(QUIET)
        plot.grid(axis="y", color=LINE, linewidth=1)
        plot.set_axisbelow(True)
        for side, spine in plot.spines.items():
            spine.set(visible=side == "bottom", color=LINE)
    return svg_of(figure, title, {**THEME, **(variables or {})})


def class_style(classes: Sequence[str]) -> str:
    """A style sheet that defines `--class-INDEX` for each class, for light and dark pages."""
    light, dark = (
        "".join(f"--class-{index}:{hex_of(ink)};" for index, ink in enumerate(class_inks(classes, ground)))
        for ground in (LIGHT_PANEL, DARK_PANEL)
    )
    return f":root{{{light}}}@media (prefers-color-scheme: dark){{:root{{{dark}}}}}"


def class_inks(classes: Sequence[str], ground: Rgb) -> list[Rgb]:
    """The colours of classes, as lines and text on a background."""
    return [with_contrast(tuple(colour), ground) for colour in class_colours(classes)[: len(classes)].tolist()]


def with_contrast(colour: Rgb, ground: Rgb) -> Rgb:
    """The colour, mixed with as little black or white as gives it `LEAST_CONTRAST` to the background."""
    end = 0 if _luminance(ground) > 0.18 else 255
    shades = (tuple(round(value + (end - value) * step / 20) for value in colour) for step in range(21))
    return next(shade for shade in shades if contrast(shade, ground) >= LEAST_CONTRAST)


def contrast(one: Rgb, other: Rgb) -> float:
    """The contrast ratio of two sRGB colours, 1 to 21 (WCAG 2.1, "contrast ratio")."""
    low, high = sorted((_luminance(one), _luminance(other)))
    return (high + 0.05) / (low + 0.05)


def _luminance(colour: Rgb) -> float:
    linear = [value / 255 / 12.92 if value <= 10 else ((value / 255 + 0.055) / 1.055) ** 2.4 for value in colour]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def hex_of(colour: Sequence[int]) -> str:
    """A colour as `#rrggbb`."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
