"""The numbers of the sensor model and of the decision, as the arrays that the step computes with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Any

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxmap.errors import JaxmapError, UsageError
from jaxmap.fusion.bijectors import between, own_label_above, positive, rings
from jaxmap.fusion.options import FusionOptions, FusionRule
from jaxmap.types import to_device


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FusionParams:
    """The numbers of `FusionOptions` on the device; every leaf is differentiable.

    Priors are log-odds here (natural), thresholds probabilities. `class_increments[i, j]` is what one observation of
    label `i` adds to class `j`. `disparity_sigma_px` drives the range weight and the margin of free-space carving.
    `class_kernel` spreads evidence over neighbouring columns when the map is read (`neighbours`); None for not at all.

    Each tunable number is annotated with its bijector; the four of occupancy go together (`tuning.parametrisation`).
    """

    occupancy_hit: Float[Array, ""]
    occupancy_miss: Float[Array, ""]
    occupancy_prior: Float[Array, ""]
    class_increments: Annotated[Float[Array, "C C"], own_label_above()]
    class_prior: Annotated[Float[Array, "C"], between(-7.0, 7.0)]
    disparity_sigma_px: Annotated[Float[Array, ""], positive(1e-3, 50.0)]
    full_evidence_points: Annotated[Float[Array, ""], positive(0.1, 1e4)]
    occupancy_threshold: Float[Array, ""]
    class_threshold: Annotated[Float[Array, ""], between(1e-3, 1.0 - 1e-3)]
    class_kernel: Annotated[Float[Array, "C K K"] | None, rings(-0.5, 1.0)] = None


def make_fusion_params(classes: Sequence[str], options: FusionOptions | None = None, **changes: Any) -> FusionParams:
    """Builds `FusionParams` for a map of these classes.

    Without `class_increments`, an observation adds `class_hit` to its own class and `class_miss` to
    every other (the label confusion of a sensor that treats all classes alike).

    Args:
        classes: of the map.
        options: the numbers; by default those of `FusionOptions`.
        **changes: fields of `FusionOptions` that differ from it.

    Raises:
        JaxmapError: a number out of bounds, or a matrix, prior or kernel of another size than the classes ask for.
    """
    changes = {
        name: np.asarray(value).tolist() if hasattr(value, "shape") else value for name, value in changes.items()
    }
    numbers = replace(options or FusionOptions(), **changes)
    count = len(classes)
    priors = np.asarray(numbers.priors(classes), np.float64)
    if priors.shape not in ((), (count,)):
        raise JaxmapError(
            f"class_prior is {numbers.class_prior}", where="fusion", fix="give one probability, or one per class"
        )
    increments = np.full((count, count), numbers.class_miss) + np.eye(count) * (numbers.class_hit - numbers.class_miss)
    if numbers.class_increments is not None:
        increments = _array(numbers.class_increments) if count else increments
        if increments.shape != (count, count):
            raise JaxmapError(
                f"class_increments is not a finite {count}x{count} matrix",
                where="fusion",
                fix="give one row per observed label and one column per class",
            )
    kernel = None if numbers.class_kernel is None else _array(numbers.class_kernel)
    if kernel is not None and not (
        kernel.ndim == 3 and len(kernel) == count and kernel.shape[1] == kernel.shape[2] and kernel.shape[1] % 2 == 1
    ):
        raise JaxmapError(
            f"class_kernel is not {count} finite squares of one odd size",
            where="fusion",
            fix="give one kernel for each class, such as 3x3",
        )
    priors = np.broadcast_to(priors, (count,))
    values = {one.name: getattr(numbers, one.name) for one in fields(FusionParams)} | {
        "occupancy_prior": logit(numbers.occupancy_prior),
        "class_increments": increments,
        "class_prior": logit(priors),
        "class_threshold": numbers.threshold(classes, priors.tolist()),
        "class_kernel": kernel,
    }
    leaves: dict[str, Any] = {name: to_device(value, np.float32) for name, value in values.items() if value is not None}
    return FusionParams(**leaves)


def logit(probability: Any) -> Any:
    """Natural log-odds of probabilities in (0, 1), float64."""
    return np.log(probability / (1.0 - probability))


def _array(rows: Any) -> np.ndarray:
    """Nested rows as an array, empty where they are ragged."""
    try:
        return np.asarray(rows, np.float64)
    except ValueError:
        return np.empty(0)


def fusion_numbers(params: FusionParams) -> dict[str, np.ndarray]:
    """The numbers of `FusionOptions` that make these parameters; the inverse of `make_fusion_params`."""
    numbers = {one.name: getattr(params, one.name) for one in fields(params)}
    for prior in ("occupancy_prior", "class_prior"):
        numbers[prior] = jax.nn.sigmoid(numbers[prior])
    return {name: np.asarray(value, np.float64) for name, value in numbers.items() if value is not None}


def fusion_attribute(options: FusionOptions, rule: FusionRule) -> dict[str, Any]:
    """What a stored map records of its fusion, as plain values."""
    return {"params": options.numbers(), "rule": asdict(rule)}


def stored_fusion(fusion: Mapping[str, Any], classes: Sequence[str], where: object) -> tuple[FusionParams, FusionRule]:
    """The parameters and the rule that a map was fused with, from its attribute (`fusion_attribute`).

    Raises:
        JaxmapError: the attribute is not of this form, or holds what this version does not know.
    """
    try:
        rule = FusionRule(**fusion.get("rule", {}))
        # The priors that are left to the classes follow the priority.
        params = make_fusion_params(classes, priority_classes=rule.priority_classes, **fusion.get("params", {}))
        return params, rule
    except UsageError as error:
        reason = error.what
    except (TypeError, ValueError, AttributeError) as error:
        reason = str(error)
    raise JaxmapError(f"the attribute fusion is not understood ({reason})", where=where, fix="map the sequence again")
