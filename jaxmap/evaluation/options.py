"""The options of scoring a map."""

from __future__ import annotations

import math
from dataclasses import dataclass

from jaxmap.errors import UsageError


@dataclass(frozen=True)
class ScoringOptions:
    """How a map is scored.

    Raises:
        UsageError: a number out of its range.
    """

    cell_size_m: float = 0.2
    """Edge of a cell."""
    rock_fraction: float = 0.5
    """A cell is rock where rock covers this share: in the truth of its labelled area, in the map of its area."""
    max_range_m: float | None = None
    """Count only cells that a camera looked at from so near."""
    register: bool = False
    """Shift (to 0.5 m) and turn (to 2 degrees) the truth to where it fits best; reported with the scores before."""
    found_share: float = 0.5
    """A rock is found where the map calls this share of its area in view rock, by its own columns."""

    def __post_init__(self) -> None:
        """Checks the bounds."""
        for name in ("cell_size_m", "rock_fraction", "found_share", "max_range_m"):
            value, is_share = getattr(self, name), name in ("rock_fraction", "found_share")
            if value is not None and not (math.isfinite(value) and value > 0 and not (is_share and value > 1)):
                bound = " and at most 1" if is_share else ""
                raise UsageError(f"{name} is {value}", where="scoring", fix=f"give a number above 0{bound}")
