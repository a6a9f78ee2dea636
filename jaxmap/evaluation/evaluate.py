"""A map scored against ground truth, from arrays: cells, domain, registration, scores and rocks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from jaxmap.datasets.crs import Extent
from jaxmap.datasets.label_raster import LabelRaster
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.evaluation.cells import CellGrid, MapCells, area_in_cells, column_shares, make_cells, map_cells
from jaxmap.evaluation.map_scores import confusion_scores, count_confusion, score_cells
from jaxmap.evaluation.ranking import ranking_scores, reliability
from jaxmap.evaluation.registration import register, soft_iou
from jaxmap.evaluation.rocks import find_rocks, rock_table
from jaxmap.evaluation.truth_cells import Alignment, TruthCells, truth_cells
from jaxmap.evaluation.views import Views, ground_height, view_range
from jaxmap.geometry.grid import exact_corner
from jaxmap.types import GridSpec

_MARGIN_M = 2.0
_SEARCH_SAMPLES = 8


@dataclass(frozen=True, eq=False)
class ClassMap:
    """A map seen from above, and one class of it; columns of voxels, x first.

    Attributes:
        grid: of the map.
        is_class: the column is labelled with the class.
        probability: of the class.
        observed: a surface was observed in the column.
        height_m: of that surface, world.
        prior: probability of the class where nothing was observed.
        ensemble: probability of the class by an ensemble, NaN where nothing was observed; None without one.
        site_origin: where the world's origin lies in `crs`.
        crs: the coordinate reference system, or None.
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
        origin_m, voxel_m = exact_corner(self.grid)
        low = np.asarray(self.site_origin, np.float64)[:2] + origin_m[:2]
        high = low + voxel_m[:2] * self.grid.shape[:2]
        return Extent(float(low[0]), float(low[1]), float(high[0]), float(high[1]), self.crs)


@dataclass(frozen=True)
class ScoringOptions:
    """How a map is scored.

    Attributes:
        cell_size_m: edge of a cell.
        rock_fraction: a cell is of the class where it covers at least this share of its labelled area in the truth,
            and is called so where columns of the class cover at least this share of its area in the map.
        max_range_m: only cells that a camera looked at from so near count; by default all that were observed.
        register: move the truth to where it fits best first.
        found_share: a rock is found where this share of its area lies in cells called rock.
    """

    cell_size_m: float = 0.2
    rock_fraction: float = 0.5
    max_range_m: float | None = None
    register: bool = False
    found_share: float = 0.5

    def __post_init__(self) -> None:
        """Refuses what makes no sense."""
        for name, low, high in (
            ("cell_size_m", 0.0, np.inf),
            ("rock_fraction", 0.0, 1.0),
            ("found_share", 0.0, 1.0),
            ("max_range_m", 0.0, np.inf),
        ):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and low < value <= high):
                bound = f" and at most {high:g}" if np.isfinite(high) else ""
                raise UsageError(f"{name} is {value}", where="scoring", fix=f"give a number above 0{bound}")


class Evaluation(NamedTuple):
    """Scores, and the cells they were counted in (the part of the map that was looked at).

    `scores` is plain values (DESIGN: Scores JSON). `counted` cells were observed and are labelled (and lie in range);
    `domain` cells are labelled and were looked at, observed or not; `called` and `truly` are what the map and the
    truth say of the class.
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
    class_map: ClassMap,
    raster: LabelRaster,
    views: Views | None = None,
    options: ScoringOptions | None = None,
) -> Evaluation:
    """Scores one class of a map.

    Args:
        class_map: the map.
        raster: the truth.
        views: the cameras that made the map; without them every labelled cell of the map's box is in view.
        options: how.

    Raises:
        JaxmapError: no observed cell is labelled, a range is asked for without views, or cells that are none.
    """
    options = options or ScoringOptions()
    if options.max_range_m is not None and views is None:
        raise JaxmapError("a range needs the poses and the camera of the map", where="max_range_m", fix="give views")
    ground = _ground_cells(class_map, make_cells(class_map.grid, options.cell_size_m))
    view_range_m = options.max_range_m or (views.max_range_m if views else np.inf)
    range_m = np.full(ground.cells.shape, np.inf)
    in_view = np.ones(ground.cells.shape, bool)
    if views is not None:
        range_m = view_range(ground.cells, ground.height_m, views, view_range_m)
        in_view = np.isfinite(range_m)
    here, cells = _around(ground.cells, in_view | np.asarray(ground.said.observed))
    said = MapCells(*(np.asarray(leaf)[here] for leaf in ground.said))
    observed, range_m, in_view = np.asarray(said.observed), range_m[here], in_view[here]
    asked = observed & (in_view if options.max_range_m is not None else True)

    called = said.called(options.rock_fraction)
    before, alignment = _placed(class_map, raster, cells), Alignment()
    truth = before
    if options.register:
        alignment = _best_alignment(class_map, raster, cells, said, asked, options.rock_fraction)
        truth = _placed(class_map, raster, cells, alignment)
    counted, domain = asked & truth.labelled, in_view & truth.labelled
    if not counted.any():
        raise _nothing_counted(int(asked.sum()), int(truth.labelled.sum()), options.max_range_m, raster.name)
    truly = truth.truly(options.rock_fraction)
    scores = _scores(said, called, truly, counted, domain) | {
        "cells": int(counted.sum()),
        "rock_cells": int((truly & counted).sum()),
        "frames": None if views is None else len(views.T_world_camera),
        "rocks": rock_table(find_rocks(truth, cells.size_m, called, domain, range_m), options.found_share),
        "cell_size_m": options.cell_size_m,
        "rock_fraction": options.rock_fraction,
        "max_range_m": options.max_range_m,
        "view_range_m": None if np.isinf(view_range_m) else float(view_range_m),
    }
    if class_map.ensemble is not None:
        missing = counted & ~called
        expected = _ensemble_cells(class_map, class_map.ensemble, options.cell_size_m)[here]
        scores["ensemble"] = missed_scores(expected[missing], np.asarray(said.share)[missing], truly[missing])
    if options.register:
        unmoved = before.truly(options.rock_fraction)
        scores["registration"] = _told(alignment) | {
            "before": _scores(said, called, unmoved, asked & before.labelled, in_view & before.labelled)
        }
    return Evaluation(scores, cells, observed, called, truly, counted, domain, truth, alignment)


def missed_scores(
    expected: Float[np.ndarray, "N"], share: Float[np.ndarray, "N"], truly: Bool[np.ndarray, "N"]
) -> dict[str, Any]:
    """How well an ensemble tells missed cells among those that the map does not call by the class.

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


def _ensemble_cells(
    class_map: ClassMap, probability: Float[np.ndarray, "X Y"], cell_size_m: float
) -> Float[np.ndarray, "I J"]:
    """The expected share of each cell that is of the class, by the ensemble; what was not observed is not."""
    shares = column_shares(class_map.grid, make_cells(class_map.grid, cell_size_m))
    columns = np.where(class_map.observed, probability, 0.0).astype(np.float32)
    # The sums of areas such as 0.2 / 3 are not exact.
    return (np.asarray(area_in_cells(shares, columns)) / shares.columns_per_cell).clip(0, 1)


def _nothing_counted(asked: int, labelled: int, max_range_m: float | None, where: str) -> JaxmapError:
    within = "" if max_range_m is None else f" within {max_range_m:g} m"
    return JaxmapError(
        f"no observed cell is labelled: {asked} cells were observed{within}, {labelled} are labelled",
        where=where,
        fix="check that both are of one site, and the coding of the labels",
    )


def _told(alignment: Alignment) -> dict[str, Any]:
    return {
        "shift_east_m": alignment.shift_m[0],
        "shift_north_m": alignment.shift_m[1],
        "heading_deg": float(np.rad2deg(alignment.heading_rad)),
        "pivot_m": list(alignment.pivot_m),
    }


class _Ground(NamedTuple):
    """A map in cells: what it says, and the ground under each."""

    cells: CellGrid
    said: MapCells
    height_m: np.ndarray


def _ground_cells(class_map: ClassMap, cells: CellGrid) -> _Ground:
    shares = column_shares(class_map.grid, cells)
    said = map_cells(class_map.is_class, class_map.probability, class_map.observed, shares, class_map.prior)
    heights = np.where(class_map.observed, np.nan_to_num(class_map.height_m), 0.0).astype(np.float32)
    area = np.asarray(area_in_cells(shares, class_map.observed.astype(np.float32)))
    mean = np.asarray(area_in_cells(shares, heights)) / np.where(area > 0, area, 1.0)
    return _Ground(cells, said, ground_height(mean, np.asarray(said.observed), (cells.size_m, cells.size_m)))


def _around(cells: CellGrid, wanted: np.ndarray) -> tuple[tuple[slice, slice], CellGrid]:
    """The part of the cells that holds the wanted ones, with a margin that keeps rocks whole."""
    if not wanted.any():
        return (slice(None), slice(None)), cells
    margin = int(np.ceil(_MARGIN_M / cells.size_m))
    first, last = np.argwhere(wanted).min(axis=0) - margin, np.argwhere(wanted).max(axis=0) + margin + 1
    first, last = first.clip(min=0), np.minimum(last, cells.shape)
    origin_m = np.asarray(cells.origin_m) + first * cells.size_m
    size = last - first
    part = CellGrid((float(origin_m[0]), float(origin_m[1])), cells.size_m, (int(size[0]), int(size[1])))
    return (slice(int(first[0]), int(last[0])), slice(int(first[1]), int(last[1]))), part


def _scores(
    said: MapCells, called: np.ndarray, truly: np.ndarray, counted: np.ndarray, domain: np.ndarray
) -> dict[str, Any]:
    """The scores over the counted cells, and `in_view` over the domain; coverage is that of the domain in both."""
    probability, observed = np.asarray(said.probability), np.asarray(said.observed)
    in_view = score_cells(called, probability, truly, domain, observed)
    over_counted = score_cells(called, probability, truly, counted, observed)
    return over_counted | {"coverage": in_view["coverage"], "in_view": in_view}


def _placed(
    class_map: ClassMap,
    raster: LabelRaster,
    cells: CellGrid,
    alignment: Alignment | None = None,
    per_cell: int | None = None,
) -> TruthCells:
    return truth_cells(raster, cells, class_map.site_origin, class_map.crs, alignment=alignment, per_cell=per_cell)


def _best_alignment(
    class_map: ClassMap, raster: LabelRaster, cells: CellGrid, said: MapCells, asked: np.ndarray, fraction: float
) -> Alignment:
    """The motion at which IoU and its smooth sister are greatest together; none where the IoU does not gain."""
    x, y = cells.centres()
    seen = np.argwhere(asked)
    middle = seen.mean(axis=0).round().astype(int) if len(seen) else np.zeros(2, int)
    pivot_m = (float(x[middle[0]]), float(y[middle[1]]))
    called, share = said.called(fraction), np.asarray(said.share)

    def iou(truth: TruthCells) -> float:
        return confusion_scores(count_confusion(called, truth.truly(fraction), asked & truth.labelled))["iou"] or 0.0

    def overlap(alignment: Alignment) -> float:
        moved = _placed(class_map, raster, cells, alignment, _SEARCH_SAMPLES)
        return iou(moved) + soft_iou(share, moved.share, asked & moved.labelled)

    best, still = register(overlap, pivot_m), Alignment(pivot_m=pivot_m)
    # The search samples the truth coarsely: what counts is the score itself.
    gains = iou(_placed(class_map, raster, cells, best)) > iou(_placed(class_map, raster, cells, still))
    return best if gains else still
