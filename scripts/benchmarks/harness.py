"""How one case is timed beside its peers (warmed up, in turn, in one process), and the gate of the ratios."""

from __future__ import annotations

import importlib.util
import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

Run = Callable[[], object]

LEAST_ROUNDS, MOST_ROUNDS = 3, 25
TURNS = 3
"""How often at most a fast run is timed in a round, where another takes as long as several of its runs."""
PAUSE_S = 0.02
"""Before each turn: threads of the run before may still be spinning."""

SLACK, FLOOR, MISSED_SLACK = 1.5, 0.9, 1.25


class Amount(NamedTuple):
    """A count and its unit, such as 800,000 voxels."""

    count: float
    unit: str


class Peer(NamedTuple):
    """What a case is compared with.

    Attributes:
        name: as printed.
        make: prepares the run that is timed; called only where `modules` are installed.
        limit: the target: the greatest ratio of our time to its time; None for no target.
        gated: whether the command fails where the limit is passed; else the target is only printed.
        modules: what must be importable.
    """

    name: str
    make: Callable[[], Run]
    limit: float | None = None
    gated: bool = True
    modules: tuple[str, ...] = ()


@dataclass(frozen=True)
class Case:
    """One thing to time, at one size.

    Attributes:
        run: one run of ours; returns when its result is there.
        grown: what the sizes of this case differ in.
        work: what one run processes.
        peers: what it is compared with.
        compile_s: time of compilation.
        temporary_bytes: memory of the compiled program beside its arguments and results.
        facts: called at the end for other figures, such as errors of the results.
    """

    run: Run
    grown: Amount
    work: Amount
    peers: Sequence[Peer] = ()
    compile_s: float | None = None
    temporary_bytes: int | None = None
    facts: Callable[[], Mapping[str, float]] = field(default=dict)


class Group(NamedTuple):
    """A benchmark at three sizes: what it is, in one line, and how to prepare the case of a size."""

    title: str
    build: Callable[[str], Case]


def limit_threads(count: int) -> None:
    """Binds the process to so many cores; must run before the numerical libraries are imported, which look once."""
    os.environ["OMP_NUM_THREADS"] = str(count)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])


def usable_cores() -> int:
    """The cores that the process is bound to."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def measure(case: Case, budget_s: float) -> dict[str, Any]:
    """Times a case and its peers for about `budget_s`, at least `LEAST_ROUNDS` rounds.

    Returns:
        What the JSON holds of a case: figures of our run, `peers` with theirs and the ratios, and `missing`, the peers
        that could not run, each with the modules that are not installed.
    """
    missing = {peer.name: absent for peer in case.peers if (absent := [*filter(is_absent, peer.modules)])}
    peers = [peer for peer in case.peers if peer.name not in missing]
    runs = [case.run, *(peer.make() for peer in peers)]
    first_s = [_warmed_up(run) for run in runs]
    turns = [min(TURNS, max(1, round(max(first_s) / max(own_s, 1e-9)))) for own_s in first_s]
    round_s = sum(count * own_s for count, own_s in zip(turns, first_s, strict=True))
    rounds = int(min(MOST_ROUNDS, max(LEAST_ROUNDS, budget_s / max(round_s, 1e-9))))
    own, *others = map(summary, in_turn(runs, turns, rounds))
    result: dict[str, Any] = {"grown": case.grown._asdict(), "work": case.work._asdict(), **own}
    result["work_per_s"] = _significant(1e3 * case.work.count / own["median_ms"])
    if case.compile_s is not None:
        result["compile_s"] = round(case.compile_s, 2)
    if case.temporary_bytes is not None:
        result["temporary_mib"] = round(case.temporary_bytes / 2**20, 1)
    result["peers"] = {
        peer.name: {
            **figures,
            "ratio": _significant(own["median_ms"] / figures["median_ms"]),
            **({} if peer.limit is None else {"limit": _significant(peer.limit), "gated": peer.gated}),
        }
        for peer, figures in zip(peers, others, strict=True)
    }
    result["missing"] = missing
    result["facts"] = {name: _significant(value) for name, value in case.facts().items()}
    return result


def in_turn(runs: Sequence[Run], turns: Sequence[int], rounds: int) -> list[list[float]]:
    """Seconds of each run, timed `turns` times in every round."""
    times_s: list[list[float]] = [[] for _ in runs]
    for _ in range(rounds):
        for run, count, record in zip(runs, turns, times_s, strict=True):
            time.sleep(PAUSE_S)
            record.extend(timed(run) for _ in range(count))
    return times_s


def timed(run: Run) -> float:
    """Seconds of one run."""
    started_s = time.perf_counter()
    run()
    return time.perf_counter() - started_s


def summary(times_s: Sequence[float]) -> dict[str, float]:
    """The median and the spread (interquartile range), in milliseconds."""
    quartiles = statistics.quantiles(times_s, n=4, method="inclusive") if len(times_s) > 1 else [times_s[0]] * 3
    low, median, high = (1e3 * quartile for quartile in quartiles)
    return {"median_ms": _significant(median), "spread_ms": _significant(high - low), "runs": len(times_s)}


def bound(limit: float, baseline_ratio: float | None) -> float:
    """The ratio that fails the command.

    The smaller of the limit and 1.5 times the ratio of the committed baseline, but never tighter than 0.9 times the
    limit: machines are noisy, ratios less so. Where the baseline misses the limit, the ratio must get no worse than
    1.25 times that of the baseline.
    """
    if baseline_ratio is None:
        return limit
    if baseline_ratio > limit:
        return MISSED_SLACK * baseline_ratio
    return min(limit, max(SLACK * baseline_ratio, FLOOR * limit))


def is_absent(module: str) -> bool:
    """Whether a module is not installed."""
    return importlib.util.find_spec(module) is None


def _warmed_up(run: Run) -> float:
    """Seconds of a warm run: the second, or the first where it takes over a second, of which setting up is little."""
    first_s = timed(run)
    return first_s if first_s > 1 else timed(run)


def _significant(value: float) -> float:
    return float(f"{value:.4g}")
