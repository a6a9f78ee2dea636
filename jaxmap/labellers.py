"""Labellers: what gives every point of a frame its class. All have one signature."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from jaxmap.errors import JaxmapError
from jaxmap.geometry.plane import fit_plane_mlesac, plane_distance, refit_plane, search_plane
from jaxmap.labels import IGNORE
from jaxmap.types import Frame, Plane, PointLabels, to_device

UP_WORLD = (0.0, 0.0, 1.0)

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


class PlaneParams(NamedTuple):
    """The numbers of the plane labeller (`make_plane_labeller`); `sigma_m` is that of `fit_plane_mlesac`."""

    sigma_m: Float[Array, ""]
    threshold_m: Float[Array, ""]
    softness_m: Float[Array, ""]


def make_no_labeller() -> Labeller:
    """Geometry alone: no class at all."""

    def label(frame: Frame, points_world: Array, valid: Array, params: Any, key: Array) -> tuple[PointLabels, None]:
        return PointLabels(keep=valid, labels=jnp.full(valid.shape, IGNORE, jnp.int32)), None

    return Labeller("none", (), None, label)


def make_plane_labeller(
    classes: Sequence[str],
    *,
    threshold_m: float = 0.1,
    softness_m: float = 0.0,
    max_height_m: float = 2.0,
    on_plane: str = "sand",
    off_plane: str = "rock",
    sigma_m: float = 0.05,
    **fit: object,
) -> Labeller:
    """The paper's baseline: points off the principal plane are rock, points on it are sand.

    Args:
        classes: the map's classes, with `on_plane` and `off_plane` among them.
        threshold_m: distance from the plane, to either side, beyond which a point is off it.
        softness_m: width of the passage between the two; a point at distance d is off the plane with the probability
            `1 / (1 + exp(-(|d| - threshold_m) / softness_m))`. At 0 the threshold is sharp, and passes no gradient.
        max_height_m: points farther from the plane are left out of the map.
        on_plane: class of the points on the plane.
        off_plane: class of the points off the plane.
        sigma_m: standard deviation of points on the plane.
        **fit: other options of `fit_plane_mlesac`.

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
    if not 0 <= softness_m < float("inf"):
        raise JaxmapError(f"softness_m {softness_m}", where="plane labeller", fix="give a width, or 0 for none")
    unknown = fit.keys() - inspect.signature(fit_plane_mlesac).parameters.keys()
    if unknown:
        raise JaxmapError(f"fit_plane_mlesac has no option {', '.join(sorted(unknown))}", where="plane labeller")
    sand, rock = classes.index(on_plane), classes.index(off_plane)
    up = {"up_hint": to_device(UP_WORLD, np.float32)}

    def shares(off_m: Array, found: Array, threshold_m: Array, softness_m: Array) -> Array:
        off = jax.nn.sigmoid((off_m - threshold_m) / softness_m)
        of_class = {sand: 1.0 - off, rock: off}
        known = [of_class.get(index, jnp.zeros_like(off)) for index in range(len(classes))]
        # Without a plane nothing is known of any point but that it is there.
        return jnp.where(found[..., None], jnp.stack(known, axis=-1), 0.0)

    def label(
        frame: Frame, points_world: Array, valid: Array, params: PlaneParams, key: Array
    ) -> tuple[PointLabels, Plane]:
        plane = fit_plane_mlesac(key, points_world, valid, sigma_m=params.sigma_m, **up, **fit)  # type: ignore[arg-type]
        with jax.named_scope("plane_labels"):
            off = jnp.abs(plane_distance(plane, points_world))
            keep = valid & ((off <= max_height_m) | ~plane.found)
            if softness_m > 0:
                found = jnp.broadcast_to(plane.found, off.shape)
                soft = shares(off, found, params.threshold_m, params.softness_m)
                return PointLabels(keep=keep, probabilities=soft), plane
            labels = jnp.where(off > params.threshold_m, rock, sand)
            labels = jnp.where(plane.found, labels, IGNORE)
        return PointLabels(keep=keep, labels=labels), plane

    options: dict[str, Any] = _defaults(fit_plane_mlesac) | fit
    of_refit = {name: options[name] for name in ("outlier_range_m", "max_tilt_rad", "em_rounds")}

    def cues(frame: Frame, points_world: Array, valid: Array, params: PlaneParams, key: Array) -> Cues:
        search: dict[str, Any] = {**up, **options, "sigma_m": params.sigma_m}
        start = search_plane(key, points_world, valid, **search)
        plane = refit_plane(start, sigma_m=params.sigma_m, **up, **of_refit)
        off = jnp.abs(plane_distance(plane, points_world))
        return Cues(valid & ((off <= max_height_m) | ~plane.found), points_world, shared=start)

    def probabilities(values: Array, frame: Array, shared: Any, numbers: dict[str, Array]) -> Array:
        planes = jax.vmap(lambda start: refit_plane(start, sigma_m=numbers["sigma_m"], **up, **of_refit))(shared)
        off = jnp.abs((values * planes.normal[frame]).sum(axis=-1) + planes.offset_m[frame])
        return shares(off, planes.found[frame], numbers["threshold_m"], numbers["softness_m"])

    numbers = {"sigma_m": sigma_m, "threshold_m": threshold_m, "softness_m": softness_m}
    params = PlaneParams(**{name: to_device(value, np.float32) for name, value in numbers.items()})
    limits = {"sigma_m": (1e-3, 1.0), "threshold_m": (5e-3, 0.99 * max_height_m), "softness_m": (1e-3, 1.0)}
    return Labeller("plane", tuple(classes), None, label, params, TunableLabels(numbers, limits, cues, probabilities))


def _defaults(function: Callable[..., object]) -> dict[str, Any]:
    """The options of a function that have a default."""
    parameters = inspect.signature(function).parameters.values()
    return {one.name: one.default for one in parameters if one.default is not inspect.Parameter.empty}


def make_files_labeller(classes: Sequence[str], *, soft: bool) -> Labeller:
    """Labels made elsewhere, carried by the frame: class indices, or probabilities where `soft`."""

    def label(frame: Frame, points_world: Array, valid: Array, params: Any, key: Array) -> tuple[PointLabels, None]:
        if soft:
            assert frame.class_probabilities is not None
            return PointLabels(keep=valid, probabilities=frame.class_probabilities.reshape(-1, len(classes))), None
        assert frame.labels is not None
        return PointLabels(keep=valid, labels=frame.labels.reshape(-1).astype(jnp.int32)), None

    needs: Needs = "class_probabilities" if soft else "labels"
    return Labeller("files", tuple(classes), needs, label, tunable=fixed_labels(label))


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
