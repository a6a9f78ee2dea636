"""A plan drawn onto its sheet: one colour for each column of a map, the rover's path, a legend and a colour bar."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxmap.host.files import atomic_path
from jaxmap.report.plan_sheet import (
    END,
    FAINT,
    INK,
    LEFT_PX,
    START,
    Entries,
    PlanLayout,
    draw_footer,
    draw_path,
    lay_out,
    map_axes,
    new_figure,
)
from jaxmap.types import GridSpec

if TYPE_CHECKING:
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

Swatches = Sequence[tuple[str, tuple[int, int, int] | np.ndarray]]
"""Names and colours (RGB, 0 to 255) of a legend."""


@dataclass(frozen=True)
class ColourBar:
    """What colours say that stand for numbers.

    Attributes:
        name: of the numbers, with their unit.
        colour_map: their colours, or the name that matplotlib knows them by.
        span: the first number and the last.
        ticks: texts by number; without them, round numbers.
        room_px: to leave for the bar, below the legend.
    """

    name: str
    colour_map: Colormap | str
    span: tuple[float, float]
    ticks: Mapping[float, str] | None = None
    room_px: int = 80


@dataclass(frozen=True)
class PlanContent:
    """What a plan shows.

    Attributes:
        colours: of each column, x first, then y.
        observed: the columns that something is known of; the sheet shows them and the path.
        swatches: of the legend.
        bar: where colours stand for numbers.
        title: above the plan.
        remark: in its middle.
    """

    colours: UInt8[np.ndarray, "X Y 3"]
    observed: Bool[np.ndarray, "X Y"]
    swatches: Swatches
    bar: ColourBar | None = None
    title: str = ""
    remark: str = ""


def draw_plan(
    content: PlanContent,
    grid: GridSpec,
    trajectory_world: Float[np.ndarray, "N 3"] | None,
    path: str | os.PathLike[str],
    *,
    georeferenced: bool = True,
) -> None:
    """Draws a plan into a PNG, north up.

    Args:
        content: what it shows.
        grid: of the map.
        trajectory_world: path of the camera, metres.
        path: the picture.
        georeferenced: name the axes east and north.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    cell_m = np.asarray(grid.voxel_size_m, np.float64)[:2]
    origin_m = np.asarray(grid.origin_m, np.float64)[:2]
    path_m = _finite_path(trajectory_world)
    entries = _legend_entries(content.swatches, with_path=len(path_m) > 0)
    box_m = _bounds_of(content.observed, origin_m, cell_m, path_m)
    room_px = content.bar.room_px if content.bar else 0
    layout = lay_out(*box_m, cell_m, entries, titled=bool(content.title), extra_legend_px=room_px)
    figure = new_figure(layout)
    axes = map_axes(figure, layout, ("east, m", "north, m") if georeferenced else ("x, m", "y, m"))
    upper_m = origin_m + cell_m * content.colours.shape[:2]
    axes.imshow(
        content.colours.transpose(1, 0, 2),
        origin="lower",
        extent=(origin_m[0], upper_m[0], origin_m[1], upper_m[1]),
        interpolation="nearest",
        aspect="auto",
    )
    axes.set_xlim(*layout.extent_m[:2])
    axes.set_ylim(*layout.extent_m[2:])
    draw_path(axes, path_m)
    if content.remark:
        axes.text(0.5, 0.5, content.remark, ha="center", va="center", transform=axes.transAxes, color=FAINT)
    if content.title:
        x = LEFT_PX / layout.figure_px[0]
        figure.text(x, 1 - 32 / layout.figure_px[1], content.title, size=11, weight="bold", va="center", color=INK)
    draw_footer(figure, layout, entries, georeferenced)
    if content.bar:
        _draw_colour_bar(figure, layout, content.bar)
    with atomic_path(path) as temporary:
        FigureCanvasAgg(figure).print_png(temporary)


def _finite_path(trajectory_world: Float[np.ndarray, "N 3"] | None) -> Float[np.ndarray, "M 2"]:
    """The points of a path that are finite, from above."""
    if trajectory_world is None:
        return np.zeros((0, 2))
    positions_m = np.asarray(trajectory_world, np.float64).reshape(-1, 3)
    return positions_m[np.isfinite(positions_m).all(axis=-1), :2]


def _bounds_of(
    observed: np.ndarray, origin_m: np.ndarray, cell_m: np.ndarray, path_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The box of whole cells around what was observed and the path within the map."""
    upper_m = origin_m + cell_m * observed.shape
    cells = np.argwhere(observed)
    corners = [path_m.clip(origin_m, upper_m)]
    corners += (
        [origin_m + cells * cell_m, origin_m + (cells + 1) * cell_m] if len(cells) else [origin_m[None], upper_m[None]]
    )
    points_m = np.concatenate(corners)
    first = np.floor((points_m.min(axis=0) - origin_m) / cell_m + 1e-6)
    last = np.ceil((points_m.max(axis=0) - origin_m) / cell_m - 1e-6)
    return origin_m + first * cell_m, origin_m + last * cell_m


def _legend_entries(swatches: Swatches, *, with_path: bool) -> Entries:
    """Handles and names of all that the plan shows."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    entries: Entries = [
        (Patch(facecolor=tuple(np.array(colour) / 255), edgecolor="#00000030", linewidth=0.6), name)
        for name, colour in swatches
    ]
    if with_path:
        entries.append((Line2D([], [], color=INK, linewidth=1.8), "path"))
        entries += [(Line2D([], [], linestyle="", **style), name) for style, name in ((START, "start"), (END, "end"))]
    return entries


def _draw_colour_bar(figure: Figure, layout: PlanLayout, bar: ColourBar) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    width, height = layout.figure_px
    axes = figure.add_axes((LEFT_PX / width, 34 / height, 300 / width, 14 / height))
    numbers = None if bar.ticks is None else list(bar.ticks)
    drawn = figure.colorbar(
        ScalarMappable(Normalize(*bar.span), bar.colour_map), cax=axes, orientation="horizontal", ticks=numbers
    )
    drawn.outline.set_visible(False)
    axes.tick_params(labelsize=8, labelcolor=INK, color=FAINT, length=2)
    if bar.ticks is None:
        axes.locator_params(nbins=5)
    else:
        axes.set_xticklabels(list(bar.ticks.values()))
    axes.text(1.04, 0.5, bar.name, transform=axes.transAxes, va="center", size=9, color=INK)
