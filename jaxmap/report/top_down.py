"""Pictures of the top-down map: north up, lit from the north-west, with the rover's path, a legend and a scale."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxmap.ensemble.layer import EnsembleLayers
from jaxmap.fusion.query import TopDown
from jaxmap.host.files import atomic_path
from jaxmap.labels import IGNORE, class_colours
from jaxmap.types import GridSpec

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap

INK, FAINT, CASING = "#23272e", "#8a8f98", "#ffffff"
UNOBSERVED_COLOUR = (241, 240, 236)
DPI = 150
PLACE_KEY = "jaxmap-place"
"""A text in each PNG of a map: where the map lies on the picture, and what it shows."""
PLACE = ("left_px", "top_px", "width_px", "height_px", "west_m", "south_m", "east_m", "north_m")
"""Its entries; metres are relative to the site origin."""
_LEFT_PX, _RIGHT_PX, _BELOW_PX = 150, 50, 130
_TEXT, _SMALL = 12, 11

_LIGHT_WORLD = np.array([-0.5, 0.5, 0.75]) / np.linalg.norm([-0.5, 0.5, 0.75])

MOST_MISSED = 0.5
"""Probabilities from here on have the last colour: what is more likely than not is called by most thresholds."""
_MISSED_RAMP = ["#e2d7bf", "#f7bf4f", "#ee7d2f", "#c9302c", "#7a0f3c"]
_CALLED = (74, 78, 88)
_MISSED_LIGHT = 0.2
"""How much of the shading is kept: hints of the ground, while colours can be found again on the bar."""

_START: dict[str, Any] = dict(marker="o", markersize=9, mfc=CASING, mec=INK, mew=1.8, linestyle="")
_END: dict[str, Any] = dict(marker="s", markersize=8, mfc=INK, mec=CASING, mew=1.4, linestyle="")


class ColourBar(NamedTuple):
    """What colours mean that stand for numbers: name and unit, colours, range, and texts of the ticks by number."""

    name: str
    colour_map: Colormap | str
    span: tuple[float, float]
    ticks: dict[float, str] | None = None


class Layout(NamedTuple):
    """How a sheet is laid out: pixels of the map's longer side, and whether title and legend stand on the picture."""

    map_px: int
    with_legend: bool


WHOLE, HALF = Layout(1500, True), Layout(820, False)
"""A map that fills a page, and one of two side by side, of which the page has the legend."""


@dataclass(frozen=True)
class Sheet:
    """A picture of the ground.

    Attributes:
        colours: x first, then y; several for each cell where the cells are divided.
        origin_m: south-west corner of the colours, world.
        cell_m: size of a cell.
        per_cell: colours along each side of a cell.
        legend: names, with a colour (RGB, 0 to 255) or matplotlib's properties of a line.
        box_m: south-west and north-east corner of what is shown, on edges of cells; everything by default.
        path_m: the rover's path.
        bar: where colours stand for numbers.
        georeferenced: the axes are east and north.
    """

    colours: UInt8[np.ndarray, "X Y 3"]
    origin_m: Float[np.ndarray, "2"]
    cell_m: Float[np.ndarray, "2"]
    legend: Sequence[tuple[str, Any]]
    per_cell: int = 1
    box_m: tuple[np.ndarray, np.ndarray] | None = None
    path_m: Float[np.ndarray, "N 2"] | None = None
    bar: ColourBar | None = None
    title: str = ""
    remark: str = ""
    georeferenced: bool = True


def draw(
    sheet: Sheet,
    path: str | os.PathLike[str],
    overlay: Callable[[Axes], object] | None = None,
    layout: Layout = WHOLE,
) -> None:
    """Draws a sheet into a PNG, north up; cells are whole pixels where they are large enough.

    Args:
        sheet: what is drawn.
        path: the picture.
        overlay: draws more onto the map.
        layout: its size, and whether it has a legend.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import MultipleLocator

    end_m = sheet.origin_m + sheet.cell_m * sheet.colours.shape[:2] / sheet.per_cell
    low_m, high_m = sheet.box_m or (sheet.origin_m, end_m)
    # Whole cells of margin, so that the edges of cells stay where they are.
    margin_m = np.ceil(np.maximum(0.04 * (high_m - low_m).max(), sheet.cell_m) / sheet.cell_m) * sheet.cell_m
    low_m, high_m = low_m - margin_m, high_m + margin_m
    px_per_m = layout.map_px / (high_m - low_m).max()
    if px_per_m * sheet.cell_m.min() > 4:
        px_per_m = np.floor(px_per_m * sheet.cell_m.min()) / sheet.cell_m.min()
    map_width, map_height = (max(1, round(span * px_per_m)) for span in high_m - low_m)

    handles, names = _legend(sheet) if layout.with_legend else ([], [""])
    width = max(map_width + _LEFT_PX + _RIGHT_PX, 1000)
    columns = int((0.75 * width - _LEFT_PX - _RIGHT_PX - 110) // (15 * max(map(len, names)) + 75))
    columns = min(max(columns, 1), len(names))
    legend_px = max(38 * -(-len(names) // columns) + (104 if sheet.bar else 0), 60) + 24
    title, scale_px = sheet.title, legend_px
    if not layout.with_legend:
        # The scale stands beside the name of the axis.
        title, legend_px, scale_px = "", 0, 84
    height = map_height + _BELOW_PX + legend_px + (84 if title else 40)
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")
    left = _LEFT_PX + (width - _LEFT_PX - _RIGHT_PX - map_width) // 2
    axes_at = (left / width, (legend_px + _BELOW_PX) / height, map_width / width, map_height / height)
    axes = figure.add_axes(axes_at, facecolor=np.array(UNOBSERVED_COLOUR) / 255)
    extent = (sheet.origin_m[0], end_m[0], sheet.origin_m[1], end_m[1])
    picture = sheet.colours.transpose(1, 0, 2)
    axes.imshow(picture, origin="lower", extent=extent, interpolation="nearest", aspect="auto")
    axes.set(xlim=(low_m[0], high_m[0]), ylim=(low_m[1], high_m[1]))
    for axis, name in zip((axes.xaxis, axes.yaxis), ("east", "north") if sheet.georeferenced else "xy", strict=True):
        axis.set_major_locator(MultipleLocator(_nice(140 / px_per_m)))
        axis.set_label_text(f"{name}, m", color=INK, size=_TEXT)
    axes.tick_params(colors=FAINT, labelcolor=INK, labelsize=_SMALL, length=3, width=0.8)
    axes.spines[:].set(color=FAINT, linewidth=0.8)
    axes.set_axisbelow(False)
    axes.grid(color="black", alpha=0.07, linewidth=0.6)
    if sheet.path_m is not None and len(sheet.path_m):
        line: dict[str, Any] = dict(solid_capstyle="round", solid_joinstyle="round", zorder=4)
        axes.plot(*sheet.path_m.T, color=CASING, linewidth=4.2, alpha=0.9, **line)
        axes.plot(*sheet.path_m.T, color=INK, linewidth=1.8, **line)
        axes.plot(*sheet.path_m[0], **_START, zorder=5)
        axes.plot(*sheet.path_m[-1], **_END, zorder=5)
    if overlay is not None:
        overlay(axes)
    axes.text(0.5, 0.5, sheet.remark, ha="center", va="center", transform=axes.transAxes, color=FAINT)
    figure.text(_LEFT_PX / width, 1 - 42 / height, title, size=13, weight="bold", va="center", color=INK)

    spacing: dict[str, Any] = dict(handlelength=1.1, handleheight=1.1, columnspacing=1.6, borderaxespad=0, borderpad=0)
    anchor: dict[str, Any] = dict(
        loc="upper left", bbox_to_anchor=(_LEFT_PX / width, legend_px / height), ncols=columns
    )
    if layout.with_legend:
        figure.legend(handles, names, **anchor, frameon=False, fontsize=_TEXT, labelcolor=INK, **spacing)
    _draw_scale(axes, (width - _RIGHT_PX, scale_px), _nice(0.11 * map_width / px_per_m), north=sheet.georeferenced)
    if sheet.bar:
        _draw_bar(figure.add_axes((_LEFT_PX / width, 54 / height, 400 / width, 18 / height)), sheet.bar)
    edges_px = (left, height - legend_px - _BELOW_PX - map_height, map_width, map_height)
    place = dict(zip(PLACE, (*edges_px, *low_m.tolist(), *high_m.tolist()), strict=True))
    with atomic_path(path) as temporary:
        FigureCanvasAgg(figure).print_png(temporary, metadata={PLACE_KEY: json.dumps(place)})


def _legend(sheet: Sheet) -> tuple[list[Any], list[str]]:
    """Handles and names of all that a sheet shows."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    entries: list[tuple[str, Any]] = [
        (name, Line2D([], [], **look))
        if isinstance(look, dict)
        else (name, Patch(facecolor=tuple(np.array(look) / 255), edgecolor="#00000030", linewidth=0.6))
        for name, look in sheet.legend
    ]
    if sheet.path_m is not None and len(sheet.path_m):
        looks = {"path": dict(color=INK, linewidth=1.8), "start": _START, "end": _END}
        entries += [(name, Line2D([], [], **look)) for name, look in looks.items()]
    return [handle for _, handle in entries], [name for name, _ in entries]


def _draw_scale(axes: Axes, corner_px: tuple[int, int], length_m: float, *, north: bool) -> None:
    """Draws a scale and an arrow to the north, with their upper right corner at a place of the figure."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.transforms import IdentityTransform
    from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

    right, top = corner_px
    at: dict[str, Any] = dict(bbox_to_anchor=(right - 60, top), bbox_transform=IdentityTransform())
    look: dict[str, Any] = dict(fontproperties=FontProperties(size=_TEXT), label_top=True, color=INK, frameon=False)
    space: dict[str, Any] = dict(pad=0, borderpad=0, sep=5, size_vertical=length_m / 50)
    scale = AnchoredSizeBar(axes.transData, length_m, f"{length_m:g} m", "upper right", **look, **space, **at)
    axes.figure.add_artist(scale)
    if north:
        arrow = dict(arrowstyle="-|>,head_length=0.6,head_width=0.3", color=INK, shrinkA=0, shrinkB=0)
        text: dict[str, Any] = dict(color=INK, size=_TEXT, weight="bold", ha="center", va="top", annotation_clip=False)
        text |= dict(xycoords="figure pixels", textcoords="figure pixels", arrowprops=arrow)
        axes.annotate("N", (right - 14, top), (right - 14, top - 52), **text)


def _draw_bar(axes: Axes, bar: ColourBar) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    colours = ScalarMappable(Normalize(*bar.span), bar.colour_map)
    ticks = None if bar.ticks is None else list(bar.ticks)
    axes.figure.colorbar(colours, cax=axes, orientation="horizontal", ticks=ticks).outline.set_visible(False)
    axes.tick_params(labelsize=_SMALL, labelcolor=INK, color=FAINT, length=2)
    if bar.ticks is None:
        axes.locator_params(nbins=5)
    else:
        axes.set_xticklabels(list(bar.ticks.values()))
    axes.text(1.04, 0.5, bar.name, transform=axes.transAxes, va="center", size=_TEXT, color=INK)


def _nice(number: float) -> float:
    """The round number (1, 2 or 5 times a power of ten) next above."""
    power = 10.0 ** np.floor(np.log10(number))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= number * (1 - 1e-9)))


def map_sheet(
    colours: np.ndarray, top: TopDown, grid: GridSpec, trajectory_world: np.ndarray | None, **more: Any
) -> Sheet:
    """A sheet of a map, cropped to the columns that were observed and the path within the map."""
    cell_m, origin_m = (np.asarray(leaf, np.float64)[:2] for leaf in (grid.voxel_size_m, grid.origin_m))
    end_m = origin_m + cell_m * grid.shape[:2]
    path_world = np.zeros((0, 3)) if trajectory_world is None else np.asarray(trajectory_world, np.float64)
    path_m = path_world[np.isfinite(path_world).all(axis=-1), :2]
    cells = np.argwhere(top.observed)
    seen_m = (
        [origin_m + cells * cell_m, origin_m + (cells + 1) * cell_m] if len(cells) else [origin_m[None], end_m[None]]
    )
    shown_m = np.concatenate([path_m.clip(origin_m, end_m), *seen_m])
    first = np.floor((shown_m.min(axis=0) - origin_m) / cell_m + 1e-6)
    last = np.ceil((shown_m.max(axis=0) - origin_m) / cell_m - 1e-6)
    box_m = (origin_m + first * cell_m, origin_m + last * cell_m)
    remark = "" if len(cells) else "nothing observed"
    return Sheet(colours, origin_m, cell_m, box_m=box_m, path_m=path_m, remark=remark, **more)


def top_down_picture(
    top: TopDown,
    grid: GridSpec,
    classes: Sequence[str],
    trajectory_world: Float[np.ndarray, "N 3"] | None,
    path: str | os.PathLike[str],
    *,
    title: str = "",
    georeferenced: bool = True,
    layout: Layout = WHOLE,
) -> None:
    """Draws the observed part of a top-down map into a PNG.

    Cells carry the colours of their classes (of their heights where no cell has a class), lit from the
    north-west; axes are metres of the world, named east and north where it is `georeferenced`.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    shown = top_down_colours(top, np.asarray(grid.voxel_size_m, np.float64)[:2], classes)
    bar, legend = None, []
    if shown.by_height:
        bar = ColourBar("height, m", "viridis", shown.height_range_m)
    else:
        present, colours = set(np.asarray(top.label)[np.asarray(top.observed)].tolist()), class_colours(classes)
        names = [*enumerate(classes), (IGNORE, "no label")]
        legend = [(name, colours[label]) for label, name in names if label in present]
    look: dict[str, Any] = dict(legend=[*legend, ("not observed", UNOBSERVED_COLOUR)], bar=bar, title=title)
    sheet = map_sheet(shown.colours, top, grid, trajectory_world, georeferenced=georeferenced, **look)
    draw(sheet, path, layout=layout)


class MapColours(NamedTuple):
    """Colours of cells, x first; `by_height` where they show heights, over `height_range_m`."""

    colours: UInt8[np.ndarray, "X Y 3"]
    by_height: bool
    height_range_m: tuple[float, float]


def top_down_colours(top: TopDown, cell_size_m: Float[np.ndarray, "2"], classes: Sequence[str]) -> MapColours:
    """Colours the cells by class and shades them by their slope; by height where no cell has a class."""
    from matplotlib import colormaps

    observed, label = np.asarray(top.observed), np.asarray(top.label)
    height_m = np.asarray(top.height_m, np.float64)
    colours = np.tile(np.array(UNOBSERVED_COLOUR, np.uint8), (*observed.shape, 1))
    if not observed.any():
        return MapColours(colours, False, (0.0, 0.0))
    low, high = np.percentile(height_m[observed], [1, 99])
    by_height = bool((label[observed] == IGNORE).all())
    if by_height:
        scaled = ((height_m[observed] - low) / max(high - low, 1e-6)).clip(0, 1)
        base = colormaps["viridis"](scaled, bytes=True)[:, :3]
    else:
        base = class_colours(classes)[label[observed]]
    shade = ground_shade(height_m, observed, cell_size_m)[observed]
    colours[observed] = np.rint(base * shade[:, None]).clip(0, 255)
    return MapColours(colours, by_height, (float(low), float(high)))


def ground_shade(
    height_m: Float[np.ndarray, "X Y"], observed: Bool[np.ndarray, "X Y"], cell_size_m: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "X Y"]:
    """Brightness of ground lit from the north-west, 1 where it is level."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    # Heights of the nearest seen cell keep the rim of the map level; a slight blur hides the steps of the voxels.
    nearest: Any = distance_transform_edt(~observed, return_distances=False, return_indices=True)
    smooth_m = gaussian_filter(height_m[tuple(nearest)], 0.7, mode="nearest")
    slopes = [
        np.gradient(smooth_m, axis=axis) / cell_size_m[axis] if smooth_m.shape[axis] > 1 else np.zeros_like(smooth_m)
        for axis in (0, 1)
    ]
    normal = np.stack([-slopes[0], -slopes[1], np.ones_like(smooth_m)], axis=-1)
    lit = (normal @ _LIGHT_WORLD) / np.linalg.norm(normal, axis=-1) / _LIGHT_WORLD[2]
    return (0.35 + 0.65 * lit.clip(0)).clip(0.45, 1.3)


def missed_picture(
    layers: EnsembleLayers,
    target: str,
    top: TopDown,
    grid: GridSpec,
    trajectory_world: Float[np.ndarray, "N 3"] | None,
    path: str | os.PathLike[str],
    *,
    georeferenced: bool = True,
) -> None:
    """Draws the probability that a map missed the class `target`, by an ensemble, into a PNG, over shaded ground.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    ticks = {0.1 * number: f"{0.1 * number:g}" for number in range(5)} | {MOST_MISSED: f"{MOST_MISSED:g}+"}
    bar = ColourBar(f"probability of missed {target}", _missed_colour_map(), (0.0, MOST_MISSED), ticks)
    colours = missed_colours(layers, top, np.asarray(grid.voxel_size_m, np.float64)[:2])
    legend = [(f"called {target}", _CALLED), ("not observed", UNOBSERVED_COLOUR)]
    draw(map_sheet(colours, top, grid, trajectory_world, legend=legend, bar=bar, georeferenced=georeferenced), path)


def missed_colours(
    layers: EnsembleLayers, top: TopDown, cell_size_m: Float[np.ndarray, "2"]
) -> UInt8[np.ndarray, "X Y 3"]:
    """The colours of `missed_picture`, one for each column: x first, then y."""
    missed, observed = np.asarray(layers.missed), np.asarray(top.observed)
    colours = np.tile(np.array(UNOBSERVED_COLOUR, np.uint8), (*observed.shape, 1))
    if not observed.any():
        return colours
    base = np.array(_missed_colour_map()(np.nan_to_num(missed[observed]) / MOST_MISSED, bytes=True))[:, :3]
    base[layers.called()[observed]] = _CALLED
    shade = ground_shade(np.asarray(top.height_m, np.float64), observed, cell_size_m)[observed]
    colours[observed] = np.rint(base * (1 - _MISSED_LIGHT + _MISSED_LIGHT * shade[:, None])).clip(0, 255)
    return colours


def _missed_colour_map() -> Colormap:
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("missed", _MISSED_RAMP)
