"""Networks of one output channel, which a sigmoid reads, as networks of two classes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from jaxmap.models.architecture import Architecture

ELSEWHERE, OTHERWISE = "background", "other"
"""The class where the network does not find its own, and its name where that is taken."""


def with_complement(
    architecture: Architecture, weights: Mapping[str, np.ndarray], elsewhere: str | None = None
) -> tuple[Architecture, dict[str, np.ndarray]]:
    """The same network with a second class, first in order, whose logit is zero.

    The softmax of (0, z) is (1 - sigmoid(z), sigmoid(z)): probabilities are the same, and the likelier class is the
    network's where z > 0.

    Args:
        architecture: of a network of one class.
        weights: its arrays by dotted path.
        elsewhere: name of the class where the network does not find its own.
    """
    (name,) = architecture.classes
    elsewhere = elsewhere or (OTHERWISE if name == ELSEWHERE else ELSEWHERE)
    classifier = {
        path: np.concatenate([np.zeros_like(value), value], axis=-1)
        for path, value in ((path, np.asarray(value)) for path, value in weights.items())
        if path.startswith("classifier.")
    }
    return replace(architecture, classes=(elsewhere, name)), {**weights, **classifier}
