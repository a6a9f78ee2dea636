"""DeepLabv3+ of segmentation_models_pytorch in torch, ONNX Runtime and OpenVINO: what our network is compared with."""

from __future__ import annotations

import copy
import io
import sys
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from harness import Run

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@cache
def torch_network(backbone: str) -> Any:
    """The network in torch with three classes and initial weights; its batch norms know the scale of their inputs."""
    import segmentation_models_pytorch
    import torch

    torch.manual_seed(0)
    network = segmentation_models_pytorch.DeepLabV3Plus(backbone, encoder_weights=None, classes=3)
    norms = [module for module in network.modules() if isinstance(module, torch.nn.BatchNorm2d)]
    # Without this, features would fade to denormal numbers, with which torch is several times slower.
    for norm in norms:
        norm.momentum = 1.0
    with torch.no_grad():
        network(torch.randn(2, 3, 128, 128))
    for norm in norms:
        norm.momentum = 0.1
    return network.eval()


def torch_images(images: np.ndarray) -> Any:
    """Normalised images (B, 3, H, W) of uint8 (B, H, W, 3)."""
    import torch

    scaled = (torch.from_numpy(images).float() / 255 - torch.tensor(MEAN)) / torch.tensor(STD)
    return scaled.permute(0, 3, 1, 2).contiguous()


def torch_eager(backbone: str, images: np.ndarray, threads: int) -> Run:
    """Torch, with channels last in memory, its faster order."""
    import torch

    torch.set_num_threads(threads)
    network = torch_network(backbone).to(memory_format=torch.channels_last)
    inputs = torch_images(images).to(memory_format=torch.channels_last)

    def run() -> object:
        with torch.inference_mode():
            return network(inputs)

    return run


def onnx_session(backbone: str, images: np.ndarray, threads: int) -> Run:
    """ONNX Runtime."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    session = onnxruntime.InferenceSession(_onnx(backbone, images), options, providers=["CPUExecutionProvider"])
    given = {"image": torch_images(images).numpy()}
    return lambda: session.run(None, given)


def openvino_request(backbone: str, images: np.ndarray, threads: int) -> Run:
    """OpenVINO, in float32."""
    # Without the package that does so, its import reports nothing over the network.
    sys.modules.setdefault("openvino_telemetry", None)  # pyright: ignore[reportArgumentType]
    import openvino

    core = openvino.Core()
    model = core.read_model(io.BytesIO(_onnx(backbone, images)))
    hints = {"INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": "f32", "PERFORMANCE_HINT": "LATENCY"}
    request = core.compile_model(model, "CPU", hints).create_infer_request()
    given = {"image": torch_images(images).numpy()}
    return lambda: request.infer(given)


def _onnx(backbone: str, images: np.ndarray) -> bytes:
    import torch

    content, network = io.BytesIO(), torch_network(backbone).to(memory_format=torch.contiguous_format)
    names = {"input_names": ["image"], "output_names": ["logits"]}
    torch.onnx.export(network, (torch_images(images),), content, dynamo=False, **names)
    return content.getvalue()


TORCH = ("torch", "segmentation_models_pytorch")
PEERS: dict[str, tuple[Callable[[str, np.ndarray, int], Run], tuple[str, ...]]] = {
    "torch channels-last": (torch_eager, TORCH),
    "onnxruntime": (onnx_session, (*TORCH, "onnx", "onnxruntime")),
    "openvino f32": (openvino_request, (*TORCH, "onnx", "openvino")),
}
"""How to prepare each peer for a backbone, images uint8 (B, H, W, 3) and threads; and the modules that it needs."""


def training_step(layout: str, images: np.ndarray, labels: np.ndarray, threads: int) -> Run:
    """Forward, backward and AdamW of MobileNetV2 in torch, without dropout, in one order of memory."""
    import torch

    torch.set_num_threads(threads)
    order = getattr(torch, layout)
    inputs, truth = torch_images(images).contiguous(memory_format=order), torch.from_numpy(labels).long()
    network = copy.deepcopy(torch_network("mobilenet_v2")).train().to(memory_format=order)
    for module in network.modules():
        if isinstance(module, torch.nn.Dropout):
            module.p = 0.0
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3, weight_decay=1e-4)

    def run() -> float:
        optimiser.zero_grad()
        loss = torch.nn.functional.cross_entropy(network(inputs), truth)
        loss.backward()
        optimiser.step()
        return loss.item()

    return run
