"""The compiled training step whose truth is a map: the orthomosaic teaches the network, and no image is labelled.

A step maps the crops of a batch into an empty map, one after the other, and takes the gradient of the map's loss. Then
every crop is labelled and fused anew, and pulls that gradient back through fusion and network into the weights (see
`pull_back`): the memory is that of one crop, however many make a map.

An orthomosaic shows some classes (sand, rock) and never others (the background of the images). Of these the first
network is the only witness, so the network is held to what it said at first: see `anchor_loss`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams
from jaxmap.labellers.files import make_files_labeller
from jaxmap.labels import IGNORE
from jaxmap.mapping.step import MapperParams, make_mapper
from jaxmap.models.architecture import Architecture
from jaxmap.models.network import Weights, training_form
from jaxmap.models.resizing import resize_bilinear
from jaxmap.training.options import TrainingOptions
from jaxmap.training.step import StepMetrics, TrainState, make_updater, parted
from jaxmap.tuning.frame_crops import FrameBatch, crop_frame, points_per_pixel, widest_camera
from jaxmap.tuning.map_loss import MapTruth, cells_loss, soft_cells
from jaxmap.tuning.options import MapLossOptions
from jaxmap.tuning.pull_back import frame_evidence
from jaxmap.tuning.soft_view import soft_columns_of_map
from jaxmap.types import Frame, GridSpec, StereoCamera, VoxelMap

SHOWN = IGNORE - 1
"""The anchor of a pixel that shows some class which the orthomosaic shows, too: its map says which."""

_LEAST_AREA = 0.5
"""Share of a cell that a step's map must have seen."""


class MapSupervision(NamedTuple):
    """How maps are made of crops and compared with ground truth.

    Attributes:
        camera: of the rectified frames.
        grid: of the maps.
        depth_range_m: points nearer or farther are left out.
        params: the increments of fusion and how a map is read.
        rule: see `params`.
        truths: the ground truth of each class that it shows, by the index of the class.
        losses: the loss terms of each of these classes; their mean is minimised.
        anchor: weight of the anchor loss beside it.
        temperature: divides the logits before their softmax is fused. Evidence is linear in probabilities, so that a
            confidently wrong pixel has next to no gradient, unlike its cross-entropy; softened, it learns.
    """

    camera: StereoCamera
    grid: GridSpec
    depth_range_m: tuple[float, float]
    params: FusionParams
    rule: FusionRule
    truths: Mapping[int, MapTruth]
    losses: Mapping[int, MapLossOptions]
    anchor: float = 1.0
    temperature: float = 3.0


class PulledBackGradient(NamedTuple):
    """The loss of a step, the accuracy of its map over cells, and the gradient of the trainable weights."""

    loss: Float[Array, ""]
    accuracy: Float[Array, ""]
    gradient: Weights


class MapTrainer(NamedTuple):
    """The pure functions of training by maps.

    Attributes:
        init: `(weights) -> TrainState`.
        step: `(state, batch, key) -> (state, StepMetrics)`, compiled once; the state passed in is donated. The key is
            the run's.
        loss: `(weights, batch, key) -> (loss, accuracy)`: what the step minimises.
        pull_back: `(weights, batch, key) -> PulledBackGradient`: the same with its gradient, as the step takes it.
    """

    init: Callable[[Weights], TrainState]
    step: Callable[[TrainState, FrameBatch, PRNGKeyArray], tuple[TrainState, StepMetrics]]
    loss: Callable[[Weights, FrameBatch, PRNGKeyArray], tuple[Array, Array]]
    pull_back: Callable[[Weights, FrameBatch, PRNGKeyArray], PulledBackGradient]


class _Labelled(NamedTuple):
    """A crop with the network's labels, ready to be fused, and how far they are from its anchors."""

    frame: Frame
    params: MapperParams
    held: Array


def make_map_trainer(
    architecture: Architecture, options: TrainingOptions, supervision: MapSupervision, *, steps: int
) -> MapTrainer:
    """Builds the functions of a training run by maps.

    Args:
        architecture: the network; its batch norms keep their statistics, and its classes are the map's.
        options: the recipe; its losses are of no account.
        supervision: the maps and their losses.
        steps: of the whole run, for the schedule.
    """
    network = training_form(architecture, ())
    updater = make_updater(options, steps)
    widest = widest_camera(supervision.camera, options.augmentation)
    labeller = make_files_labeller(architecture.classes, soft=True)
    mapper = make_mapper(widest, supervision.grid, labeller, supervision.rule, supervision.depth_range_m)
    fill = tuple(255 * value for value in architecture.mean)
    shown = np.array([index in supervision.truths for index in range(len(architecture.classes))])
    # Labels are given: nothing in fusion is random.
    map_key = jax.random.key(0)

    def label(weights: Weights, example: FrameBatch, key: Array) -> _Labelled:
        own_key = jax.random.fold_in(jax.random.fold_in(key, example.draws[0]), example.draws[1])
        view_key, dropout_key = jax.random.split(own_key)
        crop = jax.lax.optimization_barrier(
            crop_frame(view_key, example, supervision.camera, options.augmentation, fill)
        )
        logits = network(weights, crop.image[None], dropout_key)[0][0]
        fine = logits
        if points_per_pixel(options.augmentation) > 1:
            fine = resize_bilinear(logits[None], *crop.disparity_px.shape, align_corners=False)[0]
        frame = Frame(
            crop.disparity_px, crop.T_world_camera, class_probabilities=jax.nn.softmax(fine / supervision.temperature)
        )
        return _Labelled(frame, MapperParams(crop.camera, supervision.params), anchor_loss(logits, crop.anchors, shown))

    def map_of(weights: Weights, batch: FrameBatch, key: Array) -> tuple[VoxelMap, Array]:
        def add(voxel_map: VoxelMap, example: FrameBatch) -> tuple[VoxelMap, Array]:
            labelled = label(weights, example, key)
            return mapper.fuse(voxel_map, labelled.frame, labelled.params, map_key)[0], labelled.held

        voxel_map, held = jax.lax.scan(add, mapper.init(), batch)
        return voxel_map, held.mean()

    def loss(weights: Weights, batch: FrameBatch, key: Array) -> tuple[Array, Array]:
        voxel_map, held = map_of(weights, batch, key)
        value, accuracy = supervised_loss(voxel_map, supervision)
        return value + supervision.anchor * held, accuracy

    def pull_back(weights: Weights, batch: FrameBatch, key: Array) -> PulledBackGradient:
        moved, fixed = parted(weights, options)
        with jax.named_scope("map"):
            voxel_map, held = map_of(weights, batch, key)
        with jax.named_scope("map_loss"):
            (value, accuracy), cotangent = jax.value_and_grad(
                lambda log_odds: supervised_loss(replace(voxel_map, log_odds=log_odds), supervision), has_aux=True
            )(voxel_map.log_odds)

        def pull(gradient: Weights, example: FrameBatch) -> tuple[Weights, None]:
            def evidence(moved: Weights) -> tuple[Array, Array]:
                labelled = label({**fixed, **moved}, example, key)
                return frame_evidence(mapper, labelled.frame, labelled.params, map_key, 0), labelled.held

            _, back = jax.vjp(evidence, moved)
            own = back((cotangent, jnp.asarray(supervision.anchor / len(batch.draws), cotangent.dtype)))[0]
            return jax.tree.map(jnp.add, gradient, own), None

        with jax.named_scope("pull_back"):
            gradient, _ = jax.lax.scan(pull, jax.tree.map(jnp.zeros_like, moved), batch)
        return PulledBackGradient(value + supervision.anchor * held, accuracy, gradient)

    def step(state: TrainState, batch: FrameBatch, key: PRNGKeyArray) -> tuple[TrainState, StepMetrics]:
        pulled = pull_back(state.weights, batch, key)
        return updater.update(state, pulled.loss, pulled.accuracy, pulled.gradient, {})

    return MapTrainer(updater.init, jax.jit(step, donate_argnums=0), loss, pull_back)


def supervised_loss(voxel_map: VoxelMap, supervision: MapSupervision) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """The loss of a map, and the share of its observed, labelled cells that are called rightly; means over classes."""
    numbers = [_class_loss(voxel_map, supervision, target) for target in supervision.truths]
    loss, accuracy = (jnp.stack(values).mean() for values in zip(*numbers, strict=True))
    return loss, accuracy


def _class_loss(voxel_map: VoxelMap, supervision: MapSupervision, target: int) -> tuple[Array, Array]:
    truth, options = supervision.truths[target], supervision.losses[target]
    columns = soft_columns_of_map(voxel_map, supervision.params, supervision.rule, target, options.softness)
    said = soft_cells(columns, truth.shares, jnp.zeros(()), options)
    # The few crops of a step see many cells in part only. What the map says of the seen part counts, and not what it
    # would say of the rest, which no label can change.
    said = said._replace(probability=said.probability / jnp.maximum(said.area, _LEAST_AREA))
    counted = truth.counted & (jax.lax.stop_gradient(said.area) > _LEAST_AREA)
    loss, parts = cells_loss(said, truth._replace(counted=counted), options)
    right = counted & ((said.called > 0.5) == (truth.truly > 0.5))
    return loss, right.sum() / jnp.maximum(parts.cells, 1)


def anchor_loss(logits: Float[Array, "h w C"], anchors: UInt8[Array, "h w"], shown: np.ndarray) -> Float[Array, ""]:
    """Mean negative log-likelihood of what pixels are held to: a class that no orthomosaic shows, or any that it does.

    Args:
        logits: of the network.
        anchors: the index of a class that is never shown; `SHOWN`; or `IGNORE`, which counts nothing.
        shown: which classes the orthomosaic shows, bool (C,).
    """
    likelihood = jax.nn.log_softmax(logits)
    grouped = jax.nn.logsumexp(likelihood[..., shown], axis=-1)
    value = jnp.where(anchors == SHOWN, grouped, 0.0)
    for index in np.flatnonzero(~shown):
        value = jnp.where(anchors == index, likelihood[..., index], value)
    return -value.sum() / jnp.maximum((anchors != IGNORE).sum(), 1)
