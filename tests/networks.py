"""A small network with seeded weights, for the tests of what uses networks."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

from golden.seeded_weights import seeded_weights

from jaxmap.models.architecture import torch_architecture
from jaxmap.models.checkpoint import SavedModel, save_model

NETWORK_CLASSES = ("sky", "sand", "gravel", "boulder", "rover")

SMALL = replace(
    # Of all backbones it compiles fastest.
    torch_architecture("resnet18", NETWORK_CLASSES),
    head_channels=8,
    low_level_channels=4,
    atrous_rates=(2,),
)

SEGMENTING = replace(SMALL, classes=("background", "sand", "rock"))
"""The same for three classes."""


@cache
def small_model() -> SavedModel:
    """The whole network, batch norm and all; every class wins somewhere."""
    weights = seeded_weights(SMALL)
    kernel = weights["classifier.kernel"]
    # Features are positive: without this one class would win everywhere.
    weights["classifier.kernel"] = 4 * (kernel - kernel.mean(axis=2, keepdims=True))
    return SavedModel(SMALL, weights, "network")


def write_small_model(path: Path, *, backbone_only: bool = False, shift: float = 0.0) -> Path:
    """Writes the model file; `shift` is added to the biases of the classes."""
    weights = dict(small_model().weights)
    weights["classifier.bias"] = weights["classifier.bias"] + shift
    if backbone_only:
        weights = {name: value for name, value in weights.items() if name.startswith("backbone.")}
    save_model(path, SMALL, weights, holds="backbone" if backbone_only else "network")
    return path
