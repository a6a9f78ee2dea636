"""What a map may have missed, as a drawing: the probability of a missed rock, from above."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from jaxmap.ensemble.layer import EnsembleLayers
from jaxmap.files import atomic_path
from jaxmap.fusion.query import TopDown
from jaxmap.report.plan import bounds_of, finite_path
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
from jaxmap.report.relief import UNOBSERVED_COLOUR, ground_shade
from jaxmap.types import GridSpec

if TYPE_CHECKING:
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

MOST = 0.5
"""Probabilities from here on have the last colour: what is more likely than not is called by most thresholds."""

_RAMP = ["#e2d7bf", "#f7bf4f", "#ee7d2f", "#c9302c", "#7a0f3c"]
_CALLED = (74, 78, 88)
_LIGHT = 0.2
"""How much of the light is shown: hints of the ground, while colours can be found again on the bar."""


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
    """Draws what an ensemble says was missed into a PNG, north up, over ground that is lit from the north-west.

    Args:
        layers: of the ensemble.
        target: the class that may have been missed.
        top: the map from above.
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
    path_m = finite_path(trajectory_world)
    entries = _legend_entries(target, len(path_m) > 0)
    box_m = bounds_of(np.asarray(top.observed), origin_m, cell_m, path_m)
    layout = lay_out(*box_m, cell_m, entries, extra_legend_px=86)
    figure = new_figure(layout)
    axes = map_axes(figure, layout, ("east, m", "north, m") if georeferenced else ("x, m", "y, m"))
    colours = missed_colours(layers, top, cell_m)
    upper_m = origin_m + cell_m * colours.shape[:2]
    axes.imshow(
        colours.transpose(1, 0, 2),
        origin="lower",
        extent=(origin_m[0], upper_m[0], origin_m[1], upper_m[1]),
        interpolation="nearest",
        aspect="auto",
    )
    axes.set_xlim(*layout.extent_m[:2])
    axes.set_ylim(*layout.extent_m[2:])
    draw_path(axes, path_m)
    draw_footer(figure, layout, entries, georeferenced)
    _draw_colour_bar(figure, layout, target)
    with atomic_path(path) as temporary:
        FigureCanvasAgg(figure).print_png(temporary)


def missed_colours(
    layers: EnsembleLayers, top: TopDown, cell_size_m: Float[np.ndarray, "2"]
) -> UInt8[np.ndarray, "X Y 3"]:
    """The picture itself, one colour for each column: x first, then y."""
    missed, observed = np.asarray(layers.missed), np.asarray(top.observed)
    colours = np.tile(np.array(UNOBSERVED_COLOUR, np.uint8), (*observed.shape, 1))
    if not observed.any():
        return colours
    base = np.array(_colour_map()(np.nan_to_num(missed[observed]) / MOST, bytes=True))[:, :3]
    base[layers.called()[observed]] = _CALLED
    shade = ground_shade(np.asarray(top.height_m, np.float64), observed, cell_size_m)[observed]
    colours[observed] = np.rint(base * (1 - _LIGHT + _LIGHT * shade[:, None])).clip(0, 255)
    return colours


def _colour_map() -> Colormap:
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("missed", _RAMP)


def _legend_entries(target: str, with_path: bool) -> Entries:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    swatches = [(f"called {target}", _CALLED), ("not observed", UNOBSERVED_COLOUR)]
    entries: Entries = [
        (Patch(facecolor=tuple(np.array(colour) / 255), edgecolor="#00000030", linewidth=0.6), name)
        for name, colour in swatches
    ]
    if with_path:
        entries.append((Line2D([], [], color=INK, linewidth=1.8), "path"))
        entries += [(Line2D([], [], linestyle="", **style), name) for style, name in ((START, "start"), (END, "end"))]
    return entries


def _draw_colour_bar(figure: Figure, layout: PlanLayout, target: str) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    width, height = layout.figure_px
    axes = figure.add_axes((LEFT_PX / width, 34 / height, 300 / width, 14 / height))
    bar = figure.colorbar(
        ScalarMappable(Normalize(0, MOST), _colour_map()),
        cax=axes,
        orientation="horizontal",
        ticks=[0, 0.1, 0.2, 0.3, 0.4, 0.5],
    )
    bar.ax.set_xticklabels(["0", "0.1", "0.2", "0.3", "0.4", f"{MOST:g}+"])
    bar.outline.set_visible(False)
    axes.tick_params(labelsize=8, labelcolor=INK, color=FAINT, length=2)
    axes.text(1.04, 0.5, f"probability of missed {target}", transform=axes.transAxes, va="center", size=9, color=INK)
