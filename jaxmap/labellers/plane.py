"""The paper's baseline: points off the principal plane are rock, points on it are sand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmap.errors import JaxmapError
from jaxmap.fusion.bijectors import positive
from jaxmap.geometry.cloud import PointCloud
from jaxmap.geometry.plane import PlaneStart, plane_distance, refit_plane, search_plane
from jaxmap.labellers.base import Labeller, LabellerParams, Numbers, PointFeatures, dense_features
from jaxmap.labellers.options import PlaneOptions
from jaxmap.labels import IGNORE
from jaxmap.types import Frame, Plane, to_device

UP_WORLD = (0.0, 0.0, 1.0)


def make_plane_labeller(classes: Sequence[str], options: PlaneOptions | None = None, **changes: Any) -> Labeller:
    """Labels by the distance from the principal plane (MLESAC).

    A point at distance d is off the plane with the probability `1 / (1 + exp(-(|d| - threshold_m) / softness_m))`. At a
    softness of 0 the threshold is sharp, and passes no gradient. The labeller's estimate of a frame is its `Plane`.

    Args:
        classes: the map's classes, with `on_plane` and `off_plane` among them.
        options: by default those of `PlaneOptions`.
        **changes: fields of `PlaneOptions` that differ from it.

    Raises:
        JaxmapError: a class that is not among `classes`, or a number out of bounds.
    """
    options = replace(options or PlaneOptions(), **changes)
    for name in (options.on_plane, options.off_plane):
        if name not in classes:
            raise JaxmapError(f"the class {name!r} is not one of {list(classes)}", where="plane labeller")
    sand, rock = classes.index(options.on_plane), classes.index(options.off_plane)
    up_world = to_device(UP_WORLD, np.float32)

    def features(frame: Frame, cloud: PointCloud, params: LabellerParams, key: Array) -> PointFeatures:
        points, keep = cloud.points_world, cloud.in_range.reshape(-1)
        with jax.named_scope("mlesac"):
            start = search_plane(key, points, keep, up_world, params.numbers["sigma_m"], options)
        return PointFeatures(keep, dense_features(points, cloud.depth_m.shape), start)

    def estimate(start: PlaneStart, numbers: Numbers) -> Plane:
        with jax.named_scope("mlesac"):
            return refit_plane(start, up_world, numbers["sigma_m"], options)

    def keep_near(points_world: Array, plane: Plane) -> tuple[Array]:
        with jax.named_scope("plane_labels"):
            return ((jnp.abs(plane_distance(plane, points_world)) <= options.max_height_m) | ~plane.found,)

    def label(points_world: Array, plane: Plane, numbers: Numbers) -> tuple[Array, ...]:
        with jax.named_scope("plane_labels"):
            off_m = jnp.abs(plane_distance(plane, points_world))
            # Without a plane nothing is known of any point but that it is there.
            if options.softness_m == 0:
                labels = jnp.where(off_m > numbers["threshold_m"], rock, sand)
                return (jnp.where(plane.found, labels, IGNORE),)
            # So narrow a passage is sharp, and may be divided by.
            softness_m = jnp.maximum(numbers["softness_m"], 1e-5)
            off = jax.nn.sigmoid((off_m - numbers["threshold_m"]) / softness_m)
            of_class = {sand: 1.0 - off, rock: off}
            shares = (of_class.get(index, jnp.zeros_like(off)) for index in range(len(classes)))
            return tuple(jnp.where(plane.found, share, 0.0) for share in shares)

    # The greatest threshold leaves points beyond it on the map.
    bijectors = {
        "sigma_m": positive(1e-3, 1.0),
        "threshold_m": positive(5e-3, 0.99 * options.max_height_m),
        "softness_m": positive(1e-3, 1.0),
    }
    numbers = {name: to_device(getattr(options, name), np.float32) for name in bijectors}
    return Labeller(
        "plane",
        tuple(classes),
        None,
        features,
        label,
        estimate,
        keep_near,
        LabellerParams(numbers=numbers),
        bijectors,
        soft=options.softness_m > 0,
    )
