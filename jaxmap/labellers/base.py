"""What every labeller is: per-point features, and the labels that a few tunable numbers make of them."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple, Protocol

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree, Shaped

from jaxmap.fusion.bijectors import Bijector
from jaxmap.fusion.options import FusionRule
from jaxmap.geometry.cloud import PointCloud
from jaxmap.geometry.options import GroundOptions
from jaxmap.geometry.relief import to_pixels
from jaxmap.labellers.shares import Odds
from jaxmap.labels import IGNORE
from jaxmap.types import Frame, PointLabels

Needs = Literal["image", "labels", "class_probabilities", "logits"]
"""The fields of `Frame` that a labeller may ask for."""

Numbers = dict[str, Float[Array, ""]]
"""The tunable numbers of a labeller, by the names of its options."""


Pointwise = Callable[[Float[Array, "N D *w"]], tuple[Shaped[Array, "N *w"], ...]]
"""A function that treats points alike, from their features along axis 1."""


class FeatureMap(Protocol):
    """`PointFeatures.map`."""

    def __call__(
        self, function: Pointwise, more: Float[Array, "h w E"] | None = None
    ) -> tuple[Shaped[Array, "N"], ...]:
        """Applies the function."""
        ...


def dense_features(values: Shaped[Array, "N D"], image_px: Sequence[int]) -> FeatureMap:
    """The map of features that are held as an array, of the pixels of an image (height, width)."""

    def map_dense(function: Pointwise, more: Float[Array, "h w E"] | None = None) -> tuple[Array, ...]:
        if more is None:
            return function(values)
        return function(jnp.concatenate([values, to_pixels(more, image_px).reshape(len(values), -1)], axis=1))

    return map_dense


class PointFeatures(NamedTuple):
    """Per-point features of a frame: they stay as they are, however the tunable numbers change.

    Attributes:
        keep: points to fuse.
        map: applies a pointwise function to the features and gives its arrays (N,), which mean something at points in
            range. The features need never be held all at once. Further features, where they are given, follow the
            labeller's own: an image (h, w, E) of relief, whose pixels are `RELIEF_STRIDE` of the frame's wide.
        of_frame: a pytree of the whole frame.
        label: what `map` makes of the labeller's own `label` with these numbers, in one go; None where there is no such
            way. It takes odds that relief adds.
    """

    keep: Bool[Array, "N"]
    map: FeatureMap
    of_frame: PyTree = ()
    label: Callable[[Numbers, Odds | None], tuple[Float[Array, "N"], ...]] | None = None


class LabellerParams(NamedTuple):
    """The numbers that labelling depends on; every leaf is differentiable.

    `weights` are those of a network, `numbers` may be tuned. They are handed to the step, not compiled into it.
    """

    weights: PyTree = ()
    numbers: Numbers = {}  # noqa: RUF012


NO_NUMBERS = LabellerParams()


class Labeller(NamedTuple):
    """Pure functions that give each point of a frame its class, and what they need.

    Attributes:
        name: as on the command line, and the section of its options.
        classes: the classes of its labels, in their order; they become the map's.
        needs: the field of `Frame` that must be filled, or None.
        features: `(frame, cloud, params, key) -> PointFeatures`.
        label: `(values, estimate, numbers) -> arrays`, pointwise from features along axis 1: the probability of each
            class where `soft`, else one array of class indices (`IGNORE` where unknown).
        estimate: `(of_frame, numbers) -> estimate`, of the whole frame.
        keep: `(values, estimate) -> (bool,)`, pointwise: which points the labeller fuses; None for all.
        params: the first ones.
        bijectors: of each tunable number.
        soft: labels are probabilities, which the numbers change smoothly: they can be tuned.
        ground: where it asks for the relief of the cloud, the ground to measure it from.
        perceive: `(frame, cloud, params) -> logits`, where the labeller sees the image: all that its features take
            from there. What perceives and what fuses may be apart (`labellers.deeplab.make_logits_labeller`).
        draws: its labels depend on the key, and so on how many frames were fused before.
    """

    name: str
    classes: tuple[str, ...]
    needs: Needs | None
    features: Callable[[Frame, PointCloud, LabellerParams, PRNGKeyArray], PointFeatures]
    label: Callable[[Array, PyTree, Numbers], tuple[Array, ...]]
    estimate: Callable[[PyTree, Numbers], PyTree] = lambda of_frame, numbers: of_frame
    keep: Callable[[Array, PyTree], tuple[Array]] | None = None
    params: LabellerParams = NO_NUMBERS
    bijectors: Mapping[str, Bijector] = {}
    soft: bool = False
    ground: GroundOptions | None = None
    draws: bool = True
    perceive: Callable[[Frame, PointCloud, LabellerParams], Float[Array, "h w C"]] | None = None


def label_points(
    labeller: Labeller, frame: Frame, cloud: PointCloud, params: LabellerParams, key: PRNGKeyArray
) -> tuple[PointLabels, PyTree]:
    """Labels the points of a frame; also returns the labeller's estimate of the whole frame."""
    features = labeller.features(frame, cloud, params, key)
    estimate = labeller.estimate(features.of_frame, params.numbers)
    return labels_of(labeller, features, estimate, params.numbers), estimate


def labels_of(labeller: Labeller, features: PointFeatures, estimate: PyTree, numbers: Numbers) -> PointLabels:
    """The labels that the numbers make of a frame's features, and which of its points are fused."""
    choose, keep = labeller.keep, features.keep
    if choose is not None:
        keep = keep & features.map(lambda values: choose(values, estimate))[0]
    if features.label is not None:
        labels = features.label(numbers, None)
    else:
        labels = features.map(lambda values: labeller.label(values, estimate, numbers))
    if labeller.soft:
        # They are never stored side by side: each scatter reads its own one.
        return PointLabels(keep, probabilities=jnp.stack(labels, axis=-1))
    return PointLabels(keep, labels=labels[0])


def fusible(labels: PointLabels, classes: Sequence[str], rule: FusionRule) -> PointLabels:
    """The labels as a rule fuses them: hard where it asks for that, and without the points of classes it leaves out.

    A point is left out where one of these is likelier than all else, "no class" too: a rock's edge against the sky
    stays. To weigh points by what is not left out would not do: however little remains, a voxel would be occupied.
    """
    labels = harden(labels) if rule.hard_labels else labels
    left_out = rule.left_out(classes)
    if not left_out:
        return labels
    if labels.probabilities is None:
        assert labels.labels is not None
        out = functools.reduce(operator.or_, [labels.labels == index for index in left_out])
    else:
        # Class by class: XLA does not vectorise over a short last axis.
        shares = [labels.probabilities[:, index] for index in range(len(classes))]
        rest = 1.0 - functools.reduce(operator.add, shares)
        others = [share for index, share in enumerate(shares) if index not in left_out]
        greatest = functools.reduce(jnp.maximum, others, rest)
        out = functools.reduce(operator.or_, [shares[index] > greatest for index in left_out])
    return labels._replace(keep=labels.keep & ~out)


def make_no_labeller() -> Labeller:
    """Geometry alone: no class at all."""

    def features(frame: Frame, cloud: PointCloud, params: LabellerParams, key: Array) -> PointFeatures:
        return PointFeatures(cloud.in_range.reshape(-1), dense_features(cloud.points_world, cloud.depth_m.shape))

    def label(values: Array, estimate: Any, numbers: Numbers) -> tuple[Array]:
        return (jnp.full(values.shape[:1], IGNORE, jnp.int32),)

    return Labeller("none", (), None, features, label, draws=False)


def harden(labels: PointLabels) -> PointLabels:
    """Probabilities as labels, the likeliest class each; labels stay what they are.

    What the probabilities lack to 1 is that of no class: where it is the greatest, so is the label.
    """
    if labels.probabilities is None:
        return labels
    likeliest = labels.probabilities.argmax(axis=-1).astype(jnp.int32)
    known = labels.probabilities.max(axis=-1) >= 1.0 - labels.probabilities.sum(axis=-1)
    return PointLabels(keep=labels.keep, labels=jnp.where(known, likeliest, IGNORE))
