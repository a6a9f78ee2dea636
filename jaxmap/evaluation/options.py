"""The options of scoring a map."""

from __future__ import annotations

from typing import Annotated

from annotated_types import Interval

from jaxmap.host.settings import CellSize, Positive, options

Share = Annotated[float, Interval(gt=0, le=1)]


@options("scoring")
class ScoringOptions:
    """How a map is scored.

    Raises:
        UsageError: a number out of its range.
    """

    cell_size_m: Annotated[float, CellSize] = 0.2
    """Edge of a cell."""
    rock_fraction: Share = 0.5
    """A cell is rock where rock covers this share: in the truth of its labelled area, in the map of its area."""
    max_range_m: Annotated[float, Positive] | None = None
    """Count only cells that a camera looked at from so near."""
    register: bool = False
    """Shift (to 0.5 m) and turn (to 2 degrees) the truth to where it fits best; reported with the scores before."""
    found_share: Share = 0.5
    """A rock is found where the map calls this share of its area in view rock, by its own columns."""
