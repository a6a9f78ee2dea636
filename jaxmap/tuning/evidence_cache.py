"""The evidence of a sequence's frames, computed once: an epoch of tuning is then a gather and a scatter.

Disparities, the network and the projection do not depend on what is tuned. Of each frame only this is kept: the
features of its points that fell into the grid (`labellers.base.PointFeatures`), their depth and voxel, and which voxels
it saw through. Points of one frame that share a voxel and a block of pixels are kept as one, with their mean features
and depth and their number. Where no number changes the labels smoothly, the features are the labels, a share for each
class. Only voxels that some frame hit are kept at all: the top-down map shows no others.

Which points fall into which voxel, and which voxels a frame saw through, is decided at the parameters that the cache is
made with: the margin of carving moves with `disparity_sigma_px` in a map, and does not here.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from jaxmap.errors import JaxmapError
from jaxmap.fusion.carve import carve
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams
from jaxmap.fusion.sensor_model import frame_evidence, range_weight
from jaxmap.geometry.camera import depth_sigma
from jaxmap.geometry.cloud import project
from jaxmap.geometry.grid import flat_voxel_index, view_window, window_shape
from jaxmap.labellers.base import Labeller, Numbers, fusible, harden, labels_of
from jaxmap.mapping.step import MapperParams
from jaxmap.tuning.options import BLOCK_PX
from jaxmap.types import Frame, GridSpec, StereoCamera, VoxelMap, make_voxel_map


class EvidenceCache(NamedTuple):
    """The kept points G of F frames, in P pairs of frame and voxel, over V voxels.

    Attributes:
        values: mean features of each kept point.
        depth_m: mean depth.
        points: how many points it stands for.
        frame: index of its frame.
        pair: index of its frame and voxel.
        voxel_of_pair: index of each pair's voxel among the V.
        freed: how many frames saw through each voxel without a point in it.
        voxel: flat index of each voxel in the grid, row-major.
        of_frame: features of whole frames, stacked.
    """

    values: Float[Array, "G D"]
    depth_m: Float[Array, "G"]
    points: Float[Array, "G"]
    frame: Int[Array, "G"]
    pair: Int[Array, "G"]
    voxel_of_pair: Int[Array, "P"]
    freed: Float[Array, "V"]
    voxel: Int[Array, "V"]
    of_frame: PyTree


@dataclass(frozen=True, eq=False)
class CacheRecipe:
    """What a cache is made for: the mapper's own camera, grid, labeller, rule and range of depth."""

    camera: StereoCamera
    grid: GridSpec
    labeller: Labeller
    rule: FusionRule
    depth_range_m: tuple[float, float]


class _Kept(NamedTuple):
    """The kept points of one frame, on the host."""

    voxel: np.ndarray
    depth_m: np.ndarray
    points: np.ndarray
    values: np.ndarray


def build_cache(
    recipe: CacheRecipe,
    frames: Iterable[Frame],
    params: MapperParams,
    key: PRNGKeyArray,
    *,
    block_px: int = BLOCK_PX,
) -> EvidenceCache:
    """Runs the frames through the front of the mapper and keeps what tuning needs.

    Args:
        recipe: what is mapped, and how.
        frames: in the order of the map.
        params: the numbers at which points are placed and space is carved.
        key: that of the map.
        block_px: see `BLOCK_PX`.

    Raises:
        JaxmapError: the labeller has no classes, or no frame has a point in the grid.
    """
    if not recipe.labeller.classes:
        raise JaxmapError("the labeller gives no classes", where="tuning", fix="choose another --labeller")
    observe = _observer(recipe)
    freed = np.zeros(int(np.prod(recipe.grid.shape)), np.int32)
    kept, of_frames = [], []
    for number, frame in enumerate(frames):
        seen = observe(frame, params, jax.random.fold_in(key, number))
        kept.append(_thinned(jax.tree.map(np.asarray, seen), frame.matched_px.shape, block_px))
        of_frames.append(seen["of_frame"])
        if recipe.rule.carve:
            _count_freed(freed, np.asarray(seen["free"]), np.asarray(seen["start"]), recipe.grid.shape, kept[-1].voxel)
    if not sum(len(one.voxel) for one in kept):
        raise JaxmapError("no frame has a point in the grid", where="tuning", fix="check poses, bounds and range")
    return _joined(kept, of_frames, freed)


def tunable_numbers(labeller: Labeller, rule: FusionRule) -> Numbers:
    """The numbers of the labeller that change its labels smoothly: none where labels, or the rule, are hard."""
    return labeller.params.numbers if _is_soft(labeller, rule) else {}


def _is_soft(labeller: Labeller, rule: FusionRule) -> bool:
    return labeller.soft and not rule.hard_labels


def _observer(recipe: CacheRecipe) -> Any:
    """The compiled front of the mapper: where the points of a frame lie, and their features."""
    max_depth_m = recipe.depth_range_m[1]
    size = window_shape(recipe.grid, recipe.camera, max_depth_m)
    labeller, classes = recipe.labeller, len(recipe.labeller.classes)

    @jax.jit
    def observe(frame: Frame, params: MapperParams, key: PRNGKeyArray) -> dict[str, Any]:
        pose, fusion = frame.T_world_camera, params.fusion
        cloud = project(
            params.camera,
            pose,
            frame.matched_px,
            recipe.depth_range_m,
            fusion.disparity_sigma_px,
            labeller.ground,
        )
        features = labeller.features(frame, cloud, params.labeller, key)
        estimate = labeller.estimate(features.of_frame, params.labeller.numbers)
        labels = labels_of(labeller, features, estimate, params.labeller.numbers)
        labels = fusible(labels, labeller.classes, recipe.rule)
        keep, of_frame = labels.keep, features.of_frame
        if _is_soft(labeller, recipe.rule):
            values = jnp.stack(features.map(lambda values: tuple(jnp.moveaxis(values, 1, 0))), axis=-1)
        else:
            hard = harden(labels).labels
            assert hard is not None
            values, of_frame = (hard[:, None] == jnp.arange(classes)).astype(jnp.float32), ()
        window = view_window(recipe.grid, params.camera, pose, max_depth_m, size)
        free = None
        if recipe.rule.carve:
            free = carve(params.camera, pose, cloud.depth_m, cloud.valid, window, fusion, recipe.depth_range_m)
        keep &= jnp.isfinite(values).all(axis=-1)
        return {
            "voxel": flat_voxel_index(recipe.grid, cloud.points_world, keep),
            "voxels": jnp.asarray(int(np.prod(recipe.grid.shape))),
            "depth_m": cloud.depth_m.reshape(-1),
            "values": values,
            "of_frame": of_frame,
            "free": free,
            "start": window.first - recipe.grid.first,
        }

    return observe


def _thinned(seen: dict[str, Any], shape: tuple[int, ...], block_px: int) -> _Kept:
    """The points of a frame that fell into the grid, those of one voxel and block as one."""
    inside = np.flatnonzero(seen["voxel"] < seen["voxels"])
    voxel, depth_m, values = (seen[name][inside] for name in ("voxel", "depth_m", "values"))
    if block_px == 1:
        return _Kept(voxel, depth_m, np.ones(len(voxel), np.float32), values)
    row, column = np.divmod(inside, shape[1])
    across = -(-shape[1] // block_px)
    block = (row // block_px).astype(np.int64) * across + column // block_px
    key = voxel.astype(np.int64) * (across * -(-shape[0] // block_px)) + block
    _, first, group, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)

    def mean(numbers: np.ndarray) -> np.ndarray:
        return (np.bincount(group, numbers, minlength=len(count)) / count).astype(np.float32)

    means = np.stack([mean(values[:, d]) for d in range(values.shape[1])], -1)
    return _Kept(voxel[first], mean(depth_m), count.astype(np.float32), means)


def _count_freed(
    freed: np.ndarray, free: np.ndarray, start: np.ndarray, shape: tuple[int, ...], hit: np.ndarray
) -> None:
    """Counts the voxels that a frame saw through and did not hit."""
    box = freed.reshape(shape)[tuple(slice(s, s + n) for s, n in zip(start.tolist(), free.shape, strict=True))]
    box += free
    hit = np.unique(hit)
    places = np.stack(np.unravel_index(hit, shape), -1) - start
    inside = ((places >= 0) & (places < free.shape)).all(axis=-1)
    freed[hit[inside]] -= free[tuple(places[inside].T)]


def _joined(kept: list[_Kept], of_frames: list[PyTree], freed: np.ndarray) -> EvidenceCache:
    frame = np.repeat(np.arange(len(kept)), [len(one.voxel) for one in kept])
    voxel, of_point = np.unique(np.concatenate([one.voxel for one in kept]), return_inverse=True)
    pairs, pair = np.unique(frame.astype(np.int64) * len(voxel) + of_point, return_inverse=True)

    def together(name: str) -> Array:
        return jnp.asarray(np.concatenate([getattr(one, name) for one in kept]))

    return EvidenceCache(
        values=together("values"),
        depth_m=together("depth_m"),
        points=together("points"),
        frame=jnp.asarray(frame, jnp.int32),
        pair=jnp.asarray(pair, jnp.int32),
        voxel_of_pair=jnp.asarray(pairs % len(voxel), jnp.int32),
        freed=jnp.asarray(freed[voxel], jnp.float32),
        voxel=jnp.asarray(voxel, jnp.int32),
        of_frame=jax.tree.map(lambda *leaves: jnp.stack(leaves), *of_frames),
    )


def fused_evidence(
    recipe: CacheRecipe, cache: EvidenceCache, fusion: FusionParams, numbers: Numbers
) -> Float[Array, "K V"]:
    """The evidence of all frames in the cached voxels: what mapping them gives, differentiable in the parameters.

    Args:
        recipe: what the cache was made for.
        cache: of the frames.
        fusion: the sensor model.
        numbers: those of the labeller (`tunable_numbers`).

    Returns:
        Occupancy, then one row for each class.
    """
    classes, pairs, rule = len(recipe.labeller.classes), cache.voxel_of_pair.shape[0], recipe.rule
    weights = cache.points
    if rule.range_weighting:
        sigma_m = depth_sigma(recipe.camera, cache.depth_m, fusion.disparity_sigma_px)
        weights = weights * range_weight(recipe.grid, sigma_m)
    empty = jnp.zeros(pairs, weights.dtype)
    soft = _cached_shares(recipe, cache, numbers)
    shares = [*(soft[:, index] for index in range(classes)), 1.0 - soft.sum(axis=-1)]
    # One flat scatter for each class is thrice as fast as scattering rows.
    counts = jnp.stack([empty.at[cache.pair].add(share * weights) for share in shares])
    evidence = frame_evidence(counts.reshape(classes + 1, pairs, 1, 1), None, fusion, rule).reshape(-1, pairs)
    nothing = jnp.zeros(cache.voxel.shape[0], evidence.dtype)
    log_odds = [nothing.at[cache.voxel_of_pair].add(channel) for channel in evidence]
    log_odds[0] = log_odds[0] + cache.freed * (fusion.occupancy_miss - fusion.occupancy_prior)
    return jnp.stack(log_odds)


def _cached_shares(recipe: CacheRecipe, cache: EvidenceCache, numbers: Numbers) -> Float[Array, "G C"]:
    """The probability of each class for each kept point."""
    labeller = recipe.labeller
    if not _is_soft(labeller, recipe.rule):
        return cache.values
    estimates: PyTree = ()
    if jax.tree.leaves(cache.of_frame):
        of_frames = jax.vmap(lambda of_frame: labeller.estimate(of_frame, numbers))(cache.of_frame)
        estimates = jax.tree.map(lambda leaf: leaf[cache.frame], of_frames)
    return jnp.stack(labeller.label(cache.values, estimates, numbers), axis=-1)


def map_of_cache(recipe: CacheRecipe, cache: EvidenceCache, log_odds: Float[Array, "K V"]) -> VoxelMap:
    """A dense map that holds the evidence of the cached voxels, and nothing elsewhere."""
    empty = make_voxel_map(recipe.grid, recipe.labeller.classes)
    flat = empty.log_odds.reshape(len(log_odds), -1)
    return VoxelMap(
        flat.at[:, cache.voxel].set(log_odds).reshape(empty.log_odds.shape),
        jnp.asarray(cache.frame.max() + 1),
        recipe.grid,
        recipe.labeller.classes,
    )
