"""The same numbers as the torch networks: given the same weights and image, the same logits."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest
from golden.seeded_weights import GOLDEN, seeded_image, seeded_state_of
from safetensors.numpy import save_file

from jaxmap.models.importers import import_weights
from jaxmap.models.network import inference_network

STEP = 3
QUICK = [("mobilenet_v2", 16, (64, 96))]
ALL = [
    (backbone, stride, size)
    for backbone in ("mobilenet_v2", "resnet18", "resnet50")
    for stride in (16, 8)
    for size in ((64, 96), (96, 128))
]


def seeded_checkpoint(backbone: str, path: Path) -> Path:
    """The same as a file."""
    save_file(seeded_state_of(backbone), path)
    return path


def check(backbone: str, stride: int, size: tuple[int, int], folder: Path) -> None:
    imported = import_weights(seeded_checkpoint(backbone, folder / "smp.safetensors"), output_stride=stride)
    network = inference_network(imported.architecture, imported.weights)
    logits = np.asarray(jax.jit(network.apply)(network.weights, seeded_image(*size)[None])[0])
    key = f"{backbone}_{stride}_{size[0]}x{size[1]}"
    with np.load(GOLDEN) as golden:
        expected, labels = golden[f"logits/{key}"], golden[f"labels/{key}"]
    np.testing.assert_allclose(logits[::STEP, ::STEP], expected, atol=1e-3, rtol=0)
    assert (logits.argmax(axis=-1) == labels).mean() >= 0.999


@pytest.mark.slow
@pytest.mark.parametrize(("backbone", "stride", "size"), QUICK)
def test_logits_equal_torch(backbone, stride, size, tmp_path):
    check(backbone, stride, size, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("backbone", "stride", "size"), [case for case in ALL if case not in QUICK])
def test_logits_equal_torch_at_other_strides_and_sizes(backbone, stride, size, tmp_path):
    check(backbone, stride, size, tmp_path)
