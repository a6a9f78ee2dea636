"""Ranking scores: equal to counting pairs, indifferent to the order of cells and to rising transformations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from strategies import rngs

from jaxmap.evaluation.map_scores import average_precision, ranking_scores, reliability, roc_auc


def an_example(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Scores with many ties, and some of either kind."""
    score, truth = rng.integers(0, 6, 40) / 8, rng.random(40) < 0.3
    truth[:2] = True, False
    return score, truth


@given(rngs())
def test_the_area_is_the_share_of_pairs_in_the_right_order(rng):
    score, truth = an_example(rng)
    pairs = score[truth][:, None] - score[~truth][None]
    assert roc_auc(score, truth) == pytest.approx((pairs > 0).mean() + 0.5 * (pairs == 0).mean())


@given(rngs())
def test_average_precision_is_precision_summed_over_the_recall_gained(rng):
    score, truth = an_example(rng)
    total, recall = 0.0, 0.0
    for threshold in sorted(set(score), reverse=True):
        taken = score >= threshold
        gained = truth[taken].sum() / truth.sum()
        total += (gained - recall) * truth[taken].mean()
        recall = gained
    assert average_precision(score, truth) == pytest.approx(total)


@given(rngs())
def test_ranking_asks_for_the_order_of_scores_alone(rng):
    score, truth = an_example(rng)
    order = rng.permutation(len(score))
    for measure in (roc_auc, average_precision):
        assert measure(score[order], truth[order]) == pytest.approx(measure(score, truth))
        assert measure(np.exp(3 * score), truth) == pytest.approx(measure(score, truth))
    assert roc_auc(-score, truth) == pytest.approx(1 - roc_auc(score, truth))


def test_the_ends_of_the_scale():
    truth = np.array([True, True, False, False])
    assert roc_auc(truth.astype(float), truth) == average_precision(truth.astype(float), truth) == 1.0
    assert roc_auc(np.zeros(4), truth) == average_precision(np.zeros(4), truth) == 0.5
    assert roc_auc(np.zeros(4), np.ones(4, bool)) is None
    assert average_precision(np.zeros(4), np.zeros(4, bool)) is None
    assert ranking_scores(np.zeros(0), np.zeros(0, bool)) == dict.fromkeys(
        ("auc", "average_precision", "nll", "brier", "ece")
    )


@given(rngs())
def test_bins_hold_every_cell_once(rng):
    probability, truth = rng.random(50) ** 3, rng.random(50) < 0.2
    probability[:2] = 0.0, 1.0
    bins = reliability(probability, truth)
    assert sum(part["cells"] for part in bins) == 50
    assert sum(part["cells"] * part["true"] for part in bins) == pytest.approx(truth.sum())
    assert sum(part["cells"] * part["said"] for part in bins) == pytest.approx(probability.sum())
    assert all(part["from"] <= part["said"] <= part["to"] for part in bins)
    assert reliability(np.zeros(0), np.zeros(0, bool)) == []
