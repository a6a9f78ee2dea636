"""Figures of the benchmarks as people read them; plain text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from benchmarks.gate import Verdict

_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"))


def short(value: float) -> str:
    """Three digits: 0.123, 12.3, 1,230."""
    return f"{value:,.0f}" if abs(value) >= 99.95 else f"{value:.3g}"


def time_text(milliseconds: float) -> str:
    """Seconds from a second on."""
    return f"{short(milliseconds / 1e3)} s" if milliseconds >= 1e3 else f"{short(milliseconds)} ms"


def count_text(count: float, unit: str) -> str:
    """A count in full: 786,432 points."""
    return f"{count:,.0f} {unit}"


def rate_text(per_s: float, unit: str) -> str:
    """A rate with a prefix: 187 M points/s."""
    for factor, prefix in _PREFIXES:
        if per_s >= factor:
            return f"{short(per_s / factor)} {prefix} {unit}/s"
    return f"{short(per_s)} {unit}/s"


def speed_text(ratio: float) -> str:
    """How fast we are beside a peer, from our time over its time."""
    return f"{short(1 / ratio)} x as fast" if ratio <= 0.5 else f"{short_speed(ratio)} of its speed"


def short_speed(ratio: float) -> str:
    """The same in short: 50 x, 45 %."""
    return f"{short(1 / ratio)} \N{MULTIPLICATION SIGN}" if ratio <= 0.5 else f"{short(100 / ratio)} %"


def case_lines(name: str, figures: Mapping[str, Any], found: list[Verdict]) -> Iterator[str]:
    """The lines that tell one case."""
    by_peer = {verdict.peer: verdict for verdict in found if verdict.case == name}
    rate = rate_text(figures["work_per_s"], figures["work"]["unit"])
    yield f"{name} ({count_text(**figures['grown'])})"
    yield f"    {'jaxmap':42s} {_timed(figures)}  {rate}"
    for peer, beside in figures["peers"].items():
        line = f"    {peer:42s} {_timed(beside)}  we are {speed_text(beside['ratio'])} (ratio {beside['ratio']:.3g})"
        if "limit" in beside:
            line += f"; target {speed_text(beside['limit'])}"
            line += ", met" if beside["ratio"] <= beside["limit"] else ", NOT met"
        if (verdict := by_peer.get(peer)) is not None:
            line += f"; gate {verdict.bound:.3g} {'ok' if verdict.passed else 'TOO SLOW'}"
        yield line
    for peer, modules in figures["missing"].items():
        yield f"    {peer:42s} left out: {', '.join(modules)} is not installed"
    if "compile_s" in figures:
        memory = f"; {figures['temporary_mib']:.1f} MiB beside its data" if "temporary_mib" in figures else ""
        yield f"    compiled in {figures['compile_s']:.2f} s{memory}"
    for fact, value in figures["facts"].items():
        yield f"    {fact}: {short(value)}"


def _timed(figures: Mapping[str, Any]) -> str:
    return f"{time_text(figures['median_ms']):>9s} (spread {time_text(figures['spread_ms'])})".ljust(30)
