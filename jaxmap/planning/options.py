"""The rover that a path is planned for, and what driving costs it."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Interval

from jaxmap.errors import UsageError
from jaxmap.host.settings import NotNegative, Positive, Settings, options

Radius = Annotated[float, Interval(ge=0.02, le=20)]


@options("rover")
class RoverOptions:
    """A rover's size, what it can drive over, and what it shuns; costs are in metres of driving on level ground."""

    radius_m: Radius = 0.45
    """Radius of the disc that holds the rover, wheels included, whatever its heading."""
    margin_m: Annotated[float, Interval(ge=0, le=10)] = 0.1
    """Kept free around that disc: errors of the map and of driving."""
    wheel_m: Radius = 0.125
    """Radius of a wheel: heights this far apart make a step."""
    max_step_m: Annotated[float, Positive] = 0.2
    """Greatest step: clearance below the belly, or what a wheel climbs, whichever is less."""
    max_slope_deg: Annotated[float, Interval(gt=0, lt=90)] = 20.0
    """Steepest slope."""
    max_roughness_m: Annotated[float, Positive] = 0.1
    """Greatest root mean square of the ground's distances from a plane under the rover."""
    free: Annotated[float, Interval(ge=0, lt=1)] = 0.3
    """Hazards below this part of their greatest cost nothing."""
    rock_cost: Annotated[float, NotNegative] = 100.0
    """What driving a metre costs that is certain to lead over rock: it counts by its probability."""
    rock_m: Radius = 0.1
    """Radius over which the probability of rock is averaged, that of the least rock worth a detour: one column alone is
    noise."""
    unknown_cost: Annotated[float, NotNegative] = 10.0
    """What a metre costs over ground that was not seen; it counts by its share of the disc."""
    max_unknown: Annotated[float, Interval(ge=0, le=1)] = 0.4
    """Greatest share of the disc that may lie on ground not seen."""
    gap_m: Radius = 0.15
    """Ground counts as seen this near to a height: between the pixels of far ground there are holes."""

    def __post_init__(self) -> None:
        """Refuses wheels as large as the rover."""
        if self.wheel_m >= self.radius_m:
            raise UsageError(
                f"wheel_m {self.wheel_m:g} and radius_m {self.radius_m:g}",
                where="rover",
                fix="take a wheel that is smaller than the rover",
            )


ROVER_SETTINGS = Settings(RoverOptions, "plan", folder="rovers")
