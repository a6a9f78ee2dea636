"""The gate: which ratios must not be passed, and whether they are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

Cases = Mapping[str, Mapping[str, Any]]
"""Results of `harness.measure` by the names of the cases."""

SLACK, FLOOR, MISSED_SLACK = 1.5, 0.9, 1.25


class Verdict(NamedTuple):
    """What the gate says of a case and one of its peers."""

    case: str
    peer: str
    ratio: float
    bound: float

    @property
    def passed(self) -> bool:
        """Whether the ratio is within its bound."""
        return self.ratio <= self.bound


def bound(limit: float, baseline_ratio: float | None) -> float:
    """The ratio that must not be passed.

    The smaller of the limit and 1.5 times the ratio in the committed baseline, but never tighter than 0.9 times the
    limit: machines are noisy, ratios less so. Where the baseline itself misses the limit, the page and the table say
    so, and the gate is that it gets no worse: 1.25 times that ratio.
    """
    if baseline_ratio is None:
        return limit
    if baseline_ratio > limit:
        return MISSED_SLACK * baseline_ratio
    return min(limit, max(SLACK * baseline_ratio, FLOOR * limit))


def verdicts(cases: Cases, baseline: Cases) -> list[Verdict]:
    """One verdict for each peer with a gated limit."""
    found = []
    for name, figures in cases.items():
        before = baseline.get(name, {}).get("peers", {})
        for peer, beside in figures["peers"].items():
            if beside.get("gated"):
                baseline_ratio = before.get(peer, {}).get("ratio")
                found.append(Verdict(name, peer, beside["ratio"], bound(beside["limit"], baseline_ratio)))
    return found


def merged(baseline: Cases, cases: Cases) -> dict[str, Mapping[str, Any]]:
    """The baseline with what was measured in its place; the rest stays, in order."""
    return {**baseline, **cases}
