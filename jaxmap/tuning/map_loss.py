"""The score of a map as a loss: how far its cells are from the ground truth, differentiable in the evidence.

    loss = nll_weight * NLL + iou_weight * (1 - IoU) + driving_weight * driving cost

NLL is the mean negative log-likelihood of the labelled cells; the soft IoU counts how surely cells are called by the
class; the driving cost is that of a rover that trusts the map: a detour around each cell that is called rock, and for
each missed rock what it costs to drive over it. Cells, areas and truth are those that `jaxmap evaluate` scores
(`evaluation.cells`, `evaluation.truth_cells`).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64

from jaxmap.datasets.label_raster import LabelRaster
from jaxmap.errors import JaxmapError
from jaxmap.evaluation.cells import CellGrid, ColumnShares, area_in_cells, column_shares, make_cells
from jaxmap.evaluation.truth_cells import TruthCells, truth_cells
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams
from jaxmap.tuning.options import MapLossOptions
from jaxmap.tuning.soft_view import SoftColumns, soft_columns_of_map
from jaxmap.types import GridSpec, VoxelMap

_LEAST_PROBABILITY = 1e-6
_LEAST_AREA = 1e-6
_CALLED_SHARE = 0.5


class MapTruth(NamedTuple):
    """Ground truth in the cells of a grid.

    Attributes:
        shares: how the columns of the grid fall into cells.
        truly: 1 where the class covers at least half (`rock_fraction`) of a cell's labelled area, else 0.
        counted: cells that count: labelled, and of the part of the ground that is asked for.
    """

    shares: ColumnShares
    truly: Float[Array, "I J"]
    counted: Bool[Array, "I J"]


class SoftCells(NamedTuple):
    """What a map says of cells: `area` observed, probability of the class, and how surely the cell is called by it."""

    area: Float[Array, "I J"]
    probability: Float[Array, "I J"]
    called: Float[Array, "I J"]


class LossParts(NamedTuple):
    """A loss, part by part; `driving_m` is for each cell; `cells` is the number of cells that counted."""

    nll: Float[Array, ""]
    soft_iou: Float[Array, ""]
    driving_m: Float[Array, ""]
    cells: Float[Array, ""]


def make_map_truth(
    grid: GridSpec,
    raster: LabelRaster,
    site_origin: Float64[np.ndarray, "3"],
    crs: str | None,
    *,
    cell_size_m: float = 0.2,
    rock_fraction: float = _CALLED_SHARE,
) -> tuple[MapTruth, TruthCells, CellGrid]:
    """Brings ground truth to the cells that cover a grid.

    Args:
        grid: of the map.
        raster: the truth (`map_evaluation.read_truth`); its target is the class that is scored.
        site_origin: where the map's world has its origin in `crs`.
        crs: of the map's site, or None.
        cell_size_m: edge of a cell.
        rock_fraction: share of the labelled area from which on a cell is of the class.

    Returns:
        The arrays of the loss; and the truth and the cells they come from, on the host.

    Raises:
        JaxmapError: no cell of the grid is labelled.
    """
    cells = make_cells(grid, cell_size_m)
    truth = truth_cells(raster, cells, site_origin, crs)
    if not truth.labelled.any():
        raise JaxmapError(
            "no cell of the map is labelled", where=raster.name, fix="check that map and truth are of one site"
        )
    truly = jnp.asarray(truth.truly(rock_fraction), jnp.float32)
    return MapTruth(column_shares(grid, cells), truly, jnp.asarray(truth.labelled)), truth, cells


def soft_cells(
    columns: SoftColumns, shares: ColumnShares, prior: Float[Array, ""], options: MapLossOptions | None = None
) -> SoftCells:
    """Brings soft columns to cells by area, as `evaluation.cells.map_cells` does.

    Args:
        columns: one class of the top-down map.
        shares: how the columns fall into cells.
        prior: probability of the class where nothing was observed.
        options: `rock_fraction` and the softness of a cell's decision.
    """
    options = options or MapLossOptions()
    area, known, share = (
        area_in_cells(shares, values) / shares.columns_per_cell
        for values in (columns.seen, columns.seen * columns.probability, columns.seen * columns.called)
    )
    called = jax.nn.sigmoid((share - options.rock_fraction) / options.softness.cell)
    return SoftCells(area, known + (1.0 - area) * prior, called)


def cells_loss(said: SoftCells, truth: MapTruth, options: MapLossOptions) -> tuple[Float[Array, ""], LossParts]:
    """The loss of cells; 0 where none counts.

    Probabilities are drawn in by 1e-6 from 0 and 1: one certain mistake has a finite price, and a gradient.
    """
    counted = truth.counted.astype(said.probability.dtype)
    probability = _LEAST_PROBABILITY + (1.0 - 2.0 * _LEAST_PROBABILITY) * jnp.clip(said.probability, 0.0, 1.0)
    likelihood = truth.truly * options.class_weight * jnp.log(probability)
    likelihood = likelihood + (1.0 - truth.truly) * jnp.log1p(-probability)
    weight = counted * (1.0 + (options.class_weight - 1.0) * truth.truly)
    nll = -(counted * likelihood).sum() / jnp.maximum(weight.sum(), 1.0)
    both = (counted * said.called * truth.truly).sum()
    either = (counted * (said.called + truth.truly - said.called * truth.truly)).sum()
    # Where nothing is of the class and nothing is called so, the two agree.
    soft_iou = (both + _LEAST_PROBABILITY) / (either + _LEAST_PROBABILITY)
    paid_m = said.called * options.detour_m + (1.0 - said.called) * truth.truly * options.missed_rock_m
    driving_m = (counted * paid_m).sum() / jnp.maximum(counted.sum(), 1.0)
    loss = options.nll_weight * nll + options.iou_weight * (1.0 - soft_iou) + options.driving_weight * driving_m
    return loss, LossParts(nll, soft_iou, driving_m, counted.sum())


def map_loss(
    voxel_map: VoxelMap,
    params: FusionParams,
    rule: FusionRule,
    truth: MapTruth,
    target: int,
    options: MapLossOptions | None = None,
) -> tuple[Float[Array, ""], LossParts]:
    """The loss of a dense map against the truth; finite, and so are its gradients, whatever the map holds.

    Only cells count where the map observed some surface; which these are is taken as given.

    Args:
        voxel_map: the map.
        params: how its evidence is read.
        rule: see `params`.
        truth: ground truth in the cells of the map's grid.
        target: index of the class that is scored among the map's classes.
        options: the terms of the loss.
    """
    options = options or MapLossOptions()
    columns = soft_columns_of_map(voxel_map, params, rule, target, options.softness)
    said = soft_cells(columns, truth.shares, jax.nn.sigmoid(params.class_prior[target]), options)
    seen = jax.lax.stop_gradient(said.area) > _LEAST_AREA
    return cells_loss(said, truth._replace(counted=truth.counted & seen), options)
