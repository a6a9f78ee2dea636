"""The view from above as a drawing: a north-up plan with the rover's path, a scale and a legend."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxmap.files import atomic_path
from jaxmap.fusion.query import TopDown
from jaxmap.labels import IGNORE, class_colours
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
from jaxmap.report.relief import HEIGHT_COLOUR_MAP, UNOBSERVED_COLOUR, Relief, relief
from jaxmap.types import GridSpec

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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

    cell_m = np.asarray(grid.voxel_size_m, np.float64)[:2]
    origin_m = np.asarray(grid.origin_m, np.float64)[:2]
    colours = relief(top, cell_m, classes)
    path_m = finite_path(trajectory_world)
    entries = _legend_entries(top, classes, colours, len(path_m) > 0)
    box_m = bounds_of(np.asarray(top.observed), origin_m, cell_m, path_m)
    layout = lay_out(*box_m, cell_m, entries, titled=bool(title), extra_legend_px=80 if colours.by_height else 0)
    figure = new_figure(layout)
    axes = map_axes(figure, layout, ("east, m", "north, m") if georeferenced else ("x, m", "y, m"))
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
    draw_path(axes, path_m)
    if not np.asarray(top.observed).any():
        axes.text(0.5, 0.5, "nothing observed", ha="center", va="center", transform=axes.transAxes, color=FAINT)
    if title:
        x = LEFT_PX / layout.figure_px[0]
        figure.text(x, 1 - 32 / layout.figure_px[1], title, size=11, weight="bold", va="center", color=INK)
    draw_footer(figure, layout, entries, georeferenced)
    if colours.by_height:
        _draw_colour_bar(figure, layout, colours.height_range_m)
    with atomic_path(path) as temporary:
        FigureCanvasAgg(figure).print_png(temporary)


def finite_path(trajectory_world: Float[np.ndarray, "N 3"] | None) -> Float[np.ndarray, "M 2"]:
    """The points of a path that are finite, from above."""
    if trajectory_world is None:
        return np.zeros((0, 2))
    positions_m = np.asarray(trajectory_world, np.float64).reshape(-1, 3)
    return positions_m[np.isfinite(positions_m).all(axis=-1), :2]


def bounds_of(
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


def _legend_entries(top: TopDown, classes: Sequence[str], colours: Relief, with_path: bool) -> Entries:
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
    entries: Entries = [
        (Patch(facecolor=tuple(np.array(c) / 255), edgecolor="#00000030", linewidth=0.6), name) for name, c in swatches
    ]
    if with_path:
        entries.append((Line2D([], [], color=INK, linewidth=1.8), "path"))
        entries += [(Line2D([], [], linestyle="", **style), name) for style, name in ((START, "start"), (END, "end"))]
    return entries


def _draw_colour_bar(figure: Figure, layout: PlanLayout, height_range_m: tuple[float, float]) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    width, height = layout.figure_px
    axes = figure.add_axes((LEFT_PX / width, 34 / height, 300 / width, 14 / height))
    bar = figure.colorbar(
        ScalarMappable(Normalize(*height_range_m), HEIGHT_COLOUR_MAP), cax=axes, orientation="horizontal"
    )
    bar.outline.set_visible(False)
    axes.tick_params(labelsize=8, labelcolor=INK, color=FAINT, length=2)
    axes.locator_params(nbins=5)
    axes.text(1.04, 0.5, "height, m", transform=axes.transAxes, va="center", size=9, color=INK)
