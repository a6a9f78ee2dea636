"""How well a number ranks the true above the false, and how well it is calibrated."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxmap.evaluation.map_scores import probability_scores

RELIABILITY_EDGES = (0.0, 0.01, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
"""Of the bins of a reliability table: finer near zero, where rare things have their probabilities."""


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

    Equal scores are taken together, so that their order does not matter. None without a true one; a number that says
    nothing has the share of true ones.
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
