"""Scores a top-down map against ground truth, from arrays: cells, domain, registration, scores and rocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from jaxmap.datasets.crs import Extent
from jaxmap.datasets.label_raster import TARGET, LabelRaster
from jaxmap.errors import JaxmapError
from jaxmap.evaluation.camera_track import CameraTrack, ground_height, view_range
from jaxmap.evaluation.cells import (
    CellGrid,
    ColumnShares,
    MapCells,
    area_in_cells,
    column_shares,
    make_cells,
    map_cells,
)
from jaxmap.evaluation.map_scores import confusion_scores, count_confusion, ranking_scores, reliability, score_cells
from jaxmap.evaluation.options import ScoringOptions
from jaxmap.evaluation.truth_cells import (
    Alignment,
    TruthCells,
    cell_counts,
    register,
    samples_of,
    soft_iou,
    truth_cells,
)
from jaxmap.geometry.grid import exact_corner
from jaxmap.types import GridSpec

_MARGIN_M = 2.0
_SEARCH_SAMPLES = 8
SIZE_EDGES_M = (0.0, 0.1, 0.2, 0.3, 0.5, 1.0, np.inf)
RANGE_EDGES_M = (0.0, 2.0, 4.0, 6.0, 8.0, 12.0, 20.0, np.inf)


@dataclass(frozen=True, eq=False)
class ClassLayer:
    """One class of a top-down map, as it is scored; columns of voxels, x first.

    Attributes:
        grid: the grid of the map.
        is_class: the column is labelled with the class.
        probability: of the class.
        observed: a surface was observed in the column.
        height_m: of that surface, world.
        prior: probability of the class where nothing was observed.
        ensemble: probability of the class by an ensemble, NaN where nothing was observed; None without one.
        site_origin: where the world's origin lies in `crs`.
        crs: coordinate reference system of the site, or None.
    """

    grid: GridSpec
    is_class: Bool[np.ndarray, "X Y"]
    probability: Float[np.ndarray, "X Y"]
    observed: Bool[np.ndarray, "X Y"]
    height_m: Float[np.ndarray, "X Y"]
    prior: float = 0.5
    ensemble: Float[np.ndarray, "X Y"] | None = None
    site_origin: Float64[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    crs: str | None = None

    @property
    def place(self) -> Extent:
        """The extent of the grid in `crs`."""
        return place_of(self.grid, self.site_origin, self.crs)


def place_of(grid: GridSpec, site_origin: Float64[np.ndarray, "3"], crs: str | None) -> Extent:
    """The extent of a grid in the system of its site."""
    origin_m, voxel_m = exact_corner(grid)
    low = np.asarray(site_origin, np.float64)[:2] + origin_m[:2]
    high = low + voxel_m[:2] * grid.shape[:2]
    return Extent(float(low[0]), float(low[1]), float(high[0]), float(high[1]), crs)


class Evaluation(NamedTuple):
    """Scores, and the cells they were counted in (the part of the map that was looked at).

    `scores` holds plain values, as scores.json has them. `counted` cells were observed and are labelled (and lie in
    range); `domain` cells are labelled and were looked at, observed or not; `called` and `truly` are what the map and
    the truth say of the class.
    """

    scores: dict[str, Any]
    cells: CellGrid
    observed: Bool[np.ndarray, "I J"]
    called: Bool[np.ndarray, "I J"]
    truly: Bool[np.ndarray, "I J"]
    counted: Bool[np.ndarray, "I J"]
    domain: Bool[np.ndarray, "I J"]
    truth: TruthCells
    alignment: Alignment


def evaluate_map(
    layer: ClassLayer, raster: LabelRaster, cameras: CameraTrack | None = None, options: ScoringOptions | None = None
) -> Evaluation:
    """Scores one class of a map.

    Args:
        layer: the class of the map.
        raster: the truth.
        cameras: that made the map; without them every labelled cell of the map's box is in view.
        options: how it is scored.

    Raises:
        JaxmapError: no observed cell is labelled, a range is asked for without cameras, or invalid cells.
    """
    options = options or ScoringOptions()
    if options.max_range_m is not None and cameras is None:
        raise JaxmapError("a range needs the poses and the camera of the map", where="max_range_m", fix="give cameras")
    whole = make_cells(layer.grid, options.cell_size_m)
    shares = column_shares(layer.grid, whole)
    said = map_cells(layer.is_class, layer.probability, layer.observed, shares, layer.prior)
    view_range_m = options.max_range_m or (cameras.max_range_m if cameras else np.inf)
    range_m = np.full(whole.shape, np.inf)
    in_view = np.ones(whole.shape, bool)
    if cameras is not None:
        range_m = view_range(whole, _ground_m(layer, shares, said, whole), cameras, view_range_m)
        in_view = np.isfinite(range_m)
    here, cells = _around(whole, in_view | np.asarray(said.observed))
    said = MapCells(*(np.asarray(leaf)[here] for leaf in said))
    observed, probability = np.asarray(said.observed), np.asarray(said.probability)
    range_m, in_view = range_m[here], in_view[here]
    asked = observed & (in_view if options.max_range_m is not None else True)
    called = said.called(options.rock_fraction)

    def placed(alignment: Alignment, per_cell: int | None = None) -> TruthCells:
        return truth_cells(raster, cells, layer.site_origin, layer.crs, alignment=alignment, per_cell=per_cell)

    def scored(truth: TruthCells) -> dict[str, Any]:
        """Scores over the counted cells, and `in_view` over the domain; coverage is that of the domain in both."""
        truly = truth.truly(options.rock_fraction)
        in_domain = score_cells(called, probability, truly, in_view & truth.labelled, observed)
        counted = score_cells(called, probability, truly, asked & truth.labelled, observed)
        return counted | {"coverage": in_domain["coverage"], "in_view": in_domain}

    alignment = Alignment()
    if options.register:
        alignment = _best_alignment(placed, cells, said, asked, options.rock_fraction)
    truth = placed(alignment)
    truly = truth.truly(options.rock_fraction)
    counted, domain = asked & truth.labelled, in_view & truth.labelled
    if not counted.any():
        within = "" if options.max_range_m is None else f" within {options.max_range_m:g} m"
        raise JaxmapError(
            f"no observed cell is labelled: {asked.sum()} cells were observed{within}, "
            f"{truth.labelled.sum()} are labelled",
            where=raster.name,
            fix="check that both are of one site, and the coding of the labels",
        )
    scores = scored(truth) | {
        "cells": int(counted.sum()),
        "rock_cells": int((truly & counted).sum()),
        "frames": None if cameras is None else len(cameras.T_world_camera),
        "rocks": rock_table(
            find_rocks(truth, cells.size_m, _called_samples(layer, cells, truth.per_cell), domain, range_m),
            options.found_share,
        ),
        "cell_size_m": options.cell_size_m,
        "rock_fraction": options.rock_fraction,
        "max_range_m": options.max_range_m,
        "view_range_m": None if np.isinf(view_range_m) else float(view_range_m),
    }
    if layer.ensemble is not None:
        # Ground that was not observed is not of the class. The sums of areas such as 0.2 / 3 are not exact.
        columns = np.where(layer.observed, layer.ensemble, 0.0).astype(np.float32)
        expected = (np.asarray(area_in_cells(shares, columns)) / shares.columns_per_cell).clip(0, 1)[here]
        missing = counted & ~called
        scores["ensemble"] = missed_scores(expected[missing], np.asarray(said.share)[missing], truly[missing])
    if options.register:
        scores["registration"] = {
            "shift_east_m": alignment.shift_m[0],
            "shift_north_m": alignment.shift_m[1],
            "heading_deg": float(np.rad2deg(alignment.heading_rad)),
            "pivot_m": list(alignment.pivot_m),
            "before": scored(placed(Alignment())),
        }
    return Evaluation(scores, cells, observed, called, truly, counted, domain, truth, alignment)


def missed_scores(
    expected: Float[np.ndarray, "N"], share: Float[np.ndarray, "N"], truly: Bool[np.ndarray, "N"]
) -> dict[str, Any]:
    """How well an ensemble predicts missed cells among those that the map does not call by the class.

    Args:
        expected: the share of each cell that is of the class, by the ensemble: its probability to be missed.
        share: the same by the map alone, for comparison.
        truly: cells that are of the class.
    """
    return {
        "cells": len(truly),
        "missed_cells": int(truly.sum()),
        "expected_missed_cells": float(expected.sum(dtype=np.float64)),
        **ranking_scores(expected, truly),
        "reliability": reliability(expected, truly),
        "map_alone": ranking_scores(share, truly),
    }


def _ground_m(layer: ClassLayer, shares: ColumnShares, said: MapCells, cells: CellGrid) -> Float64[np.ndarray, "I J"]:
    """Height of the ground under each cell, world."""
    heights = np.where(layer.observed, np.nan_to_num(layer.height_m), 0.0).astype(np.float32)
    area = np.asarray(area_in_cells(shares, layer.observed.astype(np.float32)))
    mean = np.asarray(area_in_cells(shares, heights)) / np.where(area > 0, area, 1.0)
    return ground_height(mean, np.asarray(said.observed), (cells.size_m, cells.size_m))


def _around(cells: CellGrid, wanted: np.ndarray) -> tuple[tuple[slice, slice], CellGrid]:
    """The part of the cells around the wanted ones, with a margin that keeps rocks whole."""
    if not wanted.any():
        return (slice(None), slice(None)), cells
    margin = int(np.ceil(_MARGIN_M / cells.size_m))
    first, last = np.argwhere(wanted).min(axis=0) - margin, np.argwhere(wanted).max(axis=0) + margin + 1
    first, last = first.clip(min=0), np.minimum(last, cells.shape)
    origin_m = np.asarray(cells.origin_m) + first * cells.size_m
    size = last - first
    part = CellGrid((float(origin_m[0]), float(origin_m[1])), cells.size_m, (int(size[0]), int(size[1])))
    return (slice(int(first[0]), int(last[0])), slice(int(first[1]), int(last[1]))), part


def _best_alignment(
    placed: Callable[..., TruthCells], cells: CellGrid, said: MapCells, asked: np.ndarray, fraction: float
) -> Alignment:
    """The motion at which the sum of IoU and soft IoU is greatest; none where the IoU does not gain."""
    x, y = cells.centres()
    seen = np.argwhere(asked)
    middle = seen.mean(axis=0).round().astype(int) if len(seen) else np.zeros(2, int)
    pivot_m = (float(x[middle[0]]), float(y[middle[1]]))
    called, share = said.called(fraction), np.asarray(said.share)

    def iou(truth: TruthCells) -> float:
        return confusion_scores(count_confusion(called, truth.truly(fraction), asked & truth.labelled))["iou"] or 0.0

    def overlap(alignment: Alignment) -> float:
        moved = placed(alignment, _SEARCH_SAMPLES)
        return iou(moved) + soft_iou(share, moved.share, asked & moved.labelled)

    best, still = register(overlap, pivot_m), Alignment(pivot_m=pivot_m)
    # The search samples the truth coarsely: what counts is the score itself.
    return best if iou(placed(best)) > iou(placed(still)) else still


def _called_samples(layer: ClassLayer, cells: CellGrid, per_cell: int) -> Bool[np.ndarray, "FI FJ"]:
    """Whether the map's own columns are of the class, at the samples of the truth; none is outside the map."""
    origin_m, voxel_m = exact_corner(layer.grid)
    place = []
    for axis, columns in enumerate(layer.is_class.shape):
        samples = (np.arange(cells.shape[axis] * per_cell) + 0.5) * cells.size_m / per_cell
        column = np.floor((cells.origin_m[axis] + samples - origin_m[axis]) / voxel_m[axis])
        place.append(column.clip(-1, columns).astype(int) + 1)
    return np.pad(layer.is_class, 1)[np.ix_(*place)]


class Rocks(NamedTuple):
    """Rocks of the truth that lie in the domain by half of their area at least.

    `diameter_m` is that of the disc of the same area; `range_m` how near a camera came to the nearest of their cells
    (infinite where that is not known); `found_share` is how much of their area in the domain the map calls rock.
    """

    diameter_m: Float64[np.ndarray, "N"]
    range_m: Float64[np.ndarray, "N"]
    found_share: Float64[np.ndarray, "N"]


def find_rocks(
    truth: TruthCells,
    cell_size_m: float,
    called: Bool[np.ndarray, "FI FJ"],
    domain: Bool[np.ndarray, "I J"],
    range_m: Float[np.ndarray, "I J"],
) -> Rocks:
    """Splits the truth into connected rocks (8-connectivity), at its own resolution.

    Args:
        truth: in cells.
        cell_size_m: of a cell.
        called: samples of the truth that the map calls rock, by its columns: most stones are smaller than a cell, and
            no map could find them by cells.
        domain: cells in which rocks count.
        range_m: how near a camera came to each cell (`view_range`).
    """
    from scipy.ndimage import find_objects, label

    labelled: Any = label(truth.fine == TARGET, np.ones((3, 3), bool))
    numbers: np.ndarray = labelled[0]
    sample_m2 = (cell_size_m / truth.per_cell) ** 2
    rows = []
    for number, box in enumerate(find_objects(numbers), start=1):
        corner = tuple(slice(s.start // truth.per_cell, -(-s.stop // truth.per_cell)) for s in box)
        fine = tuple(slice(s.start * truth.per_cell, s.stop * truth.per_cell) for s in corner)
        rock = numbers[fine] == number
        inside = rock & samples_of(domain[corner], truth.per_cell)
        if 2 * inside.sum() < rock.sum():
            continue
        nearest_m = float(range_m[corner][cell_counts(inside, truth.per_cell) > 0].min())
        rows.append((2 * np.sqrt(rock.sum() * sample_m2 / np.pi), nearest_m, called[fine][inside].mean()))
    table = np.array(rows, np.float64).reshape(-1, 3)
    return Rocks(table[:, 0], table[:, 1], table[:, 2])


def rock_table(rocks: Rocks, found_share: float = 0.5) -> dict[str, Any]:
    """Counts of rocks and of missed rocks, in all, by size and by range.

    A rock is found where the map calls at least `found_share` of its area in view rock.
    """
    found = rocks.found_share >= found_share - 1e-9
    return {
        "count": len(found),
        "missed": int((~found).sum()),
        "found_share": found_share,
        "by_diameter_m": _binned(rocks.diameter_m, found, SIZE_EDGES_M),
        "by_range_m": _binned(rocks.range_m, found, RANGE_EDGES_M),
    }


def _binned(values: np.ndarray, found: np.ndarray, edges: Sequence[float]) -> list[dict[str, Any]]:
    rows = []
    for low, high in pairwise(edges):
        here = (values >= low) & ((values < high) | (high == np.inf))
        if here.any():
            upper = float(high) if np.isfinite(high) else None
            rows.append({"from": low, "to": upper, "count": int(here.sum()), "missed": int((here & ~found).sum())})
    return rows
