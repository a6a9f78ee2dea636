"""How cost grows with the size of a case, as pictures: one for each group, on logarithmic axes."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from jaxmap.report.plan_sheet import FAINT, INK
from jaxmap.report.scales import fitting_scale, spread
from jaxmap.report.training_charts import LIGHT_PANEL, Rgb, with_contrast
from jaxmap.report.wording import number_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

OWN = "jaxmap"
WIDTH_PX, HEIGHT_PX, DPI = 1040, 660, 236
_OWN_INK: Rgb = (178, 60, 46)
_PEER_INKS: tuple[Rgb, ...] = ((72, 98, 130), (150, 116, 52), (86, 128, 100), (126, 86, 130))
_GRID = "#e4e1d9"
_LABEL_GAP = 0.068
_LABEL_LETTERS = 23


class Line(NamedTuple):
    """Times of ours or of a peer over the size: milliseconds and half their spread."""

    name: str
    sizes: tuple[float, ...]
    times_ms: tuple[float, ...]
    spreads_ms: tuple[float, ...]


class Growth(NamedTuple):
    """What is drawn of a group.

    Attributes:
        unit: of the sizes.
        lines: ours first.
        flat: whether times are those of one frame of many, which should not grow at all.
    """

    unit: str
    lines: tuple[Line, ...]
    flat: bool


def growth_of(cases: Sequence[Mapping[str, Any]]) -> Growth | None:
    """The lines of a group, from its cases in the order of their sizes; None where there are not two sizes."""
    if len({case["grown"]["count"] for case in cases}) < 2:
        return None
    unit = cases[0]["grown"]["unit"]
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for case in cases:
        # Of a sequence the time of a frame is drawn.
        frames = case["work"]["count"] if case["work"]["unit"] == "frames" else 1
        for name, figures in {OWN: case, **case["peers"]}.items():
            row = (case["grown"]["count"], figures["median_ms"] / frames, figures["spread_ms"] / frames / 2)
            rows.setdefault(_without_numbers(name), []).append(row)
    lines = tuple(
        Line(name, *(tuple(column) for column in zip(*entries, strict=True))) for name, entries in rows.items()
    )
    return Growth(unit, lines, unit.startswith("frames"))


def growth_picture(growth: Growth) -> bytes:
    """A PNG: time over size, ours strong; a dotted line shows what growth in proportion would be."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((WIDTH_PX / DPI, HEIGHT_PX / DPI), dpi=DPI, facecolor="white")
    axes = figure.add_axes((0.115, 0.175, 0.585, 0.72))
    for line, ink in zip(growth.lines, _inks(len(growth.lines)), strict=True):
        _draw_line(axes, line, ink)
    if not growth.flat:
        _draw_proportion(axes, growth.lines[0])
    _scale(axes, growth)
    _label_ends(axes, growth.lines)
    _dress(axes, growth)
    content = io.BytesIO()
    FigureCanvasAgg(figure).print_png(content)
    return content.getvalue()


def _without_numbers(name: str) -> str:
    """`segment_plane, 128 iterations` and `segment_plane, 512 iterations` are one line."""
    return ", ".join(part for part in name.split(", ") if not part[:1].isdigit())


def _inks(count: int) -> list[str]:
    colours = [_OWN_INK, *(_PEER_INKS[index % len(_PEER_INKS)] for index in range(count - 1))]
    return ["#{:02x}{:02x}{:02x}".format(*with_contrast(colour, LIGHT_PANEL)) for colour in colours]


def _draw_line(axes: Axes, line: Line, ink: str) -> None:
    own = line.name == OWN
    low = [max(time - half, 0.2 * time) for time, half in zip(line.times_ms, line.spreads_ms, strict=True)]
    high = [time + half for time, half in zip(line.times_ms, line.spreads_ms, strict=True)]
    axes.fill_between(line.sizes, low, high, color=ink, alpha=0.13, linewidth=0)
    axes.plot(
        line.sizes,
        line.times_ms,
        color=ink,
        linewidth=2.2 if own else 1.2,
        marker="o",
        markersize=4.6 if own else 3.4,
        zorder=3 if own else 2,
        clip_on=False,
    )


def _draw_proportion(axes: Axes, own: Line) -> None:
    """Through our last point: a line below it on the left would be growth faster than the size's."""
    ends = (own.sizes[0], own.sizes[-1])
    times = [own.times_ms[-1] * size / own.sizes[-1] for size in ends]
    axes.plot(ends, times, color=FAINT, linewidth=0.9, linestyle=(0, (1, 2.2)), zorder=1)


def _scale(axes: Axes, growth: Growth) -> None:
    sizes = [size for line in growth.lines for size in line.sizes]
    times = [time for line in growth.lines for time in line.times_ms]
    axes.set_xscale("log")
    axes.set_xlim(min(sizes), max(sizes))
    ticks = sorted(set(sizes))
    axes.set_xticks(ticks, [_count(size) for size in ticks])
    axes.set_xticks([], minor=True)
    if growth.flat:
        scale = fitting_scale(0.0, max(times), 6)
        axes.set_ylim(0.0, max(scale.high, 1.08 * max(times)))
        axes.set_yticks(scale.ticks, scale.tick_texts()[1])
        return
    axes.set_yscale("log")
    low, high = 0.75 * min(times), 1.35 * max(times)
    axes.set_ylim(low, high)
    ticks = _log_ticks(low, high)
    axes.set_yticks(ticks, [number_text(tick) for tick in ticks])
    axes.set_yticks([], minor=True)


def _log_ticks(low: float, high: float) -> list[float]:
    """Powers of ten; some between them where there are few."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    decades = math.log10(high / low)
    factors = (1, 1.5, 2, 3, 5, 7) if decades < 1 else (1, 2, 5) if decades < 2.2 else (1,)
    return [tick for power in powers for factor in factors if low <= (tick := factor * 10.0**power) <= high]


def _label_ends(axes: Axes, lines: Sequence[Line]) -> None:
    """Names to the right of the lines' ends, moved apart; that of a lone point stands beside it."""
    to_axes = (axes.transData + axes.transAxes.inverted()).transform
    inks = dict(zip((line.name for line in lines), _inks(len(lines)), strict=True))
    style = {"transform": axes.transAxes, "size": 6.4, "va": "center", "linespacing": 1.05}
    ends = {line.name: to_axes((line.sizes[-1], line.times_ms[-1])) for line in lines}
    for line in lines:
        if len(line.sizes) == 1:
            x, y = ends.pop(line.name)
            axes.text(x + 0.03, y, line.name, color=inks[line.name], **style)
    names = sorted(ends, key=lambda name: ends[name][1])
    rows = [textwrap.wrap(name, _LABEL_LETTERS) for name in names]
    # A name of several rows takes the room of as many.
    room = max(map(len, rows), default=1) * _LABEL_GAP
    for name, parts, place in zip(names, rows, spread([ends[name][1] for name in names], room, 0.0, 1.0), strict=True):
        weight = "bold" if name == OWN else "normal"
        axes.text(1.03, place, "\n".join(parts), color=inks[name], weight=weight, **style)


def _dress(axes: Axes, growth: Growth) -> None:
    axes.grid(color=_GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    for side in axes.spines.values():
        side.set_visible(False)
    axes.tick_params(length=0, labelsize=7, labelcolor=INK, pad=5)
    axes.set_xlabel(growth.unit, size=7.5, color=FAINT, labelpad=5)
    what = "milliseconds a frame" if growth.flat else "milliseconds"
    axes.text(-0.1, 1.06, what, transform=axes.transAxes, size=7.5, color=FAINT)


def _count(value: float) -> str:
    """A size in short: 800 k, 12.8 M."""
    for factor, prefix in ((1e6, "M"), (1e3, "k")):
        if value >= factor:
            return f"{value / factor:.3g} {prefix}"
    return f"{value:.3g}"
