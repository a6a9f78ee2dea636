"""The options of the labellers."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated

import tyro

from jaxmap.errors import UsageError
from jaxmap.geometry.options import PlaneFitOptions
from jaxmap.host.settings import NotNegative, Positive, options


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
        """Refuses a threshold beyond the points that are kept."""
        if not self.threshold_m < self.max_height_m:
            raise UsageError(
                f"threshold_m {self.threshold_m} and max_height_m {self.max_height_m}",
                where="plane",
                fix="take 0 < threshold_m < max_height_m",
            )


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

Size = Annotated[int, Positive]


@options("deeplab")
class DeeplabOptions:
    """The network as a labeller."""

    class_map: Annotated[dict[str, str], _RENAMING_OPTION] = field(default_factory=dict)
    """Classes of the network under the names of the map's, where they differ; several may become one."""
    size_px: tuple[Size, Size] | None = None
    """Height and width that the network runs at; those of the images without it."""
    soft: bool = True
    """Fuse the probabilities of all classes, not only the likeliest class."""
    temperature: Annotated[float, Positive] = 1.0
    """Divides the logits: above 1 the probabilities are softer."""
