"""The loss of a traverse as a function of what is tuned, from its cached evidence and its ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float64, Int

from jaxmap.datasets.label_raster import LabelRaster
from jaxmap.errors import JaxmapError
from jaxmap.evaluation.cells import MapCells, column_shares, map_cells
from jaxmap.fusion.query import top_down
from jaxmap.tuning.cell_scores import ScoredCells
from jaxmap.tuning.evidence_cache import CacheRecipe, EvidenceCache, fused_evidence, map_of_cache
from jaxmap.tuning.map_loss import LossParts, MapTruth, SoftCells, cells_loss, make_map_truth, soft_cells
from jaxmap.tuning.options import MapLossOptions
from jaxmap.tuning.parametrisation import TunedParams
from jaxmap.tuning.soft_view import columns_of_list, soft_columns
from jaxmap.tuning.split import ground_groups, hold_out


class TraverseArrays(NamedTuple):
    """What a loss is computed from.

    `truth` counts cells that some frame hit and that are labelled; `held_out` are cells kept from tuning.
    """

    cache: EvidenceCache
    truth: MapTruth
    held_out: Bool[Array, "I J"]


@dataclass(frozen=True, eq=False)
class Traverse:
    """One traverse, ready to be tuned on.

    Attributes:
        name: for texts.
        recipe: what its cache was made for.
        arrays: what its loss is computed from.
        groups: rock or block of ground of each cell.
        rock_fraction: share from which on a cell is of the class.
    """

    name: str
    recipe: CacheRecipe
    arrays: TraverseArrays
    groups: Int[np.ndarray, "I J"]
    rock_fraction: float


def make_traverse(
    name: str,
    recipe: CacheRecipe,
    cache: EvidenceCache,
    raster: LabelRaster,
    site_origin: Float64[np.ndarray, "3"],
    crs: str | None,
    *,
    cell_size_m: float,
    rock_fraction: float,
    held_out_share: float,
    seed: int,
) -> Traverse:
    """Brings the truth to the cells of a traverse, and holds some of its ground out.

    Raises:
        JaxmapError: no cell that a frame hit is labelled.
    """
    truth, fine, cells = make_map_truth(
        recipe.grid, raster, site_origin, crs, cell_size_m=cell_size_m, rock_fraction=rock_fraction
    )
    hit = np.zeros(recipe.grid.shape[:2], np.float32)
    hit.reshape(-1)[np.asarray(cache.voxel) // recipe.grid.shape[2]] = 1.0
    observed = np.asarray(map_cells(hit > 0, hit, hit > 0, column_shares(recipe.grid, cells)).observed)
    counted = observed & fine.labelled
    if not counted.any():
        raise JaxmapError(
            f"no observed cell is labelled: {int(observed.sum())} cells were observed by {name}, "
            f"{int(fine.labelled.sum())} are labelled",
            where=raster.name,
            fix="check that both are of one site, and the coding of the labels",
        )
    groups = ground_groups(fine, cells)
    held_out = hold_out(groups, fine.truly(rock_fraction), counted, held_out_share, seed)
    truth = truth._replace(counted=jnp.asarray(counted))
    arrays = TraverseArrays(cache, truth, jnp.asarray(held_out))
    return Traverse(name, recipe, arrays, groups, rock_fraction)


def check_classes(traverses: list[Traverse], target: str) -> None:
    """Refuses ground on which nothing can be learnt, or nothing held out.

    Raises:
        JaxmapError: all cells that count, tuned or held out, are of the class or none is.
    """
    for part, wanted in (("to tune on", False), ("held out", True)):
        every = [one.arrays for one in traverses]
        here = [np.asarray(one.truth.counted & (one.held_out == wanted)) for one in every]
        cells = sum(int(mask.sum()) for mask in here)
        of_class = sum(int((np.asarray(one.truth.truly)[m] > 0).sum()) for one, m in zip(every, here, strict=True))
        if of_class in (0, cells):
            raise JaxmapError(
                f"of {cells} cells {part}, {of_class} are {target}: both kinds are needed",
                where="ground truth",
                fix="add a traverse, take more frames, or change --held-out-share or --seed",
            )


def traverse_losses(
    traverse: Traverse, params: TunedParams, target: int, options: MapLossOptions
) -> tuple[tuple[Array, LossParts], tuple[Array, LossParts]]:
    """The loss of the ground to tune on, and of the ground held out; each with its parts."""
    said = _said(traverse, params, target, options)
    truth, held = traverse.arrays.truth, traverse.arrays.held_out
    tuned, kept = (cells_loss(said, truth._replace(counted=truth.counted & mask), options) for mask in (~held, held))
    return tuned, kept


def _said(traverse: Traverse, params: TunedParams, target: int, options: MapLossOptions) -> SoftCells:
    recipe, cache = traverse.recipe, traverse.arrays.cache
    evidence = fused_evidence(recipe, cache, params.fusion, params.labeller)
    columns = soft_columns(
        evidence,
        jnp.ones(cache.voxel.shape[0], bool),
        columns_of_list(cache.voxel // recipe.grid.shape[2], recipe.grid.shape[:2]),
        params.fusion,
        recipe.rule,
        recipe.labeller.classes,
        target,
        options.softness,
    )
    prior = jax.nn.sigmoid(params.fusion.class_prior[target])
    return soft_cells(columns, traverse.arrays.truth.shares, prior, options)


def score_cells(traverse: Traverse, params: TunedParams, target: int) -> ScoredCells:
    """The cells that count as `jaxmap evaluate` reads them, with hard decisions, at given parameters.

    Cells that the parameters leave unobserved count, as not called: no numbers gain by refusing to look.
    """
    recipe = traverse.recipe
    evidence = _fused(recipe, traverse.arrays.cache, params.fusion, params.labeller)
    view = top_down(map_of_cache(recipe, traverse.arrays.cache, evidence), params.fusion, recipe.rule)
    prior = float(jax.nn.sigmoid(params.fusion.class_prior[target]))
    is_class = (view.label == target) & view.observed
    said: MapCells = map_cells(is_class, view.probability[target], view.observed, traverse.arrays.truth.shares, prior)
    counted = np.asarray(traverse.arrays.truth.counted)
    return ScoredCells(
        said.called(traverse.rock_fraction)[counted],
        np.asarray(said.probability)[counted],
        np.asarray(traverse.arrays.truth.truly)[counted] > 0,
        traverse.groups[counted],
    )


_fused = jax.jit(fused_evidence, static_argnums=0)
