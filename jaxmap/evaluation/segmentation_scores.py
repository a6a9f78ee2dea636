"""Scores of label images against masks: confusion, IoU, precision, recall, accuracy, calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxmap.errors import JaxmapError
from jaxmap.labels import ANY_OTHER, IGNORE

CALIBRATION_BINS = 15


@dataclass
class SegmentationScores:
    """Counts over any number of images; pixels that the mask ignores count nowhere.

    Attributes:
        classes: names in the order of the labels.
        confusion: pixels by true class (rows) and predicted class (columns).
        calibration: pixels, summed confidence and correct pixels for each bin of confidence.
        negated: the class that pixels labelled `ANY_OTHER` are not of; None where masks hold no such pixels.
        denied: of such pixels, those predicted to be of another class, and to be of that one. They count in the
            accuracy, and in the scores of the negated class; of the other classes nothing is known there.
        images: how many images were counted.
    """

    classes: tuple[str, ...]
    confusion: Int[np.ndarray, "C C"]
    calibration: Float[np.ndarray, "B 3"]
    negated: int | None
    denied: Int[np.ndarray, "2"]
    images: int = 0

    @classmethod
    def empty(cls, classes: Sequence[str], negated: int | None = None) -> SegmentationScores:
        """Scores of nothing yet."""
        count = len(classes)
        confusion, calibration = np.zeros((count, count), np.int64), np.zeros((CALIBRATION_BINS, 3))
        return cls(tuple(classes), confusion, calibration, negated, np.zeros(2, np.int64))

    def add(
        self,
        truth: UInt8[np.ndarray, "H W"],
        logits: Float[np.ndarray, "H W C"],
        where: object = "mask",
    ) -> None:
        """Counts one image.

        Raises:
            JaxmapError: the mask has another size than the logits, or labels that are no class.
        """
        if self.negated is not None:
            other = truth == ANY_OTHER
            self.denied += np.bincount(logits[other].argmax(axis=-1) == self.negated, minlength=2)
            truth = np.where(other, np.uint8(IGNORE), truth)
        check_mask(truth, logits.shape[:2], len(self.classes), where)
        known = truth != IGNORE
        labels, predicted = truth[known].astype(np.int64), logits[known].argmax(axis=-1)
        count = len(self.classes)
        self.confusion += np.bincount(labels * count + predicted, minlength=count * count).reshape(count, count)
        shifted = logits[known] - logits[known].max(axis=-1, keepdims=True)
        confidence = 1 / np.exp(shifted).sum(axis=-1)
        bins = np.minimum((confidence * CALIBRATION_BINS).astype(int), CALIBRATION_BINS - 1)
        for column, weight in enumerate((np.ones_like(confidence), confidence, labels == predicted)):
            self.calibration[:, column] += np.bincount(bins, weight, minlength=CALIBRATION_BINS)
        self.images += 1

    def summary(self) -> dict[str, Any]:
        """The scores as plain values; None where a quotient has nothing below its line.

        `ece` is the expected calibration error: the mean distance between confidence and accuracy,
        over 15 bins of confidence weighted by their pixels (Guo et al. 2017).
        """
        hits = np.diagonal(self.confusion)
        true, predicted, total = self.confusion.sum(axis=1), self.confusion.sum(axis=0), self.confusion.sum()
        if self.negated is not None:
            predicted[self.negated] += self.denied[1]
        ious = [_quotient(hits[index], true[index] + predicted[index] - hits[index]) for index in range(len(hits))]
        known = [iou for iou in ious if iou is not None]
        return {
            "accuracy": _quotient(hits.sum() + self.denied[0], total + self.denied.sum()),
            "mean_iou": float(np.mean(known)) if known else None,
            "classes": {
                name: {
                    "iou": ious[index],
                    "precision": _quotient(hits[index], predicted[index]),
                    "recall": _quotient(hits[index], true[index]),
                    "pixels": int(true[index]),
                }
                for index, name in enumerate(self.classes)
            },
            "confusion": self.confusion.tolist(),
            "calibration": self.calibration.tolist(),
            "ece": _quotient(abs(self.calibration[:, 1] - self.calibration[:, 2]).sum(), total),
            "images": self.images,
            "pixels": int(total + self.denied.sum()),
        }


def check_mask(truth: np.ndarray, size: tuple[int, ...], class_count: int, where: object) -> None:
    """Refuses a mask that does not belong to an image of `size` (height, width).

    Raises:
        JaxmapError: another size, or a label that is neither a class nor `IGNORE`.
    """
    if truth.shape != tuple(size):
        raise JaxmapError(
            f"the mask is {truth.shape[1]}x{truth.shape[0]} px, the image is {size[1]}x{size[0]} px",
            where=where,
            fix="give masks of the images' own size",
        )
    highest = int(truth[truth != IGNORE].max(initial=0))
    if highest >= class_count:
        raise JaxmapError(
            f"label {highest}, but there are {class_count} classes (and {IGNORE} for none)",
            where=where,
            fix="take the masks of the model's classes",
        )


def _quotient(above: float | np.number, below: float | np.number) -> float | None:
    return float(above / below) if below else None
