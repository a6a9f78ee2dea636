"""The top-down map of a map of any size, block by block, and of a part of it as whole arrays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxmap.errors import JaxmapError
from jaxmap.fusion.neighbours import kernel_margin
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams
from jaxmap.fusion.query import TopDown, top_down
from jaxmap.fusion.surface import ColumnHeights, column_heights
from jaxmap.host.memory import available_bytes
from jaxmap.labels import IGNORE
from jaxmap.mapping.store import Block, Columns, MapReader
from jaxmap.types import GridSpec, VoxelMap, to_device

MOST_WHOLE = 2**24
"""Columns of a map that is read whole; of a larger one only what is needed: 200 m by 200 m of 0.05 m."""


class TopDownBlock(NamedTuple):
    """A rectangle of the top-down map, of NumPy arrays, and where it lies in the grid of the map."""

    top: TopDown
    place: Columns


def top_down_blocks(
    reader: MapReader, params: FusionParams, rule: FusionRule, within: Columns | None = None
) -> Iterator[TopDownBlock]:
    """The top-down map in rectangles, one after the other, equal to that of the whole map, bit for bit.

    Args:
        reader: the map.
        params: of fusion, by which it is read.
        rule: of fusion, likewise.
        within: only the rectangles that touch these columns.
    """
    margin = kernel_margin(params.class_kernel)
    edge = tuple(max((place[axis].stop - place[axis].start for place in reader.places), default=1) for axis in (0, 1))
    for block in reader.blocks(margin, within):
        # All of one shape, that one program serves them; beyond the edges there is no evidence in any case.
        same, (x, y) = _padded(block, (edge[0], edge[1]), margin)
        top = jax.tree.map(np.asarray, top_down(same, params, rule))
        own = TopDown(*(leaf[..., x, y] for leaf in top))
        place = tuple(slice(a, a + size) for a, size in zip(block.corner, own.label.shape, strict=True))
        yield TopDownBlock(own, (place[0], place[1]))


def top_down_of(reader: MapReader, params: FusionParams, rule: FusionRule, within: Columns) -> TopDown:
    """The top-down map of a rectangle of columns, as whole arrays.

    Raises:
        JaxmapError: no memory holds them.
    """
    shape = (within[0].stop - within[0].start, within[1].stop - within[1].start)
    check_columns(shape, 8 + 4 * len(reader.classes), "the top-down map")
    prior = np.asarray(jax.nn.sigmoid(params.class_prior))
    whole: dict[str, Any] = dict(
        probability=np.broadcast_to(prior[:, None, None], (len(reader.classes), *shape)).copy(),
        label=np.full(shape, IGNORE, np.uint8),
        height_m=np.full(shape, np.nan, np.float32),
        observed=np.zeros(shape, bool),
    )
    for top, place in top_down_blocks(reader, params, rule, within):
        here, there = overlap(place, within)
        for name, values in top._asdict().items():
            whole[name][(..., *there)] = values[(..., *here)]
    return TopDown(**whole)


def log_odds_of(reader: MapReader, within: Columns) -> Float[np.ndarray, "K X Y Z"]:
    """The evidence of a rectangle of columns, zeros where nothing was observed.

    Raises:
        JaxmapError: a tile is damaged, or no memory holds the columns.
    """
    shape = (within[0].stop - within[0].start, within[1].stop - within[1].start)
    check_columns(shape, 4 * (1 + len(reader.classes)) * reader.grid.shape[2], "the map")
    values = np.zeros((1 + len(reader.classes), *shape, reader.grid.shape[2]), np.float32)
    for block in reader.blocks(0, within):
        own = np.asarray(block.voxel_map.log_odds)[(slice(None), *block.own)]
        place = tuple(slice(a, a + size) for a, size in zip(block.corner, own.shape[1:3], strict=True))
        here, there = overlap((place[0], place[1]), within)
        values[(slice(None), *there)] = own[(slice(None), *here)]
    return values


def heights_of(reader: MapReader, params: FusionParams, within: Columns) -> ColumnHeights:
    """What is known of the heights of a rectangle of columns, NumPy; it may reach beyond the grid.

    Raises:
        JaxmapError: a tile is damaged, or no memory holds the columns.
    """
    shape = (within[0].stop - within[0].start, within[1].stop - within[1].start)
    check_columns(shape, 24, "the heights")
    height = reader.grid.shape[2]
    whole = ColumnHeights(
        np.zeros((4, *shape), np.float32) if reader.surface else None,
        np.full(shape, height, np.int32),
        np.full(shape, -1, np.int32),
    )
    for block in reader.blocks(0, within):
        columns = jax.tree.map(np.asarray, column_heights(block.voxel_map, params))
        size = tuple(own.stop - own.start for own in block.own)
        place = tuple(slice(a, a + length) for a, length in zip(block.corner, size, strict=True))
        here, there = overlap((place[0], place[1]), within)
        for into, values in zip(jax.tree.leaves(whole), jax.tree.leaves(columns), strict=True):
            into[(..., *there)] = values[(..., *block.own)][(..., *here)]
    return whole


def squares_of(reader: MapReader, edge: int) -> list[Columns]:
    """The squares of so many columns that hold what was observed; those at the edge reach beyond the grid."""
    corners = {(x.start // edge, y.start // edge) for x, y in reader.places}
    return [(slice(x * edge, (x + 1) * edge), slice(y * edge, (y + 1) * edge)) for x, y in sorted(corners)]


def nearest_observed(reader: MapReader, column: tuple[float, float]) -> tuple[int, int] | None:
    """The column of which anything was observed that is nearest to a place, both counted in the grid; None of none."""

    def apart(place: Columns) -> float:
        return float(np.hypot(*(max(p.start - at, at - p.stop, 0) for p, at in zip(place, column, strict=True))))

    best, nearest = np.inf, None
    for place in sorted(reader.places, key=apart):
        if apart(place) >= best:
            break
        columns = np.argwhere((log_odds_of(reader, place) != 0).any(axis=(0, 3))) + _corner(place)
        if len(columns):
            away = np.hypot(*(columns + 0.5 - column).T)
            if away.min() < best:
                best = float(away.min())
                nearest = tuple(map(int, columns[away.argmin()]))
    return None if nearest is None else (nearest[0], nearest[1])


def _corner(place: Columns) -> Int[np.ndarray, "2"]:
    return np.array([place[0].start, place[1].start])


def check_columns(shape: tuple[int, int], number_bytes: float, what: str) -> None:
    """Refuses arrays of a size that no memory holds.

    Raises:
        JaxmapError: they take more than is free.
    """
    needed, free = shape[0] * shape[1] * number_bytes, available_bytes()
    if free is not None and needed > free:
        raise JaxmapError(
            f"{what} of {shape[0]:,} x {shape[1]:,} columns takes {needed / 2**30:.3g} GiB, there are "
            f"{free / 2**30:.3g}",
            where="the map",
            fix="take a smaller part of it, or a larger machine",
        )


def overlap(place: Columns, within: Columns) -> tuple[Columns, Columns]:
    """What two rectangles share, as counted in the first and in the second."""
    shared = [slice(max(a.start, b.start), min(a.stop, b.stop)) for a, b in zip(place, within, strict=True)]
    here, there = (
        tuple(slice(s.start - o.start, s.stop - o.start) for s, o in zip(shared, outer, strict=True))
        for outer in (place, within)
    )
    return (here[0], here[1]), (there[0], there[1])


def part_of(grid: GridSpec, within: Columns) -> GridSpec:
    """The grid of a rectangle of columns."""
    first = np.asarray(grid.first) + np.array([within[0].start, within[1].start, 0])
    shape = (within[0].stop - within[0].start, within[1].stop - within[1].start, grid.shape[2])
    return replace(grid, first=to_device(first, np.int32), shape=shape)


def _padded(block: Block, edge: tuple[int, int], margin: int) -> tuple[VoxelMap, Columns]:
    """The map of a block with empty columns around it up to `edge` and the margin, and where its own columns are."""
    voxel_map = block.voxel_map
    before = [margin - own.start for own in block.own]
    after = [
        wanted + 2 * margin - size - low for wanted, size, low in zip(edge, voxel_map.grid.shape, before, strict=False)
    ]
    own = tuple(slice(own.start + low, own.stop + low) for own, low in zip(block.own, before, strict=True))
    if any(before) or any(after):
        edges = [(0, 0), *zip(before, after, strict=True), (0, 0)]
        first = np.asarray(voxel_map.grid.first) - np.array([*before, 0])
        shape = tuple(wanted + 2 * margin for wanted in edge)
        grid = replace(voxel_map.grid, first=to_device(first, np.int32), shape=(*shape, voxel_map.grid.shape[2]))
        log_odds = jnp.asarray(np.pad(np.asarray(voxel_map.log_odds), edges))
        voxel_map = replace(voxel_map, log_odds=log_odds, grid=grid)
    return replace(voxel_map, members=None, surface=None), (own[0], own[1])
