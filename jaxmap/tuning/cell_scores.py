"""Scores of cells with intervals: a bootstrap over rocks and blocks of ground, not over cells.

Cells of one rock err together; drawn one by one they would make intervals that are too narrow. Whole groups
(`split.ground_groups`) are drawn with replacement instead (Davison and Hinkley 1997, section 3.8), and all scores
that `jaxmap evaluate` gives are sums over cells, so that a draw is a weight for each group.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxmap.evaluation.map_scores import CALIBRATION_BINS

DRAWS = 1000
_LEAST_PROBABILITY = 1e-6


class ScoredCells(NamedTuple):
    """Cells that count, one after the other: what was said of each, what is true, and the group it belongs to."""

    called: Bool[np.ndarray, "N"]
    probability: Float[np.ndarray, "N"]
    truly: Bool[np.ndarray, "N"]
    group: Int[np.ndarray, "N"]


def joined(parts: list[ScoredCells]) -> ScoredCells:
    """Cells of several traverses as one list; their groups are kept apart."""
    offset, groups = 0, []
    for part in parts:
        numbers = np.unique(part.group, return_inverse=True)[1]
        groups.append(numbers + offset)
        offset += int(numbers.max(initial=-1)) + 1
    called, probability, truly = (np.concatenate(column) for column in list(zip(*parts, strict=True))[:3])
    return ScoredCells(called, probability, truly, np.concatenate(groups))


def group_sums(cells: ScoredCells) -> dict[str, Float[np.ndarray, "R *k"]]:
    """What the scores are made of, summed over the cells of each group."""
    _, group = np.unique(cells.group, return_inverse=True)
    groups = int(group.max(initial=-1)) + 1
    p, y = np.asarray(cells.probability, np.float64), cells.truly
    safe = p.clip(_LEAST_PROBABILITY, 1 - _LEAST_PROBABILITY)
    place = np.minimum((p * CALIBRATION_BINS).astype(np.int64), CALIBRATION_BINS - 1)

    def total(weight: np.ndarray) -> np.ndarray:
        return np.bincount(group, weight.astype(np.float64), groups)

    def binned(weight: np.ndarray) -> np.ndarray:
        flat = np.bincount(group * CALIBRATION_BINS + place, weight, groups * CALIBRATION_BINS)
        return flat.reshape(groups, CALIBRATION_BINS)

    return {
        "tp": total(cells.called & y),
        "fp": total(cells.called & ~y),
        "fn": total(~cells.called & y),
        "cells": total(np.ones(len(y))),
        "nll": total(-np.where(y, np.log(safe), np.log1p(-safe))),
        "brier": total((p - y) ** 2),
        "said": binned(p),
        "true": binned(y.astype(np.float64)),
        "in_bin": binned(np.ones(len(y))),
    }


def scores_of(sums: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The scores of sums; NaN where a quotient has nothing below its line."""
    tp, fp, fn, cells = (sums[name] for name in ("tp", "fp", "fn", "cells"))
    with np.errstate(invalid="ignore", divide="ignore"):
        return {
            "iou": tp / (tp + fp + fn),
            "precision": tp / (tp + fp),
            "recall": tp / (tp + fn),
            "accuracy": (cells - fp - fn) / cells,
            "nll": sums["nll"] / cells,
            "brier": sums["brier"] / cells,
            "ece": np.abs(sums["said"] - sums["true"]).sum(axis=-1) / cells,
        }


def score_with_intervals(
    before: ScoredCells, after: ScoredCells, *, draws: int = DRAWS, level: float = 0.9, seed: int = 0
) -> dict[str, dict[str, list[float] | float | None]]:
    """Scores of the same cells before and after, and of the change between them.

    Args:
        before: the cells.
        after: the same cells, in the same order.
        draws: of the bootstrap.
        level: of the intervals: 0.9 for the middle nine tenths of the draws.
        seed: of the draws; both lists are drawn alike, so that the change is paired.

    Returns:
        For each score `before`, `after`, `change`, and `*_interval` of two numbers each; None where not defined.
    """
    both = [group_sums(cells) for cells in (before, after)]
    groups = len(both[0]["cells"])
    weights = np.random.default_rng(seed).multinomial(groups, np.full(groups, 1 / groups), size=draws)
    exact = [scores_of({name: values.sum(axis=0) for name, values in sums.items()}) for sums in both]
    drawn = [scores_of({name: weights @ values for name, values in sums.items()}) for sums in both]
    edges = np.array([(1 - level) / 2, (1 + level) / 2])

    def interval(values: np.ndarray) -> list[float] | None:
        values = values[np.isfinite(values)]
        return [float(edge) for edge in np.quantile(values, edges)] if values.size else None

    table: dict[str, dict[str, list[float] | float | None]] = {}
    for name in exact[0]:
        one, other = (float(scores[name]) for scores in exact)
        table[name] = {
            "before": _number(one),
            "after": _number(other),
            "change": _number(other - one),
            "before_interval": interval(drawn[0][name]),
            "after_interval": interval(drawn[1][name]),
            "change_interval": interval(drawn[1][name] - drawn[0][name]),
        }
    return table


def calibration_rows(cells: ScoredCells) -> list[dict[str, float]]:
    """For each bin of probability that holds cells: the mean said, how often it was true, and the cells."""
    sums = {name: values.sum(axis=0) for name, values in group_sums(cells).items()}
    rows = zip(sums["said"], sums["true"], sums["in_bin"], strict=True)
    return [{"said": float(s / n), "true": float(t / n), "cells": int(n)} for s, t, n in rows if n]


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None
