"""The evidence of a frame as a smooth function of how its images are matched, and the gradient of a map's score.

Which voxel a point falls into, as `mapping.step` decides it, is flat: disparity may move within a voxel and nothing
changes. So points are shared out among the nearest voxels (`fusion.splat`), and disparity has gradients by three ways:
where points lie, what class their heights give them, and how much they count, which is their confidence. With the
weights alone a penalty that smooths sand would gain nothing: its worth lies in heights. What a frame decides as a whole
(a plane, which voxels were seen through, the checks of the matcher) is taken as given at every step.

Disparity changes with every step, so nothing can be cached, as `tuning.evidence_cache` does. The gradient is pulled
back frame by frame (see `tuning.pull_back`): each frame is matched twice, and the memory is that of one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxmap.fusion.carve import carve
from jaxmap.fusion.integrate import add_evidence
from jaxmap.fusion.params import FusionParams
from jaxmap.fusion.sensor_model import frame_evidence, point_weights, total_weight
from jaxmap.fusion.splat import splat_trilinear
from jaxmap.geometry.cloud import project
from jaxmap.geometry.grid import view_window
from jaxmap.labellers.base import fusible, labels_of
from jaxmap.mapping.step import Mapper, MapperParams, StepDesign
from jaxmap.matching.design import MatchParams
from jaxmap.matching.soft import soft_match
from jaxmap.tuning.map_loss import cells_loss, soft_cells
from jaxmap.tuning.options import MapLossOptions
from jaxmap.tuning.small_frames import SmallPair, at_full_size
from jaxmap.tuning.soft_view import columns_of_grid, soft_columns
from jaxmap.tuning.traverse_loss import Traverse
from jaxmap.types import Frame, GridSpec, PointLabels

Losses = tuple[Float[Array, ""], Float[Array, ""]]
"""Of the ground that is tuned on, and of what is held out."""


@dataclass(frozen=True, eq=False)
class StereoTraverse:
    """A traverse whose frames are matched anew at every step.

    Attributes:
        scored: the cells that count, and how they are scored.
        mapper: its design matches the small pairs softly; all else is of the full size.
        frames: with a pair of images for each, smaller than they are (`tuning.small_frames`).
        params: all numbers, those of matching at their start.
        key: that of the map.
        times: how many times smaller the pairs are.
    """

    scored: Traverse
    mapper: Mapper
    frames: list[tuple[Frame, SmallPair]]
    params: MapperParams
    key: PRNGKeyArray
    times: int


class StereoGradient(NamedTuple):
    """The loss of a traverse, and its gradient where that is wanted.

    Attributes:
        losses: `(match) -> (losses, cotangent)`: the losses, and the gradient of the first in the map's evidence.
        pull: `(match, cotangent) -> gradient`: that pulled back to the matcher, which takes about four times as long.
        lower: `pull` of one frame, for its memory.
    """

    losses: Callable[[MatchParams], tuple[Losses, Array]]
    pull: Callable[[MatchParams, Array], MatchParams]
    lower: Callable[[], jax.stages.Lowered]

    def of(self, match: MatchParams) -> tuple[Losses, MatchParams]:
        """The losses, and the gradient of the first."""
        losses, cotangent = self.losses(match)
        return losses, self.pull(match, cotangent)


def soft_evidence(
    design: StepDesign,
    grid: GridSpec,
    frame: Frame,
    pair: SmallPair,
    params: MapperParams,
    frame_key: PRNGKeyArray,
    times: int = 1,
) -> tuple[Float[Array, "C1 X Y Z"], GridSpec]:
    """What a frame says of the voxels of its window; differentiable in `params.match`.

    It is what the step makes of the frame (`mapping.step.see_frame`), but for soft matching and shared-out points.

    Args:
        design: of the step; its matching is soft, and that of the pair.
        grid: of the map.
        frame: its disparity is left aside.
        pair: its images.
        params: the numbers.
        frame_key: of the frame.
        times: how many times smaller the pair is.
    """
    assert design.match is not None and params.match is not None
    labeller, rule, depth_range_m = design.labeller, design.rule, design.depth_range_m
    camera, pose, fusion = params.camera, frame.T_world_camera, params.fusion
    shape = camera.height_px, camera.width_px
    matched = soft_match(design.match, *pair, params.match)
    disparity_px = times * at_full_size(matched.disparity_px, shape, times)
    confidence = jnp.nan_to_num(at_full_size(matched.confidence, shape, times))
    if frame.blind is not None:
        disparity_px = jnp.where(frame.blind, jnp.nan, disparity_px)
    cloud = project(camera, pose, disparity_px, depth_range_m, fusion.disparity_sigma_px, labeller.ground)

    features = labeller.features(frame, cloud, params.labeller, frame_key)
    numbers = params.labeller.numbers
    estimate = jax.lax.stop_gradient(labeller.estimate(features.of_frame, numbers))
    labels = fusible(labels_of(labeller, features, estimate, numbers), labeller.classes, rule)

    window = view_window(grid, camera, pose, depth_range_m[1], design.window_shape)
    free = None
    if rule.carve:
        depth_m, sure = jax.lax.stop_gradient((cloud.depth_m, cloud.valid & (confidence >= 0.5)))
        free = carve(camera, pose, depth_m, sure, window, fusion, depth_range_m)
    weights = point_weights(grid, cloud, rule) * confidence.reshape(-1)
    rows = _shares(labels, len(labeller.classes)) * weights
    counts = splat_trilinear(window, cloud.points_world, rows, labels.keep)
    evidence = frame_evidence(counts, None, fusion, rule)
    if free is not None:
        evidence = evidence.at[0].add(soft_misses(counts, free, fusion))
    return evidence, window


def soft_misses(
    counts: Float[Array, "C1 X Y Z"], free: Bool[Array, "X Y Z"], fusion: FusionParams
) -> Float[Array, "X Y Z"]:
    """What a frame takes from the occupancy of voxels that it saw through; less, the more of a point lies in them.

    A whole point keeps a voxel from being free, as in `fusion.sensor_model.frame_evidence`. If the least share of a
    point did so, too, the loss would jump wherever one comes near a voxel.
    """
    untouched = jnp.maximum(1.0 - total_weight(counts), 0.0)
    return jnp.where(free, untouched * (fusion.occupancy_miss - fusion.occupancy_prior), 0.0)


def soft_touch(log_odds: Float[Array, "K X Y Z"], width: float) -> Float[Array, "X Y Z"]:
    """How much voxels were touched, from 0 for those that hold nothing to 1.

    That a voxel was touched at all makes it solid by half (its occupancy is even), and shares of points touch many.

    Args:
        log_odds: of the map, occupancy first.
        width: log-odds of occupancy in which touch grows.
    """
    return -jnp.expm1(-jnp.abs(log_odds[0]) / width)


def _shares(labels: PointLabels, classes: int) -> Float[Array, "C1 N"]:
    """The probability of each class for each point, and of none."""
    if labels.probabilities is None:
        assert labels.labels is not None
        known = (labels.labels[None] == jnp.arange(classes)[:, None]).astype(jnp.float32)
    else:
        known = labels.probabilities.T
    return jnp.concatenate([known, 1.0 - known.sum(0, keepdims=True)])


def stereo_losses(
    log_odds: Float[Array, "K X Y Z"], traverse: StereoTraverse, target: int, options: MapLossOptions
) -> Losses:
    """The losses of the map of a traverse: of the ground tuned on, and of what is held out.

    A cell that was observed at the start counts, whatever is made of it later: no numbers gain by refusing to look.
    """
    fusion, rule, arrays = traverse.params.fusion, traverse.mapper.design.rule, traverse.scored.arrays
    touched = soft_touch(log_odds, options.softness.occupied)
    classes = traverse.mapper.design.labeller.classes
    columns = soft_columns(log_odds, touched, columns_of_grid(), fusion, rule, classes, target, options.softness)
    said = soft_cells(columns, arrays.truth.shares, jax.nn.sigmoid(fusion.class_prior[target]), options)
    counted = arrays.truth.counted
    tuned, held_out = (
        cells_loss(said, arrays.truth._replace(counted=counted & mask), options)[0]
        for mask in (~arrays.held_out, arrays.held_out)
    )
    return tuned, held_out


def make_stereo_gradient(traverse: StereoTraverse, target: int, options: MapLossOptions) -> StereoGradient:
    """Builds the gradient of the loss of a traverse; compiled once for all frames and steps.

    Args:
        traverse: its frames and its truth.
        target: index of the class that is scored.
        options: the terms of the loss.
    """
    design, key, times = traverse.mapper.design, traverse.key, traverse.times
    empty = traverse.mapper.init()

    def evidence(
        match: MatchParams, seen: tuple[Frame, SmallPair], number: Int[Array, ""] | int
    ) -> tuple[Array, GridSpec]:
        params = replace(traverse.params, match=match)
        return soft_evidence(design, empty.grid, *seen, params, jax.random.fold_in(key, number), times)

    def add(log_odds: Array, match: MatchParams, seen: tuple[Frame, SmallPair], number: Int[Array, ""] | int) -> Array:
        return add_evidence(replace(empty, log_odds=log_odds), *evidence(match, seen, number)).log_odds

    def score(log_odds: Array) -> tuple[Losses, Array]:
        return jax.value_and_grad(lambda log_odds: stereo_losses(log_odds, traverse, target, options), has_aux=True)(
            log_odds
        )

    def pull(
        gradient: MatchParams,
        cotangent: Array,
        match: MatchParams,
        seen: tuple[Frame, SmallPair],
        number: Int[Array, ""] | int,
    ) -> MatchParams:
        said, back, window = jax.vjp(lambda match: evidence(match, seen, number), match, has_aux=True)
        corner = (jnp.zeros((), jnp.int32), *(window.first - empty.grid.first))
        here = jax.lax.dynamic_slice(cotangent, corner, said.shape)
        return jax.tree.map(jnp.add, gradient, back(here)[0])

    add_one, pull_one = jax.jit(add, donate_argnums=0), jax.jit(pull, donate_argnums=0)
    score_map = jax.jit(score)

    def losses(match: MatchParams) -> tuple[Losses, Array]:
        log_odds = jnp.zeros_like(empty.log_odds)
        for number, seen in enumerate(traverse.frames):
            log_odds = add_one(log_odds, match, seen, number)
        return score_map(log_odds)

    def pull_all(match: MatchParams, cotangent: Array) -> MatchParams:
        gradient = jax.tree.map(jnp.zeros_like, match)
        for number, seen in enumerate(traverse.frames):
            gradient = pull_one(gradient, cotangent, match, seen, number)
        return gradient

    match = traverse.params.match
    assert match is not None
    return StereoGradient(losses, pull_all, lambda: pull_one.lower(match, empty.log_odds, match, traverse.frames[0], 0))
