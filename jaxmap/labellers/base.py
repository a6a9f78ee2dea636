"""Labellers: what gives every point of a frame its class. All have one signature."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from jaxmap.labels import IGNORE
from jaxmap.types import Frame, Plane, PointLabels

Needs = Literal["image", "labels", "class_probabilities"]
"""The fields of `Frame` that a labeller may ask for."""


class Cues(NamedTuple):
    """What a labeller's tuned numbers act on, point by point: computed once, however the numbers change.

    Attributes:
        keep: points to fuse.
        values: numbers of each point, smooth enough to be averaged over neighbouring pixels of one voxel.
        labels: class indices that no number changes, or None.
        shared: a pytree of the whole frame.
    """

    keep: Bool[Array, "N"]
    values: Float[Array, "N D"]
    labels: Int[Array, "N"] | None = None
    shared: PyTree = ()


class TunableLabels(NamedTuple):
    """A labeller in two parts, so that its numbers can be tuned without running it anew.

    Attributes:
        numbers: the numbers by name, as the settings name them, scalars.
        limits: the least and the greatest that each may become.
        cues: `(frame, points_world, valid, params, key) -> Cues`.
        probabilities: `(values (G, D), frame (G,), shared, numbers) -> (G, C)`, with `shared` stacked over frames and
            `frame` the index of each row's; not called where cues are labels.
    """

    numbers: dict[str, float]
    limits: dict[str, tuple[float, float]]
    cues: Callable[[Frame, Float[Array, "N 3"], Bool[Array, "N"], PyTree, PRNGKeyArray], Cues]
    probabilities: Callable[
        [Float[Array, "G D"], Int[Array, "G"], PyTree, dict[str, Float[Array, ""]]], Float[Array, "G C"]
    ]


class Labeller(NamedTuple):
    """A pure labelling function and what it needs.

    Attributes:
        name: as on the command line.
        classes: the classes of its labels, in their order; they become the map's.
        needs: the field of `Frame` that must be filled, or None.
        label: `(frame, points_world (N, 3), valid (N,), params, key) -> (PointLabels, Plane | None)`.
        params: the numbers that labelling depends on, a pytree whose leaves are differentiable; none
            for most. They are handed to the step (`MapperParams.labeller`), not compiled into it.
        tunable: the same labeller in two parts, for tuning.
    """

    name: str
    classes: tuple[str, ...]
    needs: Needs | None
    label: Callable[
        [Frame, Float[Array, "N 3"], Bool[Array, "N"], PyTree, PRNGKeyArray], tuple[PointLabels, Plane | None]
    ]
    params: PyTree = ()
    tunable: TunableLabels | None = None


def make_no_labeller() -> Labeller:
    """Geometry alone: no class at all."""

    def label(frame: Frame, points_world: Array, valid: Array, params: Any, key: Array) -> tuple[PointLabels, None]:
        return PointLabels(keep=valid, labels=jnp.full(valid.shape, IGNORE, jnp.int32)), None

    return Labeller("none", (), None, label)


def fixed_labels(label: Callable[..., tuple[PointLabels, Plane | None]]) -> TunableLabels:
    """A labeller without numbers to tune: what it says is all there is."""

    def cues(frame: Frame, points_world: Array, valid: Array, params: Any, key: Array) -> Cues:
        said, _ = label(frame, points_world, valid, params, key)
        if said.probabilities is None:
            return Cues(said.keep, jnp.zeros((valid.shape[0], 0)), labels=said.labels)
        return Cues(said.keep, said.probabilities)

    return TunableLabels({}, {}, cues, lambda values, frame, shared, numbers: values)


def harden(labels: PointLabels) -> PointLabels:
    """Probabilities as labels, the likeliest class each; labels stay what they are.

    What the probabilities lack to 1 is that of no class: where it is the greatest, so is the label.
    """
    if labels.probabilities is None:
        return labels
    likeliest = labels.probabilities.argmax(axis=-1).astype(jnp.int32)
    known = labels.probabilities.max(axis=-1) >= 1.0 - labels.probabilities.sum(axis=-1)
    return PointLabels(keep=labels.keep, labels=jnp.where(known, likeliest, IGNORE))
