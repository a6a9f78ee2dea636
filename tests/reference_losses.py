"""The losses of training, written out: slow, and plain to read."""

from __future__ import annotations

import numpy as np

from jaxmap.labels import ANY_OTHER, IGNORE


def softmax(logits: np.ndarray) -> np.ndarray:
    raised = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return raised / raised.sum(axis=-1, keepdims=True)


def cross_entropy(
    logits: np.ndarray, labels: np.ndarray, class_weights: np.ndarray, smoothing: float, negated: int
) -> float:
    """Weighted mean over the labelled pixels of the cross-entropy with a smoothed truth."""
    total = weight = 0.0
    for values, label in zip(softmax(logits), labels, strict=True):
        if label == IGNORE:
            continue
        possible = [index for index in range(len(values)) if index != negated] if label == ANY_OTHER else [label]
        likelihood = (1 - smoothing) * np.log(values[possible].sum()) + smoothing * np.log(values).mean()
        total -= class_weights[possible].mean() * likelihood
        weight += class_weights[possible].mean()
    return total / weight if weight else 0.0


def known_of(labels: np.ndarray, index: int, negated: int) -> np.ndarray:
    """Where it is known whether a pixel is of a class."""
    return (labels != IGNORE) & ((labels != ANY_OTHER) | (index == negated))


def soft_iou_loss(logits: np.ndarray, labels: np.ndarray, negated: int) -> float:
    """One minus intersection over union of probabilities; mean over the classes that the labels hold."""
    losses = []
    for index in range(logits.shape[1]):
        known = known_of(labels, index, negated)
        truth, share = labels[known] == index, softmax(logits)[known, index]
        if truth.any():
            intersection = (share * truth).sum()
            losses.append(1 - intersection / (share.sum() + truth.sum() - intersection))
    return float(np.mean(losses)) if losses else 0.0


def jaccard_loss(missed: np.ndarray, truth: np.ndarray) -> float:
    """One minus intersection over union of a class that is predicted wrongly at the pixels `missed`."""
    predicted = truth ^ missed
    return 1 - (predicted & truth).sum() / (predicted | truth).sum()


def lovasz_loss(logits: np.ndarray, labels: np.ndarray, negated: int) -> float:
    """The Lovasz extension as its definition has it: a sum over the sets of the largest errors."""
    losses = []
    for index in range(logits.shape[1]):
        known = known_of(labels, index, negated)
        truth = labels[known] == index
        if not truth.any():
            continue
        errors = np.abs(truth - softmax(logits)[known, index])
        missed, reached, loss = np.zeros(len(truth), bool), 0.0, 0.0
        for pixel in np.argsort(-errors, kind="stable"):
            missed[pixel] = True
            value = jaccard_loss(missed, truth)
            loss += errors[pixel] * (value - reached)
            reached = value
        losses.append(loss)
    return float(np.mean(losses)) if losses else 0.0
