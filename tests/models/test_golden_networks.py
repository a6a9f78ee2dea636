"""The same numbers as torchvision's own FCN, segmentation_models_pytorch's own Unet and a SegNet of torch's layers."""

from __future__ import annotations

import ast
from pathlib import Path

import jax
import numpy as np
import pytest
from golden.seeded_weights import seeded_image, seeded_state
from safetensors.numpy import save_file

from jaxmap.errors import JaxmapError
from jaxmap.models.architecture import torch_architecture
from jaxmap.models.checkpoint import check_weights
from jaxmap.models.import_tables import TORCH, Row
from jaxmap.models.importers import import_weights
from jaxmap.models.network import inference_network

GOLDEN = Path(__file__).parent.parent / "golden" / "networks_golden.npz"
SIZE, STEP = (64, 96), 3


def state_of(key: str) -> dict[str, np.ndarray]:
    """Seeded weights under the names of the torch network."""
    with np.load(GOLDEN) as golden:
        lines = str(golden[f"names/{key}"]).splitlines()
    return seeded_state(
        {name: tuple(ast.literal_eval(shape)) for name, _, shape in (line.partition(" ") for line in lines)}
    )


def checkpoint(key: str, path: Path, **changes: np.ndarray) -> Path:
    """The same as a file."""
    save_file(state_of(key) | changes, path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "name", "stride"),
    [
        ("unet_mobilenet_v2", "U-Net", 32),
        ("unet_resnet18", "U-Net", 32),
        ("unet_resnet50", "U-Net", 32),
        ("fcn_resnet50", "FCN", 8),
    ],
)
def test_logits_equal_those_of_torch(key, name, stride, tmp_path):
    imported = import_weights(checkpoint(key, tmp_path / "a.safetensors"))
    assert (imported.architecture.name, imported.architecture.output_stride) == (name, stride)
    assert imported.holds == "network" and name.replace("-", "").lower() in imported.source.lower()
    network = inference_network(imported.architecture, imported.weights)
    logits = np.asarray(jax.jit(network.apply)(network.weights, seeded_image(*SIZE)[None])[0])
    with np.load(GOLDEN) as golden:
        expected, labels = golden[f"logits/{key}"], golden[f"labels/{key}"]
    np.testing.assert_allclose(logits[::STEP, ::STEP], expected, atol=1e-3, rtol=0)
    assert ((logits - logits.mean(axis=(0, 1))).argmax(axis=-1) == labels).mean() >= 0.999


@pytest.mark.slow
def test_logits_of_segnet_equal_those_of_torch_and_its_encoder_is_imported(tmp_path):
    state = state_of("segnet_vgg16")
    save_file(
        {name: value for name, value in state.items() if name.startswith("features.")}, tmp_path / "a.safetensors"
    )
    imported = import_weights(tmp_path / "a.safetensors")
    assert imported.holds == "backbone" and imported.architecture.backbone == "vgg16"
    weights = dict(imported.weights)
    rows = [
        Row(f"decoder.{step}.{index}", f"decoder.{step}.{index}.0", f"decoder.{step}.{index}.1")
        for step, count in enumerate((2, 2, 2, 2, 1))
        for index in range(count)
    ]
    for row in [*rows, Row("classifier", "classifier")]:
        weights[f"{row.block}.kernel"] = state[f"{row.convolution}.weight"].transpose(TORCH.transpose)
        for leaf, suffix in TORCH.norm.items() if row.norm else ():
            weights[f"{row.block}.norm.{leaf}"] = state[f"{row.norm}{suffix}"]
    weights["classifier.bias"] = state["classifier.bias"]
    record = torch_architecture("vgg16", ("a", "b", "c"), kind="segnet")
    check_weights(record, weights, where="segnet")
    network = inference_network(record, weights)
    logits = np.asarray(jax.jit(network.apply)(network.weights, seeded_image(*SIZE)[None])[0])
    with np.load(GOLDEN) as golden:
        np.testing.assert_allclose(logits[::STEP, ::STEP], golden["logits/segnet_vgg16"], atol=1e-5, rtol=0)


def test_an_attention_that_is_not_ours_and_another_stride_are_refused(tmp_path):
    weight = np.zeros((16, 4, 1, 1), np.float32)
    file = checkpoint("unet_resnet18", tmp_path / "a.safetensors", **{"decoder.blocks.0.attention1.weight": weight})
    with pytest.raises(JaxmapError, match=r"1 left over: decoder\.blocks\.0\.attention1\.weight"):
        import_weights(file)
    with pytest.raises(JaxmapError, match="U-Net at output stride 16"):
        import_weights(checkpoint("unet_resnet18", tmp_path / "b.safetensors"), output_stride=16)


def test_an_auxiliary_classifier_is_left_out_and_one_output_becomes_two_classes(tmp_path):
    extra = {"aux_classifier.0.weight": np.zeros((256, 1024, 3, 3), np.float32)}
    kernel = np.ones((1, 512, 1, 1), np.float32)
    extra |= {"classifier.4.weight": kernel, "classifier.4.bias": np.ones(1, np.float32)}
    imported = import_weights(checkpoint("fcn_resnet50", tmp_path / "a.safetensors", **extra), classes=["rock"])
    assert imported.architecture.classes == ("background", "rock")
    assert imported.weights["classifier.0.kernel"].shape == (1, 1, 512, 2)
    np.testing.assert_array_equal(imported.weights["classifier.0.bias"], [0, 1])
