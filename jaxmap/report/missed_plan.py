"""What a map may have missed, as a drawing: the probability of a missed rock, from above."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from jaxmap.ensemble.layer import EnsembleLayers
from jaxmap.fusion.query import TopDown
from jaxmap.report.plan_drawing import ColourBar, PlanContent, draw_plan
from jaxmap.report.relief import UNOBSERVED_COLOUR, ground_shade
from jaxmap.types import GridSpec

if TYPE_CHECKING:
    from matplotlib.colors import Colormap

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
    numbers = {0.1 * number: f"{0.1 * number:g}" for number in range(5)}
    content = PlanContent(
        colours=missed_colours(layers, top, np.asarray(grid.voxel_size_m, np.float64)[:2]),
        observed=np.asarray(top.observed),
        swatches=[(f"called {target}", _CALLED), ("not observed", UNOBSERVED_COLOUR)],
        bar=ColourBar(
            f"probability of missed {target}",
            _colour_map(),
            (0.0, MOST),
            ticks={**numbers, MOST: f"{MOST:g}+"},
            room_px=86,
        ),
    )
    draw_plan(content, grid, trajectory_world, path, georeferenced=georeferenced)


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
