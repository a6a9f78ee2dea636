"""The options of the labellers."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated

import tyro
from annotated_types import Interval

from jaxmap.errors import UsageError
from jaxmap.geometry.options import GroundOptions, PlaneFitOptions
from jaxmap.host.settings import AnyNumber, NotNegative, Positive, count, options


@options("plane")
class PlaneOptions(PlaneFitOptions):
    """The MLESAC plane and the labels it gives."""

    threshold_m: Annotated[float, Positive] = 0.1
    """Points farther from the plane are rock."""
    softness_m: Annotated[float, NotNegative] = 0.0
    """Width of the passage from sand to rock around the threshold; at 0 it is sharp."""
    max_height_m: Annotated[float, Positive] = 2.0
    """Points farther still are left out."""
    on_plane: str = "sand"
    """Class of the points on the plane."""
    off_plane: str = "rock"
    """Class of the points off the plane."""

    def __post_init__(self) -> None:
        """Refuses a threshold beyond the points that are kept, and what the fit refuses."""
        super().__post_init__()
        if not self.threshold_m < self.max_height_m:
            raise UsageError(
                f"threshold_m {self.threshold_m} and max_height_m {self.max_height_m}",
                where="plane",
                fix="take 0 < threshold_m < max_height_m",
            )


@options("relief")
class ReliefOptions(GroundOptions):
    """Relief as a labeller, and what it adds to the labels of others (`labellers.relief`).

    The log-odds of rock are `bias + height_gain tanh((height - threshold_m) / hypot(softness_m, noise sigma)) +
    slope_gain arctan(slope)`. The defaults were fitted on simulated pairs of other worlds than those it is tried on.
    """

    combine: bool | None = None
    """Add relief to the labels of a network or of files; --relief and --no-relief for short. By default to those of a
    network that knows the two classes below."""
    bias: Annotated[float, AnyNumber] = -2.7
    """Log-odds of rock on level ground of middling height."""
    threshold_m: Annotated[float, Interval(ge=0, le=2)] = 0.024
    """Height at which a point is as likely above the ground as on it."""
    softness_m: Annotated[float, Positive] = 0.02
    """Width of the passage around the threshold, without noise."""
    noise: Annotated[float, Positive] = 1.5
    """Standard deviations of a height that widen the passage."""
    height_gain: Annotated[float, NotNegative] = 3.0
    """Greatest change of the log-odds by height."""
    slope_gain: Annotated[float, NotNegative] = 1.9
    """Change of the log-odds for each radian of slope."""
    weight: Annotated[float, NotNegative] = 1.0
    """Share of relief's log-odds that is added to those of other labels."""
    offset: Annotated[float, AnyNumber] = 0.0
    """Added to relief's log-odds there."""
    label_gain: Annotated[float, NotNegative] = 1.0
    """Factor on the log-odds of the other labels."""
    certainty: Annotated[float, Interval(gt=0, lt=1)] = 0.9
    """Probability that a label without a probability of its own is right."""
    ground: str = "sand"
    """Class of points on the ground."""
    rock: str = "rock"
    """Class of points that rise above it."""


def _renaming_from_words(words: list[str]) -> dict[str, str]:
    pairs = [word.partition("=") for word in words]
    if not all(name and equals and new_name for name, equals, new_name in pairs):
        raise ValueError("give pairs such as bus=car")
    return {name: new_name for name, _, new_name in pairs}


_RENAMING_OPTION = tyro.constructors.PrimitiveConstructorSpec(
    nargs="*",
    metavar="NETWORK=MAP",
    instance_from_str=_renaming_from_words,
    is_instance=lambda value: isinstance(value, dict),
    str_from_instance=lambda renaming: [f"{name}={new_name}" for name, new_name in renaming.items()],
)
"""A dict of names on the command line; by itself tyro would make an option of each key."""

Size = Annotated[int, count(8192)]


@options("deeplab")
class DeeplabOptions:
    """The network as a labeller."""

    class_map: Annotated[dict[str, str], _RENAMING_OPTION] = field(default_factory=dict)
    """Classes of the network under the names of the map's, where they differ; several may become one."""
    size_px: tuple[Size, Size] | None = None
    """Height and width that the network runs at; by default those of the images, the bundled network at most 512
    columns."""
    soft: bool = True
    """Fuse the probabilities of all classes, not only the likeliest class."""
    see_relief: bool = True
    """Show relief to a network that was trained to see it; without, it labels by the image alone."""
    temperature: Annotated[float, Positive] = 1.0
    """Divides the logits: above 1 the probabilities are softer."""
