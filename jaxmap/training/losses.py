"""Loss terms of class logits against labels; pixels labelled `IGNORE` count in none of them.

Pixels labelled `ANY_OTHER` are of any class but one, the negated class: of them is known that this class is wrong.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxmap.errors import UsageError
from jaxmap.labels import ANY_OTHER, IGNORE
from jaxmap.training.options import PixelLossOptions

_EPSILON = 1e-6


def total_loss(
    logits: Float[Array, "*image C"],
    labels: UInt8[Array, "*image"],
    class_weights: Float[Array, "C"],
    options: PixelLossOptions,
    negated: int | None = None,
) -> Float[Array, ""]:
    """The weighted sum of the loss terms; 0 where no pixel is labelled.

    Args:
        logits: of the classes.
        labels: of the same pixels.
        class_weights: of the cross-entropy.
        options: the terms and their weights.
        negated: the class that pixels labelled `ANY_OTHER` are not of.
    """
    classes = logits.shape[-1]
    logits, labels = logits.reshape(-1, classes), labels.reshape(-1)
    truth = (labels[:, None] == jnp.arange(classes)).astype(logits.dtype)
    # Where the truth of a class is known: of all classes, or of the negated one alone.
    known = jnp.broadcast_to((labels != IGNORE)[:, None], truth.shape)
    possible = truth
    if negated is not None:
        other = (labels == ANY_OTHER)[:, None]
        known &= ~other | (jnp.arange(classes) == negated)
        possible = jnp.where(other, (jnp.arange(classes) != negated).astype(truth.dtype), truth)
    loss = jnp.zeros((), logits.dtype)
    if options.cross_entropy:
        entropy = cross_entropy(logits, possible, class_weights, label_smoothing=options.label_smoothing)
        loss += options.cross_entropy * entropy
    if options.soft_iou or options.lovasz:
        probabilities = jax.nn.softmax(logits) * known
        if options.soft_iou:
            loss += options.soft_iou * soft_iou_loss(probabilities, truth)
        if options.lovasz:
            loss += options.lovasz * lovasz_loss(probabilities, truth)
    return loss


def cross_entropy(
    logits: Float[Array, "N C"],
    possible: Float[Array, "N C"],
    class_weights: Float[Array, "C"],
    *,
    label_smoothing: float = 0.0,
) -> Float[Array, ""]:
    """Mean negative log-likelihood of the truth, each pixel weighted by its class.

    `possible` is 1 for the classes that a pixel may be of: one, all but one, or none where it is not labelled. The
    likelihood of several is the sum of their probabilities, their weight the mean.
    """
    count = possible.sum(axis=1)
    weights = (possible @ class_weights) / jnp.maximum(count, 1)
    logs = jax.nn.log_softmax(logits)
    # Nothing is subtracted from 1: the logarithm of a sum of exponentials is exact for small sums, too.
    sums = jax.nn.logsumexp(logs, axis=1, b=jnp.where(count[:, None] > 0, possible, 1))
    likelihood = (1 - label_smoothing) * sums + label_smoothing * logs.mean(axis=1)
    return -(likelihood * weights).sum() / jnp.maximum(weights.sum(), _EPSILON)


def correct(
    predicted: Int[Array, "*image"], labels: UInt8[Array, "*image"], negated: int | None
) -> Bool[Array, "*image"]:
    """Where a predicted class agrees with the label: is it, or is not the negated class."""
    right = predicted == labels
    return right if negated is None else right | ((labels == ANY_OTHER) & (predicted != negated))


def soft_iou_loss(probabilities: Float[Array, "N C"], truth: Float[Array, "N C"]) -> Float[Array, ""]:
    """One minus the intersection over union of probabilities, mean over the classes present.

    Both arguments are 0 where the truth of the class is not known (Rahman & Wang 2016).
    """
    ones = jnp.ones(len(truth), truth.dtype)
    # Sums over pixels as products: reductions over a leading axis are slow on a CPU.
    shared, area = ones @ (probabilities * truth), ones @ truth
    union = ones @ probabilities + area - shared
    return _mean_over_present(1 - (shared + _EPSILON) / (union + _EPSILON), area > 0)


def lovasz_loss(probabilities: Float[Array, "N C"], truth: Float[Array, "N C"]) -> Float[Array, ""]:
    """The Lovasz extension of the Jaccard loss, mean over the classes present (Berman et al. 2018).

    Both arguments are 0 where the truth of the class is not known: such a pixel adds no error.
    """

    def of_class(errors: Array, area: Array) -> Array:
        order = jnp.argsort(-errors)
        hits = jnp.cumsum(area[order])
        misses = jnp.cumsum(1 - area[order])
        total = hits[-1]
        jaccard = 1 - (total - hits) / jnp.maximum(total + misses, 1)
        steps = jnp.diff(jaccard, prepend=jnp.zeros(1, jaccard.dtype))
        return errors[order] @ steps

    losses = jax.vmap(of_class, in_axes=1)(jnp.abs(truth - probabilities), truth)
    return _mean_over_present(losses, truth.sum(axis=0) > 0)


def _mean_over_present(losses: Array, present: Array) -> Array:
    return (losses * present).sum() / jnp.maximum(present.sum(), 1)


def class_weights(options: PixelLossOptions, pixels: Int[np.ndarray, "C"]) -> Float[np.ndarray, "C"]:
    """The weight of each class in the cross-entropy, of mean 1.

    Args:
        options: the choice.
        pixels: training pixels of each class.

    Raises:
        UsageError: another number of weights than classes.
    """
    if options.class_weights == "equal":
        return np.ones(len(pixels), np.float32)
    if options.class_weights == "balanced":
        weights = 1 / np.sqrt(np.maximum(pixels, 1) / max(pixels.sum(), 1))
    else:
        weights = np.array(options.class_weights)
        if len(weights) != len(pixels):
            raise UsageError(
                f"{len(weights)} class weights for {len(pixels)} classes",
                where="loss.class_weights",
                fix="give one for each class",
            )
    return (weights / weights.mean()).astype(np.float32)
