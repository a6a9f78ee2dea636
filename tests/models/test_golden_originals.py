"""The same numbers as torch networks of the TensorFlow and torchvision designs, and of the deepest backbones."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
from golden.seeded_weights import seeded_image, seeded_state
from safetensors.numpy import save_file

from jaxmap.models import import_tables as tables
from jaxmap.models.architecture import Architecture, tf_architecture
from jaxmap.models.import_tables import Row
from jaxmap.models.importers import convert, import_weights
from jaxmap.models.network import fold_batch_norm, pure_network

GOLDEN = Path(__file__).parent.parent / "golden" / "originals_golden.npz"
CLASSES = ("class_0", "class_1", "class_2")
STEP = 3
ATOL = 1e-4
"""They agree to 1e-6; another epsilon of the batch norms, say, already changes logits by 1e-3."""


def seeded_state_of(family: str, backbone: str) -> dict[str, np.ndarray]:
    """Seeded weights under the names of the torch network."""
    with np.load(GOLDEN) as golden:
        lines = str(golden[f"names/{family}_{backbone}"]).splitlines()
    return seeded_state({name: tuple(ast.literal_eval(shape)) for name, _, shape in (s.partition(" ") for s in lines)})


def block_row(ours: str, theirs: str) -> Row:
    return Row(ours, f"{theirs}.conv", f"{theirs}.norm")


def xception_rows() -> Iterator[Row]:
    modules = [*(f"entry_flow_{n}" for n in (1, 2, 3)), *(f"middle_flow_{n}" for n in range(1, 17))]
    for index in (0, 1):
        yield block_row(f"backbone.stem.{index}", f"backbone.conv1_{index + 1}")
    for unit, module in enumerate([*modules, "exit_flow_1", "exit_flow_2"]):
        for index in range(3):
            for half in ("depthwise", "pointwise"):
                yield block_row(
                    f"backbone.units.{unit}.convs.{index}.{half}", f"backbone.{module}.separable_conv{index + 1}_{half}"
                )
        if module.startswith(("entry", "exit_flow_1")):
            yield block_row(f"backbone.units.{unit}.shortcut", f"backbone.{module}.shortcut")


def tf_head_rows(architecture: Architecture) -> Iterator[Row]:
    yield block_row("aspp.pool", "image_pooling")
    yield block_row("aspp.point", "aspp0")
    yield block_row("aspp.project", "concat_projection")
    yield block_row("decoder.reduce", "feature_projection0")
    separable = {f"aspp.atrous.{index}": f"aspp{index + 1}" for index in range(len(architecture.atrous_rates))}
    separable |= {f"decoder.refine.{index}": f"decoder_conv{index}" for index in (0, 1)}
    for ours, theirs in separable.items():
        for half in ("depthwise", "pointwise"):
            yield block_row(f"{ours}.{half}", f"{theirs}_{half}")
    yield Row("classifier", "segmentation_head")


def tf_backbone_rows(backbone: str) -> list[Row]:
    if backbone == "xception65":
        return list(xception_rows())
    rows = tables.torchvision_backbone(backbone, "backbone.")
    return [row for row in rows if row.block != "backbone.top"]


def check(
    key: str, architecture: Architecture, weights: dict[str, np.ndarray], stride: int, size: tuple[int, int]
) -> None:
    network = pure_network(*fold_batch_norm(architecture, weights))
    logits = np.asarray(jax.jit(network.apply)(network.weights, seeded_image(*size)[None])[0])
    with np.load(GOLDEN) as golden:
        expected, labels = (golden[f"{kind}/{key}_{stride}_{size[0]}x{size[1]}"] for kind in ("logits", "labels"))
    assert np.bincount(labels.ravel(), minlength=3).min() > 100, "every class wins somewhere"
    np.testing.assert_allclose(logits[::STEP, ::STEP], expected, atol=ATOL, rtol=0)
    assert ((logits - logits.mean(axis=(0, 1))).argmax(axis=-1) == labels).mean() >= 0.999


@pytest.mark.parametrize(
    ("backbone", "stride"),
    [
        ("mobilenet_v2", 16),
        pytest.param("xception65", 16, marks=pytest.mark.slow),
        pytest.param("xception65", 8, marks=pytest.mark.slow),
        pytest.param("resnet101", 16, marks=pytest.mark.slow),
    ],
)
def test_logits_equal_the_tensorflow_design(backbone, stride):
    architecture = tf_architecture(backbone, CLASSES, output_stride=stride)
    rows = [*tf_backbone_rows(backbone), *tf_head_rows(architecture)]
    state = seeded_state_of("tf", backbone)
    weights = convert(state, rows, tables.TORCH, architecture, holds="network", where=backbone)
    check(f"tf_{backbone}", architecture, weights, stride, (65, 97))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("family", "backbone", "stride"),
    [("torchvision", "resnet50", 8), ("torchvision", "resnet101", 8), ("smp", "resnet101", 16)],
)
def test_logits_equal_torch_through_the_importer(family, backbone, stride, tmp_path):
    save_file(seeded_state_of(family, backbone), tmp_path / "a.safetensors")
    imported = import_weights(tmp_path / "a.safetensors")
    assert imported.holds == "network" and imported.architecture.output_stride == stride
    check(f"{family}_{backbone}", imported.architecture, imported.weights, stride, (64, 96))
