"""The pictures of a map of any size: drawn from at most some thousand cells a side."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from jaxmap.ensemble.layer import layer_names, stored_layers
from jaxmap.export.source import Source, TopDownPart, unknown_top
from jaxmap.fusion.query import TopDown
from jaxmap.report.top_down import missed_picture, top_down_picture
from jaxmap.types import GridSpec, to_device

MOST_CELLS = 3000
"""Cells of a picture along its longer side: about twice its pixels."""


def write_overview(source: Source, picture: Path, missed: Path) -> Iterable[Path]:
    """Writes the picture of the top-down map and, where there is an ensemble, that of what it may have missed.

    Returns:
        Those that were written.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    top, layers, grid = overview(source)
    path_world = source.track.T_world_camera[:, :3, 3] if len(source.track.T_world_camera) else None
    placed = source.reader.attributes.crs is not None
    top_down_picture(top, grid, source.classes, path_world, picture, georeferenced=placed)
    target = source.fusion[1].target(source.classes)
    ensemble = stored_layers(layers, target, source.where)
    if ensemble is None or target is None:
        return (picture,)
    missed_picture(ensemble, target, top, grid, path_world, missed, georeferenced=placed)
    return (picture, missed)


def overview(source: Source, most_cells: int = MOST_CELLS) -> tuple[TopDown, dict[str, np.ndarray], GridSpec]:
    """The top-down map by cells of as many columns as it takes to have few enough, the ensemble's layers, and the grid.

    A cell has the label of the class asked about first (rock) where a column of it has, so that small rocks are not
    lost; else that of its highest column, with whose height. Probabilities are left out.
    """
    grid = source.reader.grid
    step = -(-max(grid.shape[:2]) // most_cells)
    width, depth = (-(-size // step) for size in grid.shape[:2])
    top: Any = unknown_top(0, (width, depth))
    names = _ensemble_names(source)
    layers = {name: np.full((width, depth), np.nan, np.float32) for name in names}
    for part in source.parts():
        _add(part, step, source.target, top, layers)
    size_m = np.asarray(grid.voxel_size_m) * np.array([step, step, 1], np.float32)
    coarse = GridSpec(
        lattice_m=to_device(np.asarray(grid.origin_m), np.float32),
        voxel_size_m=to_device(size_m, np.float32),
        shape=(width, depth, grid.shape[2]),
    )
    return top, layers, grid if step == 1 else coarse


def _ensemble_names(source: Source) -> list[str]:
    target = source.fusion[1].target(source.classes)
    names = layer_names(target) if target is not None else ()
    return [name for name in names if name in source.reader.attributes.layers]


def _add(part: TopDownPart, step: int, target: int | None, top: Any, layers: dict[str, np.ndarray]) -> None:
    """Adds the columns of a block to the cells that they fall into."""
    x, y = np.argwhere(part.top.observed).T
    height_m, label = np.asarray(part.top.height_m)[x, y], np.asarray(part.top.label)[x, y]
    # The last of each cell stays: one of the target, or else the highest. Two blocks may share a cell.
    order = np.lexsort((height_m, label == target))
    x, y, height_m, label = (values[order] for values in (x, y, height_m, label))
    to = ((x + part.corner[0]) // step, (y + part.corner[1]) // step)
    there_m, there = np.nan_to_num(top.height_m[to], nan=-np.inf), top.label[to] == target
    kept = np.where(there == (label == target), height_m >= there_m, label == target)
    at = tuple(side[kept] for side in to)
    top.label[at], top.height_m[at] = label[kept], height_m[kept]
    top.observed[to] = True
    for name, values in layers.items():
        np.fmax.at(values, to, part.layers[name][x, y])
