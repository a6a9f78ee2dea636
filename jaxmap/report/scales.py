"""Axes of charts: where values lie on them, and ticks at round numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

from jaxmap.report.wording import number_text

LOG_RATIO = 30
"""Values that span a larger factor are drawn on a logarithmic axis."""

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

Item = TypeVar("Item")


class Scale(NamedTuple):
    """An axis: where values lie on it, and its ticks."""

    low: float
    high: float
    ticks: tuple[float, ...]
    logarithmic: bool = False

    def share(self, value: float) -> float:
        """0 at the lower end, 1 at the upper one."""
        if self.logarithmic:
            return (math.log(value) - math.log(self.low)) / (math.log(self.high) - math.log(self.low))
        return (value - self.low) / (self.high - self.low)

    def tick_texts(self) -> tuple[str, list[str]]:
        """A factor that all ticks share, to be put behind the name of the axis, and the ticks without it."""
        if self.logarithmic:
            return "", [_power(tick) for tick in self.ticks]
        most = max(map(abs, self.ticks))
        if most == 0 or 0.05 <= most < 10_000:
            return "", [number_text(tick) for tick in self.ticks]
        exponent = math.floor(math.log10(most) + 1e-9)
        return f", ×10{_superscript(exponent)}", [number_text(tick / 10.0**exponent) for tick in self.ticks]


def linear_scale(low: float, high: float, at_most: int) -> Scale:
    """An axis from `low` to `high` or the next ticks beyond, which are 1, 2 or 5 times a power of ten apart.

    At most `at_most` such steps fit between `low` and `high`.
    """
    span = high - low if high > low else abs(high) or 1.0
    step = next(step for step in _steps(span / at_most) if span / step <= at_most)
    first, last = math.floor(low / step + 1e-9), math.ceil((low + span) / step - 1e-9)
    # Products of whole numbers and a step gather no rounding, unlike sums of steps.
    ticks = tuple(float(f"{index * step:.12g}") for index in range(first, last + 1))
    return Scale(ticks[0], ticks[-1], ticks)


def fitting_scale(low: float, high: float, at_most: int) -> Scale:
    """An axis that holds all values: from zero, or logarithmic where they span more than `LOG_RATIO`."""
    if low > 0 and high / low > LOG_RATIO:
        first, last = math.floor(math.log10(low) + 1e-9), math.ceil(math.log10(high) - 1e-9)
        every = math.ceil((last - first) / at_most)
        return Scale(10.0**first, 10.0**last, tuple(10.0**power for power in range(first, last + 1, every)), True)
    return linear_scale(min(low, 0.0), max(high, 0.0), at_most)


def whole_scale(low: float, high: float) -> Scale:
    """An axis of whole numbers, such as epochs, that ends where the values do."""
    if high <= low:
        return Scale(low - 1, low + 1, (low,))
    step = max(1.0, next(step for step in _steps((high - low) / 8) if (high - low) / step <= 8))
    ticks = [step * index for index in range(math.ceil(low / step), math.floor(high / step) + 1)]
    return Scale(low, high, tuple(ticks))


def _steps(near: float) -> list[float]:
    power = 10.0 ** math.floor(math.log10(near))
    return [power * factor for factor in (1, 2, 5, 10, 20)]


def spread(places: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Increasing places moved to be `gap` apart, inside [low, high] if all fit there, by the least sum of squares.

    Without the gaps that lie before them, the places must not decrease: an isotonic regression, found by
    pooling neighbours that do (Barlow et al. 1972), whose bounded form is the same, clipped.
    """
    pools: list[tuple[float, int]] = []
    for index, place in enumerate(places):
        pools.append((place - index * gap, 1))
        while len(pools) > 1 and pools[-2][0] > pools[-1][0]:
            (first, count), (second, more) = pools[-2:]
            pools[-2:] = [((first * count + second * more) / (count + more), count + more)]
    last = max(high - (len(places) - 1) * gap, low)
    means = [min(max(mean, low), last) for mean, count in pools for _ in range(count)]
    return [mean + index * gap for index, mean in enumerate(means)]


def thinned(items: Sequence[Item], at_most: int) -> Sequence[Item]:
    """So many of them at even distances, with the first and the last."""
    if len(items) <= at_most:
        return items
    return [items[round(index * (len(items) - 1) / (at_most - 1))] for index in range(at_most)]


def _power(value: float) -> str:
    return number_text(value) if 1e-3 <= value <= 1e3 else f"10{_superscript(round(math.log10(value)))}"


def _superscript(number: int) -> str:
    return str(number).translate(_SUPERSCRIPTS)
