"""Relief as a labeller, alone or added to the labels of a network or of files.

What rises above the local ground is rock, whatever its colour and however the ground lies: where the plane of the paper
calls a hillside rock, relief does not, and where a network has never seen such sand, relief need not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from jaxmap.errors import JaxmapError
from jaxmap.fusion.bijectors import Bijector, between, positive
from jaxmap.geometry.cloud import PointCloud
from jaxmap.geometry.relief import box_sums, to_pixels
from jaxmap.labellers.base import Labeller, LabellerParams, Numbers, PointFeatures, Pointwise
from jaxmap.labellers.options import ReliefOptions
from jaxmap.labellers.shares import Odds, with_odds
from jaxmap.labels import IGNORE
from jaxmap.types import Frame, to_device


class GroundSeen(NamedTuple):
    """Of a frame: whether there is ground below the camera, and the estimate of the labels that relief is added to."""

    found: Bool[Array, ""]
    own: PyTree = ()


_FEATURES = 4
"""Height, sigma, angle of the slope, and whether they are known."""

_MOST_LOG_ODDS = 50.0
"""Beyond, exponentials would overflow."""

_BIJECTORS: dict[str, Bijector] = {
    "bias": between(-20.0, 20.0),
    "threshold_m": positive(1e-3, 2.0),
    "softness_m": positive(1e-3, 1.0),
    "noise": positive(0.05, 20.0),
    "height_gain": positive(1e-3, 50.0),
    "slope_gain": positive(1e-3, 50.0),
}
_COMBINED: dict[str, Bijector] = {
    "weight": positive(1e-3, 20.0),
    "offset": between(-20.0, 20.0),
    "label_gain": positive(1e-3, 20.0),
}


def make_relief_labeller(classes: Sequence[str], options: ReliefOptions | None = None, **changes: Any) -> Labeller:
    """Labels by height above the local ground and by slope, both weighed against their noise.

    Points whose relief is unknown have no class; false matches in the air are left out. The labeller's estimate of a
    frame says whether there is ground (`GroundSeen`).

    Args:
        classes: the map's classes, with `ground` and `rock` among them.
        options: by default those of `ReliefOptions`.
        **changes: fields of `ReliefOptions` that differ from it.

    Raises:
        JaxmapError: a class that is not among `classes`, or a number out of bounds.
    """
    options = replace(options or ReliefOptions(), **changes)
    sand, rock = _indices(classes, options, (options.ground, options.rock))

    def features(frame: Frame, cloud: PointCloud, params: LabellerParams, key: Array) -> PointFeatures:
        values = _coarse_features(cloud)
        shape, width = cloud.depth_m.shape, values.shape[1]

        def map_coarse(function: Pointwise, more: Array | None = None) -> tuple[Array, ...]:
            assert more is None
            return tuple(
                to_pixels(image.reshape(-1, width), shape).reshape(-1)
                for image in function(values.reshape(-1, _FEATURES))
            )

        return PointFeatures(cloud.in_range.reshape(-1) & ~floating_points(cloud), map_coarse, ground_seen(cloud))

    def label(values: Array, estimate: Any, numbers: Numbers) -> tuple[Array, ...]:
        known = values[:, 3]
        p_rock = jax.nn.sigmoid(rock_log_odds(values, numbers))
        of_class = {sand: known * (1.0 - p_rock), rock: known * p_rock}
        return tuple(of_class.get(index, jnp.zeros_like(p_rock)) for index in range(len(classes)))

    return Labeller(
        "relief",
        tuple(classes),
        None,
        features,
        label,
        params=LabellerParams(numbers=_numbers(options, _BIJECTORS)),
        bijectors=_BIJECTORS,
        soft=True,
        ground=options,
        draws=False,
    )


def combine_with_relief(labeller: Labeller, options: ReliefOptions | None = None, **changes: Any) -> Labeller:
    """Adds relief to the labels of another labeller: its odds of rock are multiplied by relief's likelihood ratio.

    The log-odds of relief, times `weight` and with `offset` added, are added to those of rock against each other
    class; where relief is unknown, labels stay as they are. Labels without probabilities are right with `certainty`.

    Args:
        labeller: gives labels of a network or of files.
        options: by default those of `ReliefOptions`.
        **changes: fields of `ReliefOptions` that differ from it.

    Raises:
        JaxmapError: it has no class of rock, or a number is out of bounds.
    """
    options = replace(options or ReliefOptions(), **changes)
    classes = labeller.classes
    (rock,) = _indices(classes, options, (options.rock,))
    bijectors = {**_BIJECTORS, **_COMBINED}

    def features(frame: Frame, cloud: PointCloud, params: LabellerParams, key: Array) -> PointFeatures:
        inner = labeller.features(frame, cloud, params, key)
        relief = _coarse_features(cloud)

        def map_both(function: Pointwise, more: Array | None = None) -> tuple[Array, ...]:
            return inner.map(function, relief if more is None else jnp.concatenate([relief, more], axis=-1))

        def label_all(numbers: Numbers, odds: Odds | None) -> tuple[Array, ...]:
            assert inner.label is not None and odds is None
            log_odds = _added_odds(relief.reshape(-1, _FEATURES), numbers).reshape(relief.shape[:2])
            return inner.label(numbers, Odds(rock, log_odds, numbers["label_gain"]))

        keep, of_frame = inner.keep & ~floating_points(cloud), ground_seen(cloud, inner.of_frame)
        return PointFeatures(keep, map_both, of_frame, None if inner.label is None else label_all)

    def estimate(of_frame: GroundSeen, numbers: Numbers) -> GroundSeen:
        return of_frame._replace(own=labeller.estimate(of_frame.own, numbers))

    def label(values: Array, estimate: GroundSeen, numbers: Numbers) -> tuple[Array, ...]:
        own, relief = values[:, :-_FEATURES], values[:, -_FEATURES:]
        given = labeller.label(own, estimate.own, numbers)
        if labeller.soft:
            shares = list(given)
        else:
            doubt = (1.0 - options.certainty) / max(len(classes) - 1, 1)
            there = given[0] != IGNORE
            shares = [
                jnp.where(there, jnp.where(given[0] == index, options.certainty, doubt), 0.0)
                for index in range(len(classes))
            ]
        return with_odds(shares, rock, _added_odds(relief, numbers), numbers["label_gain"])

    def keep(values: Array, estimate: GroundSeen) -> tuple[Array]:
        assert labeller.keep is not None
        return labeller.keep(values[:, :-_FEATURES], estimate.own)

    numbers = {**labeller.params.numbers, **_numbers(options, bijectors)}
    return labeller._replace(
        features=features,
        label=label,
        estimate=estimate,
        keep=None if labeller.keep is None else keep,
        params=labeller.params._replace(numbers=numbers),
        bijectors={**labeller.bijectors, **bijectors},
        soft=True,
        ground=options,
    )


def rock_log_odds(values: Float[Array, "N 4 *w"], numbers: Numbers) -> Float[Array, "N *w"]:
    """The log-odds of rock by relief alone, see `ReliefOptions`."""
    with jax.named_scope("relief_labels"):
        height_m, sigma_m, angle = values[:, 0], values[:, 1], values[:, 2]
        wide_m = jnp.sqrt(numbers["softness_m"] ** 2 + (numbers["noise"] * sigma_m) ** 2)
        rise = jnp.tanh((height_m - numbers["threshold_m"]) / wide_m)
        return numbers["bias"] + numbers["height_gain"] * rise + numbers["slope_gain"] * angle


def _added_odds(values: Float[Array, "N 4 *w"], numbers: Numbers) -> Float[Array, "N *w"]:
    """What relief adds to the log-odds of rock that a labeller gives."""
    ratio = numbers["weight"] * (rock_log_odds(values, numbers) + numbers["offset"])
    return jnp.where(values[:, 3] > 0, ratio, 0.0).clip(-_MOST_LOG_ODDS, _MOST_LOG_ODDS)


def floating_points(cloud: PointCloud) -> Bool[Array, "N"]:
    """Points that are false matches in the air."""
    assert cloud.relief is not None
    return to_pixels(cloud.relief.floating, cloud.depth_m.shape).reshape(-1)


def ground_seen(cloud: PointCloud, own: PyTree = ()) -> GroundSeen:
    """What of a frame is known from its relief, beside other features of the whole frame."""
    assert cloud.relief is not None
    return GroundSeen(cloud.relief.found, own)


def _coarse_features(cloud: PointCloud) -> Float[Array, "h w 4"]:
    relief = cloud.relief
    assert relief is not None
    known = relief.known.astype(relief.height_m.dtype)
    # The mean of the known heights around: half of the noise is gone, and edges of rocks are hardly moved.
    mass = box_sums(known)
    height_m = box_sums(relief.height_m * known) / jnp.maximum(mass, 1.0)
    return jnp.stack([height_m, relief.sigma_m, jnp.arctan(relief.slope), known], axis=-1)


def _indices(classes: Sequence[str], options: ReliefOptions, names: tuple[str, ...]) -> list[int]:
    for name in names:
        if name not in classes:
            raise JaxmapError(
                f"the class {name!r} is not one of {list(classes)}",
                where="relief",
                fix="name the map's classes in relief.ground and relief.rock",
            )
    return [classes.index(name) for name in names]


def _numbers(options: ReliefOptions, bijectors: dict[str, Bijector]) -> Numbers:
    return {name: to_device(getattr(options, name), np.float32) for name in bijectors}
