"""The evidence of a sequence's frames, computed once: an epoch of tuning is then a gather and a scatter.

Disparities, the network and the projection do not depend on what is tuned. Of each frame only this is kept: the cues
of its points that fell into the grid (`labellers.Cues`), their depth and voxel, and which voxels it saw through. Points
of one frame that share a voxel and a block of pixels are kept as one, with their mean cue and depth and their number.
Only voxels that some frame hit are kept at all: the view from above shows no others.

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
from jaxmap.fusion.params import FusionParams, FusionRule
from jaxmap.fusion.sensor_model import frame_evidence, range_weight
from jaxmap.geometry.camera import disparity_to_points, transform_points
from jaxmap.geometry.grid import flat_voxel_index, view_window, whole_window, window_shape
from jaxmap.labellers.base import Labeller, TunableLabels, fixed_labels, harden
from jaxmap.mapping.step import MapperParams
from jaxmap.types import Frame, GridSpec, StereoCamera, VoxelMap, make_voxel_map

BLOCK_PX = 4
"""Points this near in the image, and in one voxel, are kept as one; 1 keeps every point."""


class EvidenceCache(NamedTuple):
    """The kept points G of F frames, in P pairs of frame and voxel, over V voxels.

    Attributes:
        values: mean cue of each kept point.
        labels: its class where no number changes it, or None; -1 for none.
        depth_m: mean depth.
        points: how many points it stands for.
        frame: index of its frame.
        pair: index of its frame and voxel.
        voxel_of_pair: index of each pair's voxel among the V.
        freed: how many frames saw through each voxel without a point in it.
        voxel: flat index of each voxel in the grid, row-major.
        shared: what the labeller keeps of whole frames, stacked.
    """

    values: Float[Array, "G D"]
    labels: Int[Array, "G"] | None
    depth_m: Float[Array, "G"]
    points: Float[Array, "G"]
    frame: Int[Array, "G"]
    pair: Int[Array, "G"]
    voxel_of_pair: Int[Array, "P"]
    freed: Float[Array, "V"]
    voxel: Int[Array, "V"]
    shared: PyTree


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
    labels: np.ndarray | None
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
    kept, shared = [], []
    for number, frame in enumerate(frames):
        seen = observe(frame, params, jax.random.fold_in(key, number))
        kept.append(_thinned(jax.tree.map(np.asarray, seen), frame.disparity_px.shape, block_px))
        shared.append(seen["shared"])
        if recipe.rule.carve:
            _count_freed(freed, np.asarray(seen["free"]), np.asarray(seen["start"]), recipe.grid.shape, kept[-1].voxel)
    if not sum(len(one.voxel) for one in kept):
        raise JaxmapError("no frame has a point in the grid", where="tuning", fix="check poses, bounds and range")
    return _joined(kept, shared, freed)


def tunable_labels(labeller: Labeller, rule: FusionRule) -> TunableLabels:
    """The labeller in two parts; where the rule counts hard labels, no number of it changes them smoothly."""
    if rule.per_frame == "once":
        return fixed_labels(lambda *inputs: (harden(labeller.label(*inputs)[0]), None))
    return labeller.tunable or fixed_labels(labeller.label)


def _observer(recipe: CacheRecipe) -> Any:
    """The compiled front of the mapper: where the points of a frame lie, and their cues."""
    low_m, high_m = recipe.depth_range_m
    size = window_shape(recipe.grid, recipe.camera, high_m)
    tunable = tunable_labels(recipe.labeller, recipe.rule)

    @jax.jit
    def observe(frame: Frame, params: MapperParams, key: PRNGKeyArray) -> dict[str, Any]:
        points_camera, valid = disparity_to_points(params.camera, frame.disparity_px)
        depth_m = points_camera[..., 2]
        in_range = valid & (depth_m >= low_m) & (depth_m <= high_m)
        points_world = transform_points(frame.T_world_camera, points_camera).reshape(-1, 3)
        cues = tunable.cues(frame, points_world, in_range.reshape(-1), params.labeller, key)
        window = view_window(recipe.grid, params.camera, frame.T_world_camera, high_m, size)
        free = None
        if recipe.rule.carve:
            pose = frame.T_world_camera
            free = carve(params.camera, pose, depth_m, valid, recipe.grid, params.fusion, recipe.depth_range_m, window)
        keep = cues.keep & jnp.isfinite(cues.values).all(axis=-1)
        return {
            "voxel": flat_voxel_index(recipe.grid, points_world, keep, whole_window(recipe.grid)),
            "voxels": jnp.asarray(int(np.prod(recipe.grid.shape))),
            "depth_m": depth_m.reshape(-1),
            "values": cues.values,
            "labels": cues.labels,
            "shared": cues.shared,
            "free": free,
            "start": window.start,
        }

    return observe


def _thinned(seen: dict[str, Any], shape: tuple[int, ...], block_px: int) -> _Kept:
    """The points of a frame that fell into the grid, those of one voxel, block and label as one."""
    inside = np.flatnonzero(seen["voxel"] < seen["voxels"])
    voxel, depth_m, values = (seen[name][inside] for name in ("voxel", "depth_m", "values"))
    labels = None if seen["labels"] is None else seen["labels"][inside]
    if block_px == 1:
        return _Kept(voxel, depth_m, np.ones(len(voxel), np.float32), labels, values)
    row, column = np.divmod(inside, shape[1])
    across = -(-shape[1] // block_px)
    block = (row // block_px).astype(np.int64) * across + column // block_px
    key = voxel.astype(np.int64) * (across * -(-shape[0] // block_px)) + block
    if labels is not None:
        key = key * 256 + (labels & 255)
    _, first, group, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)

    def mean(numbers: np.ndarray) -> np.ndarray:
        return (np.bincount(group, numbers, minlength=len(count)) / count).astype(np.float32)

    values = np.stack([mean(values[:, d]) for d in range(values.shape[1])], -1) if values.shape[1] else values[first]
    return _Kept(
        voxel[first], mean(depth_m), count.astype(np.float32), None if labels is None else labels[first], values
    )


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


def _joined(kept: list[_Kept], shared: list[PyTree], freed: np.ndarray) -> EvidenceCache:
    frame = np.repeat(np.arange(len(kept)), [len(one.voxel) for one in kept])
    voxel, of_point = np.unique(np.concatenate([one.voxel for one in kept]), return_inverse=True)
    pairs, pair = np.unique(frame.astype(np.int64) * len(voxel) + of_point, return_inverse=True)

    def together(name: str) -> Array:
        return jnp.asarray(np.concatenate([getattr(one, name) for one in kept]))

    return EvidenceCache(
        values=together("values"),
        labels=None if kept[0].labels is None else together("labels"),
        depth_m=together("depth_m"),
        points=together("points"),
        frame=jnp.asarray(frame, jnp.int32),
        pair=jnp.asarray(pair, jnp.int32),
        voxel_of_pair=jnp.asarray(pairs % len(voxel), jnp.int32),
        freed=jnp.asarray(freed[voxel], jnp.float32),
        voxel=jnp.asarray(voxel, jnp.int32),
        shared=jax.tree.map(lambda *leaves: jnp.stack(leaves), *shared),
    )


def fused_evidence(
    recipe: CacheRecipe, cache: EvidenceCache, fusion: FusionParams, numbers: dict[str, Float[Array, ""]]
) -> Float[Array, "K V"]:
    """The evidence of all frames in the cached voxels: what mapping them gives, differentiable in the parameters.

    Args:
        recipe: what the cache was made for.
        cache: of the frames.
        fusion: the sensor model.
        numbers: those of the labeller (`TunableLabels.numbers`).

    Returns:
        Occupancy, then one row for each class.
    """
    classes, pairs, rule = len(recipe.labeller.classes), cache.voxel_of_pair.shape[0], recipe.rule
    weights = cache.points
    if rule.range_weighting:
        weights = weights * range_weight(recipe.camera, recipe.grid, cache.depth_m, fusion)
    empty = jnp.zeros(pairs, weights.dtype)
    if cache.labels is not None:
        known = (cache.labels >= 0) & (cache.labels < classes)
        row = jnp.where(known, cache.labels, classes)
        counts = jnp.zeros((classes + 1) * pairs, weights.dtype).at[row * pairs + cache.pair].add(weights)
    else:
        soft = tunable_labels(recipe.labeller, recipe.rule).probabilities(
            cache.values, cache.frame, cache.shared, numbers
        )
        shares = [*(soft[:, index] for index in range(classes)), 1.0 - soft.sum(axis=-1)]
        # One flat scatter for each class is thrice as fast as scattering rows.
        counts = jnp.stack([empty.at[cache.pair].add(share * weights) for share in shares])
    evidence = frame_evidence(counts.reshape(classes + 1, pairs, 1, 1), None, fusion, rule).reshape(-1, pairs)
    nothing = jnp.zeros(cache.voxel.shape[0], evidence.dtype)
    log_odds = [nothing.at[cache.voxel_of_pair].add(channel) for channel in evidence]
    log_odds[0] = log_odds[0] + cache.freed * (fusion.occupancy_miss - fusion.occupancy_prior)
    return jnp.stack(log_odds)


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
