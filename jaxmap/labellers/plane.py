"""The paper's baseline: points off the principal plane are rock."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmap.errors import JaxmapError
from jaxmap.geometry.plane import fit_plane_mlesac, plane_distance, refit_plane, search_plane
from jaxmap.labellers.base import Cues, Labeller, TunableLabels
from jaxmap.labels import IGNORE
from jaxmap.types import Frame, Plane, PointLabels, to_device

UP_WORLD = (0.0, 0.0, 1.0)


class PlaneParams(NamedTuple):
    """The numbers of the plane labeller (`make_plane_labeller`); `sigma_m` is that of `fit_plane_mlesac`."""

    sigma_m: Float[Array, ""]
    threshold_m: Float[Array, ""]
    softness_m: Float[Array, ""]


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
