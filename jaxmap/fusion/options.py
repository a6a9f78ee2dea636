"""The options of fusion: its discrete choices, and the numbers of sensor model, filter and decision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Annotated, Any, Literal

from annotated_types import Interval

from jaxmap.errors import UsageError
from jaxmap.host.settings import LARGEST, AnyNumber, NotNegative, Positive, Probability, options
from jaxmap.labels import ROVER_CLASSES

DEFAULT_PRIORITY, DEFAULT_LEFT_OUT = ("rock",), ("background",)
Number = Annotated[float, AnyNumber]

RARE, EVEN = 0.05, 0.5
"""Priors of the priority classes, and of the others."""


@options("fusion")
class FusionRule:
    """The discrete choices of fusion, fixed when the step is compiled."""

    per_frame: Literal["sum", "once", "majority", "mean"] = "mean"
    """How the points of a frame in a voxel count. sum: each adds its increment; once: each label that is present adds
    its increment once; majority: the label of most points alone adds its increment, once; mean: the frame adds one
    increment, shared by the fractions of the labels, in full from full_evidence_points on. Under once and majority
    each point has its likeliest label."""
    carve: bool = True
    """Mark voxels that were seen through as free."""
    range_weighting: bool = True
    """Let points count less as depth noise outgrows the voxel."""
    surface: bool = True
    """Keep the height of the surface in each column, finer than voxels; hazards are measured from it."""
    column: Literal["max", "sum"] = "sum"
    """Top-down map: the greatest evidence in a column, or the sum of it."""
    priority_classes: tuple[str, ...] | None = None
    """Classes that win a cell as soon as they pass class_threshold, in this order; the others compete by probability.
    By default rock, if it is a class."""
    left_out_classes: tuple[str, ...] | None = None
    """Points whose likeliest class is one of these make no voxels. By default background where sand and rock are
    classes, too: there it is the sky and what lies beyond the ground. Name none to map it."""

    @property
    def hard_labels(self) -> bool:
        """Whether points have one label each, not probabilities: labels then pass no gradient."""
        return self.per_frame in ("once", "majority")

    def priority(self, classes: Sequence[str]) -> list[int]:
        """Indices of the priority classes among `classes`, in their order."""
        names = DEFAULT_PRIORITY if self.priority_classes is None else self.priority_classes
        return [classes.index(name) for name in names if name in classes]

    def left_out(self, classes: Sequence[str]) -> list[int]:
        """Indices of the classes among `classes` that make no voxels."""
        names = self.left_out_classes
        if names is None:
            names = DEFAULT_LEFT_OUT if set(ROVER_CLASSES) <= set(classes) else ()
        return [classes.index(name) for name in names if name in classes]

    def target(self, classes: Sequence[str]) -> str | None:
        """The class that cells are asked about first: the first priority class that is there."""
        return next((classes[index] for index in self.priority(classes)), None)


@options("fusion")
class FusionOptions(FusionRule):
    """The sensor model, the filter and the decision."""

    occupancy_hit: Annotated[float, NotNegative] = 0.85
    """Log-odds that a frame with points in a voxel adds to its occupancy."""
    occupancy_miss: Annotated[float, Interval(ge=-LARGEST, le=0)] = -0.4
    """Log-odds added to the occupancy of a voxel that was seen through."""
    occupancy_prior: Annotated[float, Probability] = 0.5
    """Probability that a voxel is occupied before anything was seen."""
    class_hit: Annotated[float, AnyNumber] = 2.0
    """Log-odds that an observed label adds to its class."""
    class_miss: Annotated[float, AnyNumber] = -2.0
    """Log-odds that an observed label adds to every other class."""
    class_increments: tuple[tuple[Number, ...], ...] | None = None
    """The whole matrix, row: observed label, column: class; overrides class_hit and class_miss."""
    class_prior: Annotated[float, Probability] | tuple[Annotated[float, Probability], ...] | None = None
    """Probability of a class before anything was seen; one number, or one per class. By default 0.05 for the priority
    classes, which are rare, and 0.5 for the others."""
    disparity_sigma_px: Annotated[float, Positive] = 0.5
    """Standard deviation of disparity."""
    full_evidence_points: Annotated[float, Positive] = 8.0
    """Points from which on a frame counts in full (per_frame mean)."""
    occupancy_threshold: Annotated[float, Probability] = 0.5
    """A voxel is occupied above this probability."""
    class_threshold: Annotated[float, Probability] | None = None
    """A priority class wins above this probability; by default above its prior: more speaks for it than against."""
    class_kernel: tuple[tuple[tuple[Number, ...], ...], ...] | None = None
    """One odd square a class: how much of the evidence of neighbouring columns counts when the map is read; tune
    --kernel learns it."""

    def rule(self, classes: Sequence[str]) -> FusionRule:
        """The discrete choices, for a map of these classes.

        Raises:
            UsageError: a class that is named is none of them.
        """
        chosen = {"priority_classes": self.priority(classes), "left_out_classes": self.left_out(classes)}
        for option in chosen:
            if unknown := [name for name in getattr(self, option) or () if classes and name not in classes]:
                raise UsageError(
                    f"{', '.join(unknown)} is not one of the classes {' '.join(classes)}",
                    where=f"fusion.{option}",
                    fix="name classes of the map, or none",
                )
        choices: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(FusionRule)}
        for name, indices in chosen.items():
            choices[name] = tuple(classes[index] for index in indices)
        return FusionRule(**choices)

    def priors(self, classes: Sequence[str]) -> float | Sequence[float]:
        """The prior of each class, or one of all."""
        if self.class_prior is not None:
            return self.class_prior
        rare = self.priority(classes)
        return [RARE if index in rare else EVEN for index in range(len(classes))]

    def threshold(self, classes: Sequence[str], priors: Sequence[float]) -> float:
        """The probability above which a priority class wins."""
        if self.class_threshold is not None:
            return self.class_threshold
        # A hair above: where nothing was seen, rounding must not decide.
        return next((1.001 * priors[index] for index in self.priority(classes)), EVEN)

    def numbers(self) -> dict[str, Any]:
        """All but the discrete choices, by name."""
        discrete = {field.name for field in fields(FusionRule)}
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name not in discrete}
