"""The numbers of the sensor model and of the decision, and the discrete choices beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxmap.errors import JaxmapError
from jaxmap.types import to_device


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FusionParams:
    """The numbers of the sensor model and of the decision; every leaf is differentiable.

    Log-odds are natural. `class_increments[i, j]` is what one observation of label `i` adds to
    class `j`. `disparity_sigma_px` drives the range weight and the margin of free-space carving.
    `class_kernel`, one odd square a class, spreads evidence over neighbouring columns when the map is
    read (`neighbours`); None for not at all.
    """

    occupancy_hit: Float[Array, ""]
    occupancy_miss: Float[Array, ""]
    occupancy_prior: Float[Array, ""]
    class_increments: Float[Array, "C C"]
    class_prior: Float[Array, "C"]
    disparity_sigma_px: Float[Array, ""]
    full_evidence_points: Float[Array, ""]
    occupancy_threshold: Float[Array, ""]
    class_threshold: Float[Array, ""]
    class_kernel: Float[Array, "C K K"] | None = None


@dataclass(frozen=True)
class FusionRule:
    """The discrete choices of fusion, fixed when the step is compiled.

    Attributes:
        per_frame: how the points of one frame in one voxel count. `sum`: each adds its increment;
            `once`: each label present adds its increment once (the paper); `mean`: the frame adds
            one increment, shared by the labels' fractions, in full from `full_evidence_points` on.
        carve: whether voxels seen through are marked free.
        range_weighting: whether a point counts less as its depth noise outgrows the voxel.
        priority_classes: classes that win a voxel as soon as their probability passes the
            threshold, in this order; the others compete by probability.
        column: how voxels of a column make the top-down map: the `max` probability over them, or
            the `sum` of their evidence.
    """

    per_frame: Literal["sum", "once", "mean"] = "mean"
    carve: bool = True
    range_weighting: bool = True
    priority_classes: tuple[str, ...] = ("rock",)
    column: Literal["max", "sum"] = "sum"

    def target(self, classes: Sequence[str]) -> str | None:
        """The class that cells are asked about first: the first priority class that is there."""
        return next((name for name in self.priority_classes if name in classes), None)

    def __post_init__(self) -> None:
        """Refuses what no rule is called."""
        for name, choices in (("per_frame", ("sum", "once", "mean")), ("column", ("max", "sum"))):
            if getattr(self, name) not in choices:
                raise JaxmapError(
                    f"{name} is {getattr(self, name)!r}", where="fusion rule", fix=f"choose {', '.join(choices)}"
                )


def logit(probability: float) -> float:
    """Natural log-odds of a probability in (0, 1)."""
    return float(np.log(probability / (1.0 - probability)))


def make_fusion_params(
    classes: Sequence[str],
    *,
    occupancy_hit: float = 0.85,
    occupancy_miss: float = -0.4,
    occupancy_prior: float = 0.5,
    class_hit: float = 0.9,
    class_miss: float = -0.9,
    class_increments: ArrayLike | None = None,
    class_prior: ArrayLike = 0.5,
    disparity_sigma_px: float = 0.5,
    full_evidence_points: float = 8.0,
    occupancy_threshold: float = 0.5,
    class_threshold: float = 0.5,
    class_kernel: ArrayLike | None = None,
) -> FusionParams:
    """Checks and builds `FusionParams`; priors and thresholds are probabilities here.

    Without `class_increments`, an observation adds `class_hit` to its own class and `class_miss` to
    every other (the label confusion of a sensor that treats all classes alike).

    Raises:
        JaxmapError: a probability outside (0, 1), a matrix of another size, or a wrong sign.
    """
    count = len(classes)
    numbers = dict(
        occupancy_hit=occupancy_hit,
        occupancy_miss=occupancy_miss,
        class_hit=class_hit,
        class_miss=class_miss,
        disparity_sigma_px=disparity_sigma_px,
        full_evidence_points=full_evidence_points,
    )
    for name, value in numbers.items():
        if not np.isfinite(value):
            raise JaxmapError(f"{name} is {value}", where="fusion", fix="give a finite number")
    probabilities = dict(
        occupancy_prior=occupancy_prior, occupancy_threshold=occupancy_threshold, class_threshold=class_threshold
    )
    for name, value in probabilities.items():
        if not 0.0 < value < 1.0:
            raise JaxmapError(f"{name} is {value}", where="fusion", fix="give a probability between 0 and 1")
    if occupancy_hit < 0 or occupancy_miss > 0:
        raise JaxmapError(
            f"occupancy_hit {occupancy_hit} and occupancy_miss {occupancy_miss}",
            where="fusion",
            fix="a hit adds (>= 0) and a miss takes away (<= 0)",
        )
    if disparity_sigma_px <= 0 or full_evidence_points <= 0:
        raise JaxmapError(
            "disparity_sigma_px and full_evidence_points must be positive", where="fusion", fix="give numbers above 0"
        )
    matrix = _increment_matrix(count, class_hit, class_miss, class_increments)
    priors = np.asarray(class_prior, np.float64)
    if priors.shape not in ((), (count,)) or not ((priors > 0) & (priors < 1)).all():
        raise JaxmapError(
            f"class_prior is {class_prior}",
            where="fusion",
            fix="give probabilities between 0 and 1, one or one per class",
        )
    priors = np.broadcast_to(priors, (count,))

    def leaf(value: ArrayLike) -> Array:
        return to_device(value, np.float32)

    return FusionParams(
        occupancy_hit=leaf(occupancy_hit),
        occupancy_miss=leaf(occupancy_miss),
        occupancy_prior=leaf(logit(occupancy_prior)),
        class_increments=leaf(matrix),
        class_prior=leaf(np.log(priors / (1 - priors))),
        disparity_sigma_px=leaf(disparity_sigma_px),
        full_evidence_points=leaf(full_evidence_points),
        occupancy_threshold=leaf(occupancy_threshold),
        class_threshold=leaf(class_threshold),
        class_kernel=None if class_kernel is None else leaf(_kernels(count, class_kernel)),
    )


def stored_fusion(fusion: Mapping[str, Any], classes: Sequence[str], where: object) -> tuple[FusionParams, FusionRule]:
    """The parameters and the rule that a map was fused with, from its `fusion` attribute.

    Args:
        fusion: `params`, the arguments of `make_fusion_params`, and `rule`, those of `FusionRule`; what
            is absent is the default.
        classes: the map's classes.
        where: the map, for the error.

    Raises:
        JaxmapError: the attribute is not of this form, or holds what this version does not know.
    """
    try:
        rule: dict[str, Any] = dict(fusion.get("rule", {}))
        # JSON knows no tuples.
        rule = {name: tuple(value) if isinstance(value, list) else value for name, value in rule.items()}
        return make_fusion_params(classes, **fusion.get("params", {})), FusionRule(**rule)
    except (TypeError, ValueError, AttributeError) as error:
        raise JaxmapError(
            f"the attribute fusion is not understood ({error})", where=where, fix="map the sequence again"
        ) from error


def _increment_matrix(
    count: int, class_hit: float, class_miss: float, class_increments: ArrayLike | None
) -> np.ndarray:
    """What each label adds to each class, float64 (count, count)."""
    if class_increments is None:
        return np.full((count, count), class_miss) + np.eye(count) * (class_hit - class_miss)
    try:
        matrix = np.asarray(class_increments, np.float64)
    except ValueError:
        matrix = np.full((), np.nan)
    if matrix.shape != (count, count) or not np.isfinite(matrix).all():
        raise JaxmapError(
            f"class_increments is not a finite {count}x{count} matrix",
            where="fusion",
            fix="give one row per observed label and one column per class",
        )
    return matrix


def _kernels(count: int, class_kernel: ArrayLike) -> np.ndarray:
    """One square of odd size for each class, float64 (count, K, K)."""
    try:
        kernels = np.asarray(class_kernel, np.float64)
    except ValueError:
        kernels = np.zeros((0, 0, 0))
    odd = kernels.ndim == 3 and len({*kernels.shape[1:]}) == 1 and kernels.shape[-1] % 2 == 1
    if not odd or len(kernels) != count or not np.isfinite(kernels).all():
        raise JaxmapError(
            f"class_kernel is not {count} finite squares of one odd size",
            where="fusion",
            fix="give one kernel for each class, such as 3x3",
        )
    return kernels
