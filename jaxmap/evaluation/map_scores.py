"""Scores of cells against truth: confusion, calibration of probabilities, and how well they rank cells."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

CALIBRATION_BINS = 15
RELIABILITY_EDGES = (0.0, 0.01, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
"""Of the bins of a reliability table: finer near zero, where rare things have their probabilities."""
_LEAST_PROBABILITY = 1e-6
"""Probabilities are clipped this far from 0 and 1 in the likelihood: one certain mistake must not make it infinite."""


class Confusion(NamedTuple):
    """Cells by what they are called and what they are; positive is the class that is scored (rock)."""

    tp: int
    fp: int
    fn: int
    tn: int

    @property
    def total(self) -> int:
        """All cells counted."""
        return sum(self)


def count_confusion(
    called: Bool[np.ndarray, "*s"], truth: Bool[np.ndarray, "*s"], counted: Bool[np.ndarray, "*s"]
) -> Confusion:
    """Counts the cells where `counted` is true."""
    called, truth = np.asarray(called)[counted], np.asarray(truth)[counted]
    kinds = (called & truth, called & ~truth, ~called & truth, ~called & ~truth)
    return Confusion(*(int(np.sum(kind)) for kind in kinds))


def confusion_scores(confusion: Confusion) -> dict[str, float | None]:
    """Accuracy, IoU, precision, recall and F1; None where a denominator is zero."""
    tp, fp, fn, tn = confusion
    return {
        "accuracy": _quotient(tp + tn, confusion.total),
        "iou": _quotient(tp, tp + fp + fn),
        "precision": _quotient(tp, tp + fp),
        "recall": _quotient(tp, tp + fn),
        "f1": _quotient(2 * tp, 2 * tp + fp + fn),
    }


def probability_scores(
    probability: Float[np.ndarray, "*s"], truth: Bool[np.ndarray, "*s"], counted: Bool[np.ndarray, "*s"]
) -> dict[str, float | None]:
    """Negative log-likelihood (nats per cell), Brier score and expected calibration error of probabilities.

    `ece` is the mean distance between the probability of the class and how often it is true, over 15 equal bins of
    probability, weighted by their cells (Naeini et al. 2015; for the class itself, not for the winning one).
    """
    p, y = np.asarray(probability, np.float64)[counted], np.asarray(truth)[counted]
    if not p.size:
        return {"nll": None, "brier": None, "ece": None}
    safe = p.clip(_LEAST_PROBABILITY, 1 - _LEAST_PROBABILITY)
    place = np.minimum((p * CALIBRATION_BINS).astype(np.int64), CALIBRATION_BINS - 1)
    said, true = (np.bincount(place, weight, minlength=CALIBRATION_BINS) for weight in (p, y))
    return {
        "nll": float(-np.where(y, np.log(safe), np.log1p(-safe)).mean()),
        "brier": float(((p - y) ** 2).mean()),
        "ece": float(np.abs(said - true).sum() / p.size),
    }


def score_cells(
    called: Bool[np.ndarray, "*s"],
    probability: Float[np.ndarray, "*s"],
    truth: Bool[np.ndarray, "*s"],
    counted: Bool[np.ndarray, "*s"],
    observed: Bool[np.ndarray, "*s"] | None = None,
) -> dict[str, Any]:
    """All scores of cells, from arrays of one shape.

    Args:
        called: cells that the map calls by the class.
        probability: of the class, for each cell.
        truth: cells that are of the class.
        counted: cells that count.
        observed: cells that the map observed; `coverage` is their share of those that count (1 where not given).

    Returns:
        accuracy iou precision recall f1 coverage tp fp fn tn nll brier ece; None where a score is not defined.
    """
    confusion = count_confusion(called, truth, counted)
    seen = confusion.total if observed is None else int((np.asarray(observed) & counted).sum())
    return {
        **confusion_scores(confusion),
        "coverage": _quotient(seen, confusion.total),
        **confusion._asdict(),
        **probability_scores(probability, truth, counted),
    }


def roc_auc(score: Float[np.ndarray, "N"], truth: Bool[np.ndarray, "N"]) -> float | None:
    """Area under the ROC curve: how likely a true one scores above a false one, ties counting half.

    By the rank-sum statistic of Mann and Whitney (Hanley and McNeil 1982); None without one of either kind.
    """
    score, truth = np.asarray(score, np.float64), np.asarray(truth, bool)
    positives, negatives = int(truth.sum()), int((~truth).sum())
    if not positives or not negatives:
        return None
    _, place, counts = np.unique(score, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(counts) - 0.5 * (counts - 1))[place]
    return float((ranks[truth].sum() - positives * (positives + 1) / 2) / (positives * negatives))


def average_precision(score: Float[np.ndarray, "N"], truth: Bool[np.ndarray, "N"]) -> float | None:
    """Area under the precision-recall curve, as the sum of precision times the recall gained at each score.

    Equal scores are taken together, so that their order does not matter. None without a true one; an uninformative
    number has the share of true ones.
    """
    score, truth = np.asarray(score, np.float64), np.asarray(truth, bool)
    if not truth.any():
        return None
    _, place = np.unique(-score, return_inverse=True)
    found, all_ = np.bincount(place, truth), np.bincount(place)
    precision = np.cumsum(found) / np.cumsum(all_)
    return float((found * precision).sum() / truth.sum())


def reliability(probability: Float[np.ndarray, "N"], truth: Bool[np.ndarray, "N"]) -> list[dict[str, float | int]]:
    """For each bin of probability that is not empty: its bounds, how many, the mean probability, the true share."""
    p, y = np.asarray(probability, np.float64), np.asarray(truth, bool)
    place = np.digitize(p, RELIABILITY_EDGES[1:-1])
    return [
        {
            "from": RELIABILITY_EDGES[index],
            "to": RELIABILITY_EDGES[index + 1],
            "cells": int((place == index).sum()),
            "said": float(p[place == index].mean()),
            "true": float(y[place == index].mean()),
        }
        for index in np.unique(place)
    ]


def ranking_scores(score: Float[np.ndarray, "N"], truth: Bool[np.ndarray, "N"]) -> dict[str, Any]:
    """`auc` and `average_precision`, and `nll`, `brier` and `ece` of the score as a probability."""
    counted = np.ones(len(score), bool)
    return {
        "auc": roc_auc(score, truth),
        "average_precision": average_precision(score, truth),
        **probability_scores(score, truth, counted),
    }


def _quotient(above: float, below: float) -> float | None:
    return above / below if below else None
