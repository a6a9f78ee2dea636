"""Loss terms of class logits against labels; pixels labelled `IGNORE` count in none of them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxmap.errors import UsageError
from jaxmap.labels import IGNORE
from jaxmap.training.options import PixelLossOptions

_EPSILON = 1e-6


def total_loss(
    logits: Float[Array, "*image C"],
    labels: UInt8[Array, "*image"],
    class_weights: Float[Array, "C"],
    options: PixelLossOptions,
) -> Float[Array, ""]:
    """The weighted sum of the loss terms; 0 where no pixel is labelled."""
    classes = logits.shape[-1]
    logits, labels = logits.reshape(-1, classes), labels.reshape(-1)
    known = labels != IGNORE
    truth = (labels[:, None] == jnp.arange(classes)).astype(logits.dtype)
    loss = jnp.zeros((), logits.dtype)
    if options.cross_entropy:
        entropy = cross_entropy(logits, truth, known, class_weights, label_smoothing=options.label_smoothing)
        loss += options.cross_entropy * entropy
    if options.soft_iou or options.lovasz:
        probabilities = jax.nn.softmax(logits) * known[:, None]
        if options.soft_iou:
            loss += options.soft_iou * soft_iou_loss(probabilities, truth)
        if options.lovasz:
            loss += options.lovasz * lovasz_loss(probabilities, truth)
    return loss


def cross_entropy(
    logits: Float[Array, "N C"],
    truth: Float[Array, "N C"],
    known: Bool[Array, "N"],
    class_weights: Float[Array, "C"],
    *,
    label_smoothing: float = 0.0,
) -> Float[Array, ""]:
    """Mean negative log-likelihood of the true classes, each pixel weighted by its class."""
    target = truth * (1 - label_smoothing) + label_smoothing / truth.shape[1]
    weights = (truth @ class_weights) * known
    likelihood = (jax.nn.log_softmax(logits) * target).sum(axis=1)
    return -(likelihood * weights).sum() / jnp.maximum(weights.sum(), _EPSILON)


def soft_iou_loss(probabilities: Float[Array, "N C"], truth: Float[Array, "N C"]) -> Float[Array, ""]:
    """One minus the intersection over union of probabilities, mean over the classes present.

    Both arguments are 0 where the pixel is not labelled (Rahman & Wang 2016).
    """
    ones = jnp.ones(len(truth), truth.dtype)
    # Sums over pixels as products: reductions over a leading axis are slow on a CPU.
    shared, area = ones @ (probabilities * truth), ones @ truth
    union = ones @ probabilities + area - shared
    return _mean_over_present(1 - (shared + _EPSILON) / (union + _EPSILON), area > 0)


def lovasz_loss(probabilities: Float[Array, "N C"], truth: Float[Array, "N C"]) -> Float[Array, ""]:
    """The Lovasz extension of the Jaccard loss, mean over the classes present (Berman et al. 2018).

    Both arguments are 0 where the pixel is not labelled: such a pixel adds no error.
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
