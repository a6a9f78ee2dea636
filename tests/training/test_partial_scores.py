"""Scores of masks that say of some pixels only which class they are not of."""

from __future__ import annotations

import numpy as np
import pytest
import reference_losses
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.evaluation.segmentation_scores import SegmentationScores
from jaxmap.labels import ANY_OTHER, IGNORE
from jaxmap.training.validation import _negative_log_likelihood

CLASSES, NEGATED = ("background", "sand", "rock"), 2


@given(st.integers(0, 2**31 - 1))
def test_a_denied_class_counts_for_itself_alone(seed):
    draw = np.random.default_rng(seed)
    truth = draw.choice([0, 1, 2, ANY_OTHER, IGNORE], (5, 6)).astype(np.uint8)
    logits = draw.standard_normal((5, 6, 3)).astype(np.float32)
    scores = SegmentationScores.empty(CLASSES, NEGATED)
    scores.add(truth, logits)
    summary, predicted = scores.summary(), logits.argmax(axis=-1)
    for index, name in enumerate(CLASSES):
        known = reference_losses.known_of(truth, index, NEGATED)
        ours, true = (predicted == index) & known, (truth == index) & known
        quotients = ((ours & true).sum(), (ours | true).sum()), ((ours & true).sum(), ours.sum())
        for key, (above, below) in zip(("iou", "precision"), quotients, strict=True):
            assert summary["classes"][name][key] == (pytest.approx(above / below) if below else None), (name, key)
    known = truth != IGNORE
    right = np.where(truth == ANY_OTHER, predicted != NEGATED, predicted == truth)[known]
    assert summary["pixels"] == known.sum()
    assert summary["accuracy"] == (pytest.approx(right.mean()) if known.any() else None)
    total, count = _negative_log_likelihood(logits.astype(np.float64), truth, NEGATED)
    flat = logits.reshape(-1, 3).astype(np.float64)
    expected = reference_losses.cross_entropy(flat, truth.ravel(), np.ones(3), 0.0, NEGATED)
    assert count == known.sum() and total == pytest.approx(expected * count, rel=1e-5)
