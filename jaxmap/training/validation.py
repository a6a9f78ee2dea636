"""Validation of a network on images that it is not trained on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, UInt8

from jaxmap.datasets.masks import MaskLookup
from jaxmap.errors import JaxmapError
from jaxmap.evaluation.segmentation_scores import SegmentationScores
from jaxmap.labels import ANY_OTHER, IGNORE
from jaxmap.models.architecture import Architecture
from jaxmap.models.network import Weights, fold_batch_norm, pure_network
from jaxmap.training.data import Example, read_example
from jaxmap.training.relief import read_relief

MAX_EXAMPLES = 6
"""Images of a validation that are kept for the report."""


class ValidationExample(NamedTuple):
    """An image, its true labels, and those of the network."""

    name: str
    image: UInt8[np.ndarray, "H W 3"]
    truth: UInt8[np.ndarray, "H W"]
    prediction: UInt8[np.ndarray, "H W"]


class Validation(NamedTuple):
    """The result of one validation.

    Attributes:
        summary: as `SegmentationScores.summary`.
        loss: mean negative log-likelihood of the labelled pixels; None where there are none.
        examples: some of the images, spread evenly over all.
    """

    summary: dict
    loss: float | None
    examples: tuple[ValidationExample, ...]


class ImageValidator:
    """Scores weights on images at their own size; compiled once for each size.

    Args:
        architecture: of the network.
        examples: the images.
        lookup: from the pixels of their masks to labels.
    """

    def __init__(self, architecture: Architecture, examples: Sequence[Example], lookup: MaskLookup) -> None:
        self._architecture, self._examples, self._lookup = architecture, examples, lookup
        # Two jitted functions: inside one, XLA would fold the batch norms anew for every image.
        self._fold = jax.jit(lambda weights: fold_batch_norm(architecture, weights)[1])
        self._run: object = None

    def score(self, weights: Weights) -> Validation:
        """Scores weights, running statistics included.

        Raises:
            JaxmapError: an image cannot be read any more, or the network's output for it is not finite.
        """
        folded = self._fold(weights)
        if self._run is None:
            architecture, _ = fold_batch_norm(self._architecture, weights)
            self._run = jax.jit(pure_network(architecture, folded).apply)
        negated, losses, pixels, examples = self._lookup.negated, 0.0, 0, []
        scores = SegmentationScores.empty(self._architecture.classes, negated)
        places = set(np.linspace(0, len(self._examples) - 1, MAX_EXAMPLES).round().astype(int).tolist())
        for place, example in enumerate(self._examples):
            image, truth = read_example(example, self._lookup)
            relief = read_relief(example)[None] if self._architecture.relief_channels else None
            logits = np.asarray(self._run(folded, image[None], relief)[0])  # type: ignore[operator]
            if not np.isfinite(logits).all():
                raise JaxmapError(
                    "the network's output for a validation image is not finite",
                    where=example.image,
                    fix="take a lower optimiser.learning-rate and start anew",
                )
            scores.add(truth, logits, example.mask)
            summed, counted = _negative_log_likelihood(logits, truth, negated)
            losses, pixels = losses + summed, pixels + counted
            if place in places:
                examples.append(ValidationExample(example.name, image, truth, logits.argmax(axis=-1).astype(np.uint8)))
        return Validation(scores.summary(), losses / pixels if pixels else None, tuple(examples))


def _negative_log_likelihood(
    logits: Float[np.ndarray, "H W C"], truth: UInt8[np.ndarray, "H W"], negated: int | None
) -> tuple[float, int]:
    """Its sum over the labelled pixels, and their number."""
    known = (truth != IGNORE) & (truth != ANY_OTHER)
    values = logits[known]
    true = np.take_along_axis(values, truth[known].astype(np.int64)[:, None], axis=1)[:, 0]
    summed, other = (_log_sum(values) - true).sum(), truth == ANY_OTHER
    if negated is not None:
        summed += (_log_sum(logits[other]) - _log_sum(np.delete(logits[other], negated, axis=1))).sum()
    return float(summed), int(known.sum() + other.sum())


def _log_sum(logits: Float[np.ndarray, "N C"]) -> Float[np.ndarray, "N"]:
    """The logarithm of the summed exponentials."""
    highest = logits.max(axis=-1, keepdims=True)
    return np.log(np.exp(logits - highest).sum(axis=-1)) + highest[:, 0]
