"""The view from above as a drawing: a north-up plan with the rover's path, a scale and a legend."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxmap.files import atomic_path
from jaxmap.fusion.query import TopDown
from jaxmap.labels import IGNORE, class_colours
from jaxmap.report.relief import HEIGHT_COLOUR_MAP, UNOBSERVED_COLOUR, Relief, relief
from jaxmap.types import GridSpec

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INK, _FAINT, _CASING = "#23272e", "#8a8f98", "#ffffff"
_DPI = 150
_MAP_PX = 1500
_LEFT_PX, _RIGHT_PX, _BELOW_PX = 120, 50, 100
_LEGEND_ROW_PX = 29


@dataclass(frozen=True)
class _Layout:
    """Where things are: `extent_m` is west, east, south, north; the rest is in pixels, from the lower left."""

    extent_m: tuple[float, float, float, float]
    map_px: tuple[int, int]
    figure_px: tuple[int, int]
    legend_px: int

    @property
    def px_per_m(self) -> float:
        return self.map_px[0] / (self.extent_m[1] - self.extent_m[0])


def top_down_picture(
    top: TopDown,
    grid: GridSpec,
    classes: Sequence[str],
    trajectory_world: Float[np.ndarray, "N 3"] | None,
    path: str | os.PathLike[str],
    *,
    title: str = "",
    georeferenced: bool = True,
) -> None:
    """Draws the observed part of a map from above into a PNG.

    Cells carry the colours of their classes (of their heights where no cell has a class), lit from the
    north-west; axes are metres of the world, named east and north where it is `georeferenced`.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    cell_m = np.asarray(grid.voxel_size_m, np.float64)[:2]
    origin_m = np.asarray(grid.origin_m, np.float64)[:2]
    colours = relief(top, cell_m, classes)
    path_m = _finite(trajectory_world)
    entries = _legend_entries(top, classes, colours, len(path_m) > 0)
    layout = _lay_out(
        np.asarray(top.observed), origin_m, cell_m, path_m, entries, titled=bool(title), by_height=colours.by_height
    )

    figure = Figure(figsize=(layout.figure_px[0] / _DPI, layout.figure_px[1] / _DPI), dpi=_DPI, facecolor="white")
    axes = _map_axes(figure, layout, ("east, m", "north, m") if georeferenced else ("x, m", "y, m"))
    upper_m = origin_m + cell_m * colours.colours.shape[:2]
    axes.imshow(
        colours.colours.transpose(1, 0, 2),
        origin="lower",
        extent=(origin_m[0], upper_m[0], origin_m[1], upper_m[1]),
        interpolation="nearest",
        aspect="auto",
    )
    axes.set_xlim(*layout.extent_m[:2])
    axes.set_ylim(*layout.extent_m[2:])
    _draw_path(axes, path_m)
    if not np.asarray(top.observed).any():
        axes.text(0.5, 0.5, "nothing observed", ha="center", va="center", transform=axes.transAxes, color=_FAINT)
    if title:
        x = _LEFT_PX / layout.figure_px[0]
        figure.text(x, 1 - 32 / layout.figure_px[1], title, size=11, weight="bold", va="center", color=_INK)
    _draw_footer(figure, layout, entries, colours, georeferenced)
    with atomic_path(path) as temporary:
        FigureCanvasAgg(figure).print_png(temporary)


def _finite(trajectory_world: Float[np.ndarray, "N 3"] | None) -> Float[np.ndarray, "M 2"]:
    if trajectory_world is None:
        return np.zeros((0, 2))
    positions_m = np.asarray(trajectory_world, np.float64).reshape(-1, 3)
    return positions_m[np.isfinite(positions_m).all(axis=-1), :2]


def _lay_out(
    observed: np.ndarray,
    origin_m: np.ndarray,
    cell_m: np.ndarray,
    path_m: np.ndarray,
    entries: list[tuple[Any, str]],
    *,
    titled: bool,
    by_height: bool,
) -> _Layout:
    upper_m = origin_m + cell_m * observed.shape
    cells = np.argwhere(observed)
    corners = [path_m.clip(origin_m, upper_m)]
    corners += (
        [origin_m + cells * cell_m, origin_m + (cells + 1) * cell_m] if len(cells) else [origin_m[None], upper_m[None]]
    )
    points_m = np.concatenate(corners)
    low_m, high_m = points_m.min(axis=0), points_m.max(axis=0)
    # Whole cells on each side, so that every cell gets as many pixels as the next.
    margin_m = np.ceil(np.maximum(0.04 * (high_m - low_m).max(), cell_m) / cell_m) * cell_m
    low_m = origin_m + np.floor((low_m - origin_m) / cell_m + 1e-6) * cell_m - margin_m
    high_m = origin_m + np.ceil((high_m - origin_m) / cell_m - 1e-6) * cell_m + margin_m
    px_per_m = _MAP_PX / (high_m - low_m).max()
    px_per_cell = px_per_m * cell_m.min()
    if px_per_cell > 2:
        px_per_m = np.floor(px_per_cell) / cell_m.min()
    width, height = (max(1, round(span * px_per_m)) for span in high_m - low_m)
    figure_width = max(width + _LEFT_PX + _RIGHT_PX, 1000)
    rows = -(-len(entries) // _legend_columns(entries, figure_width))
    above = 70 if titled else 40
    legend = max(rows * _LEGEND_ROW_PX + (80 if by_height else 0), 60) + 24
    return _Layout(
        extent_m=(low_m[0], high_m[0], low_m[1], high_m[1]),
        map_px=(width, height),
        figure_px=(figure_width, height + above + _BELOW_PX + legend),
        legend_px=legend,
    )


def _map_axes(figure: Figure, layout: _Layout, names: tuple[str, str]) -> Axes:
    from matplotlib.ticker import MultipleLocator

    width, height = layout.figure_px
    left = _LEFT_PX + (width - _LEFT_PX - _RIGHT_PX - layout.map_px[0]) // 2
    bottom = layout.legend_px + _BELOW_PX
    rectangle = (left / width, bottom / height, layout.map_px[0] / width, layout.map_px[1] / height)
    axes = figure.add_axes(rectangle, facecolor=np.array(UNOBSERVED_COLOUR) / 255)
    axes.set_xlabel(names[0], color=_INK, size=9)
    axes.set_ylabel(names[1], color=_INK, size=9)
    axes.tick_params(colors=_FAINT, labelcolor=_INK, labelsize=8, length=3, width=0.8)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MultipleLocator(_nice(100 / layout.px_per_m)))
    for spine in axes.spines.values():
        spine.set(color=_FAINT, linewidth=0.8)
    axes.set_axisbelow(False)
    axes.grid(color="black", alpha=0.07, linewidth=0.6)
    return axes


def _nice(number: float) -> float:
    """The round number (1, 2 or 5 times a power of ten) next above."""
    power = 10.0 ** np.floor(np.log10(number))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= number * (1 - 1e-9)))


def _draw_path(axes: Axes, path_m: np.ndarray) -> None:
    if not len(path_m):
        return
    line: dict[str, Any] = dict(solid_capstyle="round", solid_joinstyle="round", zorder=4)
    axes.plot(*path_m.T, color=_CASING, linewidth=4.2, alpha=0.9, **line)
    axes.plot(*path_m.T, color=_INK, linewidth=1.8, **line)
    for point_m, style in ((path_m[0], _START), (path_m[-1], _END)):
        axes.plot(*point_m, **style, zorder=5)


_START: dict[str, Any] = dict(
    marker="o", markersize=9, markerfacecolor=_CASING, markeredgecolor=_INK, markeredgewidth=1.8
)
_END: dict[str, Any] = dict(
    marker="s", markersize=8, markerfacecolor=_INK, markeredgecolor=_CASING, markeredgewidth=1.4
)


def _legend_entries(top: TopDown, classes: Sequence[str], colours: Relief, with_path: bool) -> list[tuple[Any, str]]:
    """Handles and names of all that the plan shows."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    present = set(np.unique(np.asarray(top.label)[np.asarray(top.observed)]).tolist())
    swatches = (
        []
        if colours.by_height
        else [(name, class_colours(classes)[i]) for i, name in enumerate(classes) if i in present]
    )
    if IGNORE in present and not colours.by_height:
        swatches.append(("no label", class_colours(classes)[IGNORE]))
    swatches.append(("not observed", UNOBSERVED_COLOUR))
    entries: list[tuple[Any, str]] = [
        (Patch(facecolor=tuple(np.array(c) / 255), edgecolor="#00000030", linewidth=0.6), name) for name, c in swatches
    ]
    if with_path:
        entries.append((Line2D([], [], color=_INK, linewidth=1.8), "path"))
        entries += [(Line2D([], [], linestyle="", **style), name) for style, name in ((_START, "start"), (_END, "end"))]
    return entries


def _legend_columns(entries: list[tuple[Any, str]], figure_width_px: int) -> int:
    widest_px = 12 * max(len(name) for _, name in entries) + 62
    return max(1, min(len(entries), int((figure_width_px - _LEFT_PX - _scale_room_px(figure_width_px)) // widest_px)))


def _scale_room_px(figure_width_px: int) -> int:
    return _RIGHT_PX + 110 + figure_width_px // 4


def _draw_footer(
    figure: Figure, layout: _Layout, entries: list[tuple[Any, str]], colours: Relief, georeferenced: bool
) -> None:
    width, height = layout.figure_px
    footer = figure.add_axes((0, 0, 1, layout.legend_px / height))
    footer.set(xlim=(0, width), ylim=(0, layout.legend_px))
    footer.axis("off")
    handles, names = zip(*entries, strict=True)
    footer.legend(
        handles,
        names,
        loc="upper left",
        bbox_to_anchor=(_LEFT_PX, layout.legend_px),
        bbox_transform=footer.transData,
        ncols=_legend_columns(entries, width),
        frameon=False,
        fontsize=9,
        labelcolor=_INK,
        handlelength=1.1,
        handleheight=1.1,
        columnspacing=1.6,
        borderaxespad=0,
        borderpad=0,
    )
    _draw_scale(footer, layout)
    if georeferenced:
        _draw_north(footer, layout)
    if colours.by_height:
        _draw_colour_bar(figure, layout, colours.height_range_m)


def _draw_scale(footer: Axes, layout: _Layout) -> None:
    width, middle = layout.figure_px[0], layout.legend_px - 26
    length_m = _nice(0.55 * layout.map_px[0] / 5 / layout.px_per_m)
    length_px = length_m * layout.px_per_m
    right = width - _RIGHT_PX - 70
    footer.plot([right - length_px, right], [middle - 8] * 2, color=_INK, linewidth=2.4, solid_capstyle="butt")
    for end in (right - length_px, right):
        footer.plot([end] * 2, [middle - 14, middle - 2], color=_INK, linewidth=1.2)
    footer.text(right - length_px / 2, middle + 12, f"{length_m:g} m", ha="center", va="center", size=9, color=_INK)


def _draw_north(footer: Axes, layout: _Layout) -> None:
    north, middle = layout.figure_px[0] - _RIGHT_PX - 14, layout.legend_px - 26
    footer.fill(
        [north, north - 11, north, north + 11], [middle + 12, middle - 24, middle - 15, middle - 24], color=_INK
    )
    footer.text(north, middle + 22, "N", ha="center", va="center", size=9, weight="bold", color=_INK)


def _draw_colour_bar(figure: Figure, layout: _Layout, height_range_m: tuple[float, float]) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    width, height = layout.figure_px
    axes = figure.add_axes((_LEFT_PX / width, 34 / height, 300 / width, 14 / height))
    bar = figure.colorbar(
        ScalarMappable(Normalize(*height_range_m), HEIGHT_COLOUR_MAP), cax=axes, orientation="horizontal"
    )
    bar.outline.set_visible(False)
    axes.tick_params(labelsize=8, labelcolor=_INK, color=_FAINT, length=2)
    axes.locator_params(nbins=5)
    axes.text(1.04, 0.5, "height, m", transform=axes.transAxes, va="center", size=9, color=_INK)
