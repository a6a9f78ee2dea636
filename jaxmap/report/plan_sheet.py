"""The sheet that plans are drawn on: north-up axes in metres, a legend, a scale and an arrow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from jaxmap.report.relief import UNOBSERVED_COLOUR

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, FAINT, CASING = "#23272e", "#8a8f98", "#ffffff"
DPI = 150
LEFT_PX = 120
_MAP_PX = 1500
_RIGHT_PX, _BELOW_PX = 50, 100
_LEGEND_ROW_PX = 29

Entries = list[tuple[Any, str]]
"""Handles and names of a legend."""


@dataclass(frozen=True)
class PlanLayout:
    """Where things are: `extent_m` is west, east, south, north; the rest is in pixels, from the lower left."""

    extent_m: tuple[float, float, float, float]
    map_px: tuple[int, int]
    figure_px: tuple[int, int]
    legend_px: int

    @property
    def px_per_m(self) -> float:
        """Scale of the sheet."""
        return self.map_px[0] / (self.extent_m[1] - self.extent_m[0])


def lay_out(
    low_m: Float64[np.ndarray, "2"],
    high_m: Float64[np.ndarray, "2"],
    cell_m: Float64[np.ndarray, "2"],
    entries: Entries,
    *,
    titled: bool = False,
    extra_legend_px: int = 0,
) -> PlanLayout:
    """A sheet that shows a box of the world as large as fits, each cell with as many pixels as the next.

    Args:
        low_m: south-west corner of the box, on the edge of a cell.
        high_m: its north-east corner.
        cell_m: size of a cell.
        entries: of the legend.
        titled: leave room for a title.
        extra_legend_px: room to leave below the legend.
    """
    # Whole cells of margin, so that the edges of cells stay where they are.
    margin_m = np.ceil(np.maximum(0.04 * (high_m - low_m).max(), cell_m) / cell_m) * cell_m
    low_m, high_m = low_m - margin_m, high_m + margin_m
    px_per_m = _MAP_PX / (high_m - low_m).max()
    px_per_cell = px_per_m * cell_m.min()
    if px_per_cell > 2:
        px_per_m = np.floor(px_per_cell) / cell_m.min()
    width, height = (max(1, round(span * px_per_m)) for span in high_m - low_m)
    figure_width = max(width + LEFT_PX + _RIGHT_PX, 1000)
    rows = -(-len(entries) // _legend_columns(entries, figure_width))
    above = 70 if titled else 40
    legend = max(rows * _LEGEND_ROW_PX + extra_legend_px, 60) + 24
    return PlanLayout(
        extent_m=(float(low_m[0]), float(high_m[0]), float(low_m[1]), float(high_m[1])),
        map_px=(width, height),
        figure_px=(figure_width, height + above + _BELOW_PX + legend),
        legend_px=legend,
    )


def new_figure(layout: PlanLayout) -> Figure:
    """An empty white sheet."""
    from matplotlib.figure import Figure

    return Figure(figsize=(layout.figure_px[0] / DPI, layout.figure_px[1] / DPI), dpi=DPI, facecolor="white")


def map_axes(figure: Figure, layout: PlanLayout, names: tuple[str, str]) -> Axes:
    """Axes that show the extent of a layout to scale, with `names` beside them."""
    from matplotlib.ticker import MultipleLocator

    width, height = layout.figure_px
    left = LEFT_PX + (width - LEFT_PX - _RIGHT_PX - layout.map_px[0]) // 2
    bottom = layout.legend_px + _BELOW_PX
    rectangle = (left / width, bottom / height, layout.map_px[0] / width, layout.map_px[1] / height)
    axes = figure.add_axes(rectangle, facecolor=np.array(UNOBSERVED_COLOUR) / 255)
    axes.set_xlabel(names[0], color=INK, size=9)
    axes.set_ylabel(names[1], color=INK, size=9)
    axes.tick_params(colors=FAINT, labelcolor=INK, labelsize=8, length=3, width=0.8)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(_nice(100 / layout.px_per_m)))
    for spine in axes.spines.values():
        spine.set(color=FAINT, linewidth=0.8)
    axes.set_axisbelow(False)
    axes.grid(color="black", alpha=0.07, linewidth=0.6)
    return axes


def _nice(number: float) -> float:
    """The round number (1, 2 or 5 times a power of ten) next above."""
    power = 10.0 ** np.floor(np.log10(number))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= number * (1 - 1e-9)))


START: dict[str, Any] = dict(marker="o", markersize=9, markerfacecolor=CASING, markeredgecolor=INK, markeredgewidth=1.8)
END: dict[str, Any] = dict(marker="s", markersize=8, markerfacecolor=INK, markeredgecolor=CASING, markeredgewidth=1.4)


def draw_path(axes: Axes, path_m: Float64[np.ndarray, "N 2"]) -> None:
    """Draws a path with its start and end; nothing where it has no point."""
    if not len(path_m):
        return
    line: dict[str, Any] = dict(solid_capstyle="round", solid_joinstyle="round", zorder=4)
    axes.plot(*path_m.T, color=CASING, linewidth=4.2, alpha=0.9, **line)
    axes.plot(*path_m.T, color=INK, linewidth=1.8, **line)
    for point_m, style in ((path_m[0], START), (path_m[-1], END)):
        axes.plot(*point_m, **style, zorder=5)


def draw_footer(figure: Figure, layout: PlanLayout, entries: Entries, georeferenced: bool) -> None:
    """Draws the legend, the scale and, where the plan is `georeferenced`, an arrow to the north."""
    width, height = layout.figure_px
    footer = figure.add_axes((0, 0, 1, layout.legend_px / height))
    footer.set(xlim=(0, width), ylim=(0, layout.legend_px))
    footer.axis("off")
    handles, names = zip(*entries, strict=True)
    footer.legend(
        handles,
        names,
        loc="upper left",
        bbox_to_anchor=(LEFT_PX, layout.legend_px),
        bbox_transform=footer.transData,
        ncols=_legend_columns(entries, width),
        frameon=False,
        fontsize=9,
        labelcolor=INK,
        handlelength=1.1,
        handleheight=1.1,
        columnspacing=1.6,
        borderaxespad=0,
        borderpad=0,
    )
    _draw_scale(footer, layout)
    if georeferenced:
        _draw_north(footer, layout)


def _legend_columns(entries: Entries, figure_width_px: int) -> int:
    widest_px = 12 * max(len(name) for _, name in entries) + 62
    return max(1, min(len(entries), int((figure_width_px - LEFT_PX - _scale_room_px(figure_width_px)) // widest_px)))


def _scale_room_px(figure_width_px: int) -> int:
    return _RIGHT_PX + 110 + figure_width_px // 4


def _draw_scale(footer: Axes, layout: PlanLayout) -> None:
    width, middle = layout.figure_px[0], layout.legend_px - 26
    length_m = _nice(0.55 * layout.map_px[0] / 5 / layout.px_per_m)
    length_px = length_m * layout.px_per_m
    right = width - _RIGHT_PX - 70
    footer.plot([right - length_px, right], [middle - 8] * 2, color=INK, linewidth=2.4, solid_capstyle="butt")
    for end in (right - length_px, right):
        footer.plot([end] * 2, [middle - 14, middle - 2], color=INK, linewidth=1.2)
    footer.text(right - length_px / 2, middle + 12, f"{length_m:g} m", ha="center", va="center", size=9, color=INK)


def _draw_north(footer: Axes, layout: PlanLayout) -> None:
    north, middle = layout.figure_px[0] - _RIGHT_PX - 14, layout.legend_px - 26
    footer.fill([north, north - 11, north, north + 11], [middle + 12, middle - 24, middle - 15, middle - 24], color=INK)
    footer.text(north, middle + 22, "N", ha="center", va="center", size=9, weight="bold", color=INK)
