"""DeepLabv3+ of segmentation_models_pytorch in torch, ONNX Runtime and OpenVINO: what our network is compared with.

    python scripts/benchmarks/networks.py [--backbone mobilenet_v2] [--size 384 512] [--threads 2] [--rounds 25]

prints our network with the compiled kernel and without it beside onnxruntime, all three with the same weights and in
turn: wall time, processor time, their ratios, and the greatest difference of the logits. Processor time of several
threads counts those of onnxruntime that wait by spinning; with `--threads 1` nobody waits. It needs torch,
segmentation_models_pytorch and onnx, which make the network and write it for onnxruntime, and that itself: all are in
the extra `bench`.
"""

from __future__ import annotations

import argparse
import copy
import io
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from harness import PAUSE_S, Run, is_absent, limit_threads

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


def ours_with_their_weights(backbone: str, images: np.ndarray, *, kernel: bool) -> Run:
    """The network as `jaxmap segment` runs it, with the weights of torch's; with or without the compiled kernel."""
    import jax
    from safetensors.numpy import save_file

    from jaxmap.models.importers import import_weights
    from jaxmap.models.network import inference_network

    os.environ["JAXMAP_NATIVE"] = "1" if kernel else "0"
    arrays = {name: array.numpy().copy() for name, array in torch_network(backbone).state_dict().items()}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "network.safetensors"
        save_file(arrays, path)
        imported = import_weights(path, classes=("first", "second", "third"))
    network = inference_network(imported.architecture, imported.weights)
    program = jax.jit(network.apply).lower(network.weights, images).compile()
    return lambda: np.asarray(program(network.weights, images))


def main() -> None:
    """Times the three in turn and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backbone", default="mobilenet_v2")
    parser.add_argument("--size", type=int, nargs=2, default=(384, 512), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=25)
    given = parser.parse_args()
    if absent := [module for module in PEERS["onnxruntime"][1] if is_absent(module)]:
        parser.error(f"not installed: {', '.join(absent)}; install jaxmap's extra `bench`")
    limit_threads(given.threads)
    images = np.random.default_rng(0).integers(0, 256, (1, *given.size, 3), np.uint8)
    session = onnx_session(given.backbone, images, given.threads)
    runs: dict[str, Callable[[], Any]] = {
        "with the kernel": ours_with_their_weights(given.backbone, images, kernel=True),
        "without": ours_with_their_weights(given.backbone, images, kernel=False),
        "onnxruntime": lambda: np.moveaxis(session()[0], 1, -1),
    }
    logits = {name: run() for name, run in runs.items()}
    times_ms: dict[str, list[tuple[float, float]]] = {name: [] for name in runs}
    for _ in range(given.rounds):
        for name, run in runs.items():
            time.sleep(PAUSE_S)
            wall_s, work_s = time.perf_counter(), time.process_time()
            run()
            times_ms[name].append((1e3 * (time.perf_counter() - wall_s), 1e3 * (time.process_time() - work_s)))
    medians = {
        name: [statistics.median(column) for column in zip(*times, strict=True)] for name, times in times_ms.items()
    }
    print(
        f"{given.backbone}, {given.size[0]} x {given.size[1]}, {given.threads} threads, load {os.getloadavg()[0]:.1f}"
    )
    print(f"{'':16s}{'wall, ms':>10s}{'least':>8s}{'processor, ms':>15s}{'least':>8s}{'difference':>12s}")
    theirs = medians["onnxruntime"]
    for name, (wall_ms, work_ms) in medians.items():
        least_wall_ms, least_work_ms = map(min, zip(*times_ms[name], strict=True))
        difference = np.abs(logits[name] - logits["onnxruntime"]).max()
        print(
            f"{name:16s}{wall_ms:10.1f}{least_wall_ms:8.1f}{work_ms:15.1f}{least_work_ms:8.1f}{difference:12.1e}"
            f"  of onnxruntime's: wall {wall_ms / theirs[0]:.2f}, processor {work_ms / theirs[1]:.2f}"
        )
    print(f"logits are up to {np.abs(logits['onnxruntime']).max():.1f}")


if __name__ == "__main__":
    main()
