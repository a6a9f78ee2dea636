"""Labellers: what gives every point of a frame its class. All have one signature."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from jaxmap.errors import JaxmapError
from jaxmap.geometry.plane import fit_plane_mlesac, plane_distance
from jaxmap.labels import IGNORE
from jaxmap.types import Frame, Plane, PointLabels

UP_WORLD = (0.0, 0.0, 1.0)

Needs = Literal["image", "labels", "class_probabilities"]
"""The fields of `Frame` that a labeller may ask for."""


class Labeller(NamedTuple):
    """A pure labelling function and what it needs.

    Attributes:
        name: as on the command line.
        classes: the classes of its labels, in their order; they become the map's.
        needs: the field of `Frame` that must be filled, or None.
        label: `(frame, points_world (N, 3), valid (N,), params, key) -> (PointLabels, Plane | None)`.
        params: the numbers that labelling depends on, a pytree whose leaves are differentiable; none
            for most. They are handed to the step (`MapperParams.labeller`), not compiled into it.
    """

    name: str
    classes: tuple[str, ...]
    needs: Needs | None
    label: Callable[
        [Frame, Float[Array, "N 3"], Bool[Array, "N"], PyTree, PRNGKeyArray], tuple[PointLabels, Plane | None]
    ]
    params: PyTree = ()


def make_no_labeller() -> Labeller:
    """Geometry alone: no class at all."""

    def label(frame: Frame, points_world: Array, valid: Array, params: Any, key: Array) -> tuple[PointLabels, None]:
        return PointLabels(keep=valid, labels=jnp.full(valid.shape, IGNORE, jnp.int32)), None

    return Labeller("none", (), None, label)


def make_plane_labeller(
    classes: Sequence[str],
    *,
    threshold_m: float = 0.1,
    max_height_m: float = 2.0,
    on_plane: str = "sand",
    off_plane: str = "rock",
    **fit: object,
) -> Labeller:
    """The paper's baseline: points off the principal plane are rock, points on it are sand.

    Args:
        classes: the map's classes, with `on_plane` and `off_plane` among them.
        threshold_m: distance from the plane, to either side, beyond which a point is off it.
        max_height_m: points farther from the plane are left out of the map.
        on_plane: class of the points on the plane.
        off_plane: class of the points off the plane.
        **fit: options of `fit_plane_mlesac`.

    Raises:
        JaxmapError: a class that is not among `classes`, or a threshold that is not positive.
    """
    for name in (on_plane, off_plane):
        if name not in classes:
            raise JaxmapError(f"the class {name!r} is not one of {list(classes)}", where="plane labeller")
    if not 0 < threshold_m < max_height_m:
        raise JaxmapError(
            f"threshold_m {threshold_m} and max_height_m {max_height_m}",
            where="plane labeller",
            fix="take 0 < threshold_m < max_height_m",
        )
    unknown = fit.keys() - inspect.signature(fit_plane_mlesac).parameters.keys()
    if unknown:
        raise JaxmapError(f"fit_plane_mlesac has no option {', '.join(sorted(unknown))}", where="plane labeller")
    sand, rock = classes.index(on_plane), classes.index(off_plane)

    def label(frame: Frame, points_world: Array, valid: Array, params: Any, key: Array) -> tuple[PointLabels, Plane]:
        plane = fit_plane_mlesac(key, points_world, valid, up_hint=jnp.array(UP_WORLD), **fit)  # type: ignore[arg-type]
        with jax.named_scope("plane_labels"):
            off = jnp.abs(plane_distance(plane, points_world))
            labels = jnp.where(off > threshold_m, rock, sand)
            # Without a plane nothing is known of any point but that it is there.
            labels = jnp.where(plane.found, labels, IGNORE)
            keep = valid & ((off <= max_height_m) | ~plane.found)
        return PointLabels(keep=keep, labels=labels), plane

    return Labeller("plane", tuple(classes), None, label)


def make_files_labeller(classes: Sequence[str], *, soft: bool) -> Labeller:
    """Labels made elsewhere, carried by the frame: class indices, or probabilities where `soft`."""

    def label(frame: Frame, points_world: Array, valid: Array, params: Any, key: Array) -> tuple[PointLabels, None]:
        if soft:
            assert frame.class_probabilities is not None
            return PointLabels(keep=valid, probabilities=frame.class_probabilities.reshape(-1, len(classes))), None
        assert frame.labels is not None
        return PointLabels(keep=valid, labels=frame.labels.reshape(-1).astype(jnp.int32)), None

    return Labeller("files", tuple(classes), "class_probabilities" if soft else "labels", label)


def harden(labels: PointLabels) -> PointLabels:
    """Probabilities as labels, the likeliest class each; labels stay what they are.

    What the probabilities lack to 1 is that of no class: where it is the greatest, so is the label.
    """
    if labels.probabilities is None:
        return labels
    likeliest = labels.probabilities.argmax(axis=-1).astype(jnp.int32)
    known = labels.probabilities.max(axis=-1) >= 1.0 - labels.probabilities.sum(axis=-1)
    return PointLabels(keep=labels.keep, labels=jnp.where(known, likeliest, IGNORE))
