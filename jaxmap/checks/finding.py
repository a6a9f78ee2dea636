"""What a check has found."""

from __future__ import annotations

from typing import NamedTuple


class Finding(NamedTuple):
    """Something wrong with a sequence, and what mends it.

    Attributes:
        kind: a short slug, such as "vertical-disparity".
        stops: whether the map would be wrong (`--strict` stops); otherwise it is worth knowing.
        confidence: from 0 to 1.
        what: what is wrong, with numbers, in one sentence.
        fix: the option or step that mends it.
    """

    kind: str
    stops: bool
    confidence: float
    what: str
    fix: str
