"""The picture of a plan: the path over what driving costs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8

from jaxmap.fusion.query import TopDown
from jaxmap.planning.cost import CostMap
from jaxmap.planning.ground import Ground
from jaxmap.report.top_down import UNOBSERVED_COLOUR, ColourBar, draw, ground_shade, map_sheet
from jaxmap.types import GridSpec

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap

_RAMP = ["#e9e6d8", "#f6d58a", "#ee9a4d", "#c9502c", "#7d1f3f"]
_BARRED, _ROCK_LINE = (138, 141, 152), "#3b2436"
_MOST_COST = 10.0
"""Costs from here on have the last colour."""
_LIGHT = 0.35


def write_plan_picture(
    path: Path,
    costs: CostMap,
    ground: Ground,
    top: TopDown,
    grid: GridSpec,
    points_m: Float[np.ndarray, "M 2"],
    metrics: Mapping[str, Any],
    *,
    georeferenced: bool,
) -> None:
    """Draws a path over the cost of driving into a PNG, over shaded ground, with the outlines of rocks.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    colours = plan_colours(costs, ground, top, np.asarray(grid.voxel_size_m, np.float64)[:2])
    ticks = {1.0: "1", 2.0: "2", 5.0: "5", _MOST_COST: f"{_MOST_COST:g}+"}
    bar = ColourBar("cost of a metre, metres", _colour_map(), (1.0, _MOST_COST), ticks)
    rock = ground.seen & (ground.rock_probability > 0.5)
    legend: list[tuple[str, Any]] = [("cannot be driven", _BARRED), ("not seen", UNOBSERVED_COLOUR)]
    if rock.any():
        legend.insert(0, ("rock", dict(color=_ROCK_LINE, linewidth=1.2)))
    title = f"{metrics['length_m']:.1f} m at a cost of {metrics['cost']:.1f} m"
    sheet = map_sheet(
        colours,
        top,
        grid,
        np.pad(points_m, ((0, 0), (0, 1))),
        legend=legend,
        bar=bar,
        title=title,
        georeferenced=georeferenced,
    )

    def outlines(axes: Axes) -> None:
        if rock.any() and not rock.all():
            x, y = (
                o + (np.arange(n) + 0.5) * s for o, n, s in zip(sheet.origin_m, rock.shape, sheet.cell_m, strict=True)
            )
            axes.contour(x, y, rock.T.astype(np.float32), levels=[0.5], colors=[_ROCK_LINE], linewidths=1.0, zorder=3)

    draw(sheet, path, outlines)


def plan_colours(
    costs: CostMap, ground: Ground, top: TopDown, cell_size_m: Float[np.ndarray, "2"]
) -> UInt8[np.ndarray, "X Y 3"]:
    """The colours of the cells, x first, then y: cost on a logarithmic scale, lit from the north-west."""
    colours = np.tile(np.array(UNOBSERVED_COLOUR, np.uint8), (*ground.seen.shape, 1))
    seen = ground.seen | costs.drivable
    if not ground.seen.any():
        return colours
    height_m = np.where(ground.surface.known, ground.surface.height_m, top.height_m)
    shade = ground_shade(np.asarray(height_m, np.float64), ground.seen, cell_size_m)
    scaled = ((costs.cost.clip(1, _MOST_COST) - 1) / (_MOST_COST - 1))[..., None]
    base = np.array(_colour_map()(scaled[..., 0], bytes=True))[..., :3].astype(np.float64)
    base = np.where(costs.drivable[..., None], base, 0.15 * base + 0.85 * np.array(_BARRED))
    lit = base * (1 - _LIGHT + _LIGHT * shade[..., None])
    colours[seen] = np.rint(lit[seen]).clip(0, 255)
    return colours


def _colour_map() -> Colormap:
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("cost", _RAMP)
