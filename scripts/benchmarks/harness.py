"""How one case is timed beside its peers: warmed up, turn by turn in one process, medians and spread."""

from __future__ import annotations

import importlib.util
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

Run = Callable[[], object]
Clock = Callable[[], float]

LEAST_ROUNDS, MOST_ROUNDS = 3, 25
TURNS = 3
"""How often at most the fast ones run in a round, where another takes as long as several of their runs."""
SLOW_S = 1.0
"""Runs as slow are warmed up once."""
PAUSE_S = 0.02
"""Before each turn."""


class Amount(NamedTuple):
    """So many of something, such as 800,000 voxels."""

    count: float
    unit: str


class Peer(NamedTuple):
    """What a case is held against.

    Attributes:
        name: as it is printed.
        make: prepares it; what it returns is timed. Called only where `modules` are installed.
        limit: the greatest ratio, our time over its time, that is good enough; None where no target is set.
        gated: whether the run fails where the limit is passed; otherwise the target is only printed, as at sizes that
            it was not set for.
        modules: what must be importable.
    """

    name: str
    make: Callable[[], Run]
    limit: float | None = None
    gated: bool = True
    modules: tuple[str, ...] = ()

    def missing(self) -> list[str]:
        """Those of its modules that are not installed."""
        return [module for module in self.modules if importlib.util.find_spec(module) is None]


@dataclass(frozen=True)
class Case:
    """One thing to time, at one size.

    Attributes:
        run: one run of ours; returns when its result is there.
        grown: what makes the sizes of this case differ.
        work: what one run gets through.
        peers: what it is held against.
        compile_s: what compiling took.
        temporary_bytes: memory of the compiled program beside its arguments and results.
        facts: called at the end for what else is to be told, such as errors of results.
    """

    run: Run
    grown: Amount
    work: Amount
    peers: Sequence[Peer] = ()
    compile_s: float | None = None
    temporary_bytes: int | None = None
    facts: Callable[[], Mapping[str, float]] = field(default=dict)


def measure(
    case: Case, budget_s: float, *, clock: Clock = time.perf_counter, pause: Run | None = None
) -> dict[str, Any]:
    """Times a case and its peers.

    Args:
        case: what is timed.
        budget_s: about how long; a few rounds are made in any case.
        clock: seconds.
        pause: between turns, by default so long that threads come to rest.

    Returns:
        What the JSON holds of a case: figures of our run, `peers` with theirs and the ratios, and `missing`, the
        peers that could not run, each with the modules that it lacks.
    """
    missing = {peer.name: absent for peer in case.peers if (absent := peer.missing())}
    peers = [peer for peer in case.peers if peer.name not in missing]
    times_s = interleaved([case.run, *(peer.make() for peer in peers)], budget_s, clock, pause)
    own, *others = map(summary, times_s)
    result: dict[str, Any] = {"grown": case.grown._asdict(), "work": case.work._asdict(), **own}
    result["work_per_s"] = significant(1e3 * case.work.count / own["median_ms"])
    if case.compile_s is not None:
        result["compile_s"] = round(case.compile_s, 2)
    if case.temporary_bytes is not None:
        result["temporary_mib"] = round(case.temporary_bytes / 2**20, 1)
    result["peers"] = {
        peer.name: {
            **figures,
            "ratio": significant(own["median_ms"] / figures["median_ms"]),
            **({} if peer.limit is None else {"limit": significant(peer.limit), "gated": peer.gated}),
        }
        for peer, figures in zip(peers, others, strict=True)
    }
    result["missing"] = missing
    result["facts"] = {name: significant(value) for name, value in case.facts().items()}
    return result


def interleaved(runs: Sequence[Run], budget_s: float, clock: Clock, pause: Run | None = None) -> list[list[float]]:
    """Seconds of each run, turn by turn, after a run or two of each that do not count."""
    first_s = [warmed_up(run, clock) for run in runs]
    turns = [min(TURNS, max(1, round(max(first_s) / max(own_s, 1e-9)))) for own_s in first_s]
    round_s = sum(count * own_s for count, own_s in zip(turns, first_s, strict=True))
    rounds = int(min(MOST_ROUNDS, max(LEAST_ROUNDS, budget_s / max(round_s, 1e-9))))
    return in_turn(runs, turns, rounds, clock, pause)


def in_turn(
    runs: Sequence[Run], turns: Sequence[int], rounds: int, clock: Clock = time.perf_counter, pause: Run | None = None
) -> list[list[float]]:
    """Seconds of each run, each so many times in every round."""
    times_s: list[list[float]] = [[] for _ in runs]
    for _ in range(rounds):
        for run, count, record in zip(runs, turns, times_s, strict=True):
            (pause or _rest)()
            record.extend(timed(run, clock) for _ in range(count))
    return times_s


def _rest() -> None:
    """Threads of the one before may still be spinning."""
    time.sleep(PAUSE_S)


def warmed_up(run: Run, clock: Clock) -> float:
    """Seconds of a run that is warm: the second, or the first where it is so slow that setting up counts little."""
    first_s = timed(run, clock)
    return first_s if first_s > SLOW_S else timed(run, clock)


def timed(run: Run, clock: Clock = time.perf_counter) -> float:
    """Seconds of one run."""
    started_s = clock()
    run()
    return clock() - started_s


def summary(times_s: Sequence[float]) -> dict[str, float]:
    """The median and the spread (the distance of the quartiles), in milliseconds."""
    quartiles = statistics.quantiles(times_s, n=4, method="inclusive") if len(times_s) > 1 else [times_s[0]] * 3
    low, median, high = (1e3 * quartile for quartile in quartiles)
    return {"median_ms": significant(median), "spread_ms": significant(high - low), "runs": len(times_s)}


def significant(value: float) -> float:
    """Four digits that count."""
    return float(f"{value:.4g}")
