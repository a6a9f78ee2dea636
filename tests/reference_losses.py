"""The losses of training, written out: slow, and plain to read."""

from __future__ import annotations

import numpy as np

from jaxmap.labels import IGNORE


def softmax(logits: np.ndarray) -> np.ndarray:
    raised = np.exp(logits - logits.max(axis=-1, keepdims=True))
    return raised / raised.sum(axis=-1, keepdims=True)


def cross_entropy(logits: np.ndarray, labels: np.ndarray, class_weights: np.ndarray, smoothing: float) -> float:
    """Weighted mean over the labelled pixels of the cross-entropy with a smoothed truth."""
    total = weight = 0.0
    for values, label in zip(softmax(logits), labels, strict=True):
        if label == IGNORE:
            continue
        target = np.full(len(values), smoothing / len(values))
        target[label] += 1 - smoothing
        total -= class_weights[label] * (target * np.log(values)).sum()
        weight += class_weights[label]
    return total / weight if weight else 0.0


def soft_iou_loss(logits: np.ndarray, labels: np.ndarray) -> float:
    """One minus intersection over union of probabilities; mean over the classes that the labels hold."""
    known = labels != IGNORE
    losses = []
    for index in range(logits.shape[1]):
        truth, share = labels[known] == index, softmax(logits)[known, index]
        if truth.any():
            intersection = (share * truth).sum()
            losses.append(1 - intersection / (share.sum() + truth.sum() - intersection))
    return float(np.mean(losses)) if losses else 0.0


def jaccard_loss(missed: np.ndarray, truth: np.ndarray) -> float:
    """One minus intersection over union of a class that is predicted wrongly at the pixels `missed`."""
    predicted = truth ^ missed
    return 1 - (predicted & truth).sum() / (predicted | truth).sum()


def lovasz_loss(logits: np.ndarray, labels: np.ndarray) -> float:
    """The Lovasz extension as its definition has it: a sum over the sets of the largest errors."""
    known = labels != IGNORE
    losses = []
    for index in range(logits.shape[1]):
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
