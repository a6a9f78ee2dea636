"""Compares the networks' logits with those of segmentation_models_pytorch, given the same weights and images.

    python scripts/experiments/fidelity.py [--backbones mobilenet_v2 resnet18] [--sizes 384x512 352x1216]

Needs torch and segmentation_models_pytorch (extra `bench`). Prints one table: the greatest difference of the logits and
the share of pixels of the same class. Weights are random, with batch norms near the identity, so that features keep
their scale through all layers. The tests do the same at small sizes, from a golden file.
"""

from __future__ import annotations

import tempfile
from itertools import product
from pathlib import Path
from typing import Any

import jax
import numpy as np
from common import Table, command_line, parse

from jaxmap.models.architecture import IMAGENET_MEAN, IMAGENET_STD
from jaxmap.models.importers import import_weights
from jaxmap.models.network import inference_network


def random_network(backbone: str, stride: int) -> Any:
    """DeepLabv3+ in torch with three classes and random weights."""
    import segmentation_models_pytorch
    import torch

    torch.manual_seed(0)
    network = segmentation_models_pytorch.DeepLabV3Plus(
        backbone, encoder_weights=None, encoder_output_stride=stride, classes=3
    ).eval()
    for name, tensor in network.state_dict().items():
        if name.endswith("running_var"):
            tensor.uniform_(0.8, 1.2)
        elif name.endswith(("running_mean", "bias")):
            tensor.normal_(0, 0.1)
        elif tensor.ndim == 1:
            tensor.uniform_(0.5, 0.9)
        elif tensor.ndim == 4:
            tensor.normal_(0, float(np.sqrt(2 / tensor[0].numel())))
        if name == "segmentation_head.0.weight":
            # Features are positive: without this one class would win everywhere.
            tensor.sub_(tensor.mean(dim=1, keepdim=True)).mul_(4)
    return network


def main() -> None:
    """Prints a line for each network, stride and size."""
    parser = command_line(__doc__)
    parser.add_argument("--backbones", nargs="+", default=["mobilenet_v2", "resnet18", "resnet50"])
    parser.add_argument("--strides", nargs="+", type=int, default=[16, 8])
    parser.add_argument("--sizes", nargs="+", default=["384x512", "512x512", "352x1216"])
    given = parse(parser)
    import torch
    from safetensors.torch import save_file

    table = Table(
        {"network": "<14", "stride": "7d", "size": "10d", "greatest difference": "21.1e", "same class": "12.3%"}
    )
    for backbone, stride in product(given.backbones, given.strides):
        theirs = random_network(backbone, stride)
        with tempfile.TemporaryDirectory() as folder:
            save_file(theirs.state_dict(), Path(folder) / "smp.safetensors")
            imported = import_weights(Path(folder) / "smp.safetensors", output_stride=stride)
        ours = inference_network(imported.architecture, imported.weights)
        for size in given.sizes:
            height, width = map(int, size.split("x"))
            rng = np.random.default_rng([height, width])
            # Blocks of colour under noise, so that classes differ from place to place.
            blocks = rng.integers(0, 256, (-(-height // 16), -(-width // 16), 3)).repeat(16, axis=0).repeat(16, axis=1)
            image = (blocks[:height, :width] + rng.normal(0, 20, (height, width, 3))).clip(0, 255).astype(np.uint8)
            scaled = ((image / np.float32(255) - IMAGENET_MEAN) / IMAGENET_STD).astype(np.float32)
            with torch.inference_mode():
                expected = theirs(torch.from_numpy(scaled.transpose(2, 0, 1)[None]))[0].numpy().transpose(1, 2, 0)
            logits = np.asarray(jax.jit(ours.apply)(ours.weights, image[None])[0])
            same = float((logits.argmax(-1) == expected.argmax(-1)).mean())
            table.row(backbone, stride, size, float(np.abs(logits - expected).max()), same)


if __name__ == "__main__":
    main()
