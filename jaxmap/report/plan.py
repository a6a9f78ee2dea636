"""The view from above as a drawing: a north-up plan with the rover's path, a scale and a legend."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxmap.fusion.query import TopDown
from jaxmap.labels import IGNORE, class_colours
from jaxmap.report.plan_drawing import ColourBar, PlanContent, Swatches, draw_plan
from jaxmap.report.relief import HEIGHT_COLOUR_MAP, UNOBSERVED_COLOUR, relief
from jaxmap.types import GridSpec


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
    shown = relief(top, np.asarray(grid.voxel_size_m, np.float64)[:2], classes)
    observed = np.asarray(top.observed)
    content = PlanContent(
        colours=shown.colours,
        observed=observed,
        swatches=_swatches(top, () if shown.by_height else classes, labelled=not shown.by_height),
        bar=ColourBar("height, m", HEIGHT_COLOUR_MAP, shown.height_range_m) if shown.by_height else None,
        title=title,
        remark="" if observed.any() else "nothing observed",
    )
    draw_plan(content, grid, trajectory_world, path, georeferenced=georeferenced)


def _swatches(top: TopDown, classes: Sequence[str], *, labelled: bool) -> Swatches:
    """Names and colours of what the plan shows: its classes where the colours are of classes."""
    present = set(np.unique(np.asarray(top.label)[np.asarray(top.observed)]).tolist())
    colours = class_colours(classes)
    swatches = [(name, colours[index]) for index, name in enumerate(classes) if index in present]
    if labelled and IGNORE in present:
        swatches.append(("no label", colours[IGNORE]))
    return [*swatches, ("not observed", UNOBSERVED_COLOUR)]
