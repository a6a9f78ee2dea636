"""DeepLabv3+ in torch, ONNX Runtime and OpenVINO, with the same weights: what our network is held against."""

from __future__ import annotations

import importlib.util
import io
import sys
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np

from benchmarks.harness import Run

MODULES: dict[str, tuple[str, ...]] = {
    "torch channels-last": ("torch",),
    "onnxruntime": ("torch", "onnx", "onnxruntime"),
    "openvino f32": ("torch", "onnx", "openvino"),
}
"""The peers by name, and what each needs: torch makes the ONNX file."""


class NetworkPeers:
    """One network in the libraries that are installed; each run takes the normalised image and gives logits.

    Args:
        backbone: of the network.
        state: weights under the names of segmentation_models_pytorch.
        image: uint8 (1, H, W, 3).
        threads: of each library.
    """

    def __init__(self, backbone: str, state: Mapping[str, np.ndarray], image: np.ndarray, threads: int) -> None:
        """Keeps what the peers are made of."""
        self.backbone, self.state, self.image, self.threads = backbone, state, image, threads

    def makers(self) -> dict[str, Callable[[], Run]]:
        """How to prepare each peer, by name."""
        return dict(zip(MODULES, (self.torch_eager, self.onnx_session, self.openvino_request), strict=True))

    def installed(self) -> dict[str, Run]:
        """The peers whose libraries are there, prepared."""
        there = {name: all(map(importlib.util.find_spec, modules)) for name, modules in MODULES.items()}
        return {name: make() for name, make in self.makers().items() if there[name]}

    def torch_eager(self) -> Run:
        """Torch, with channels last in memory, its faster order."""
        import torch

        network = self._network.to(memory_format=torch.channels_last)
        inputs = self._inputs.to(memory_format=torch.channels_last)

        def run() -> object:
            with torch.inference_mode():
                return network(inputs)

        return run

    def onnx_session(self) -> Run:
        """ONNX Runtime."""
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = self.threads
        session = onnxruntime.InferenceSession(self._onnx, options, providers=["CPUExecutionProvider"])
        given = {"image": self._inputs.numpy()}
        return lambda: session.run(None, given)

    def openvino_request(self) -> Run:
        """OpenVINO, in float32."""
        # It would report its import over the network, from a fork; without the package that does so, it does not.
        sys.modules.setdefault("openvino_telemetry", None)  # pyright: ignore[reportArgumentType]
        import openvino

        core = openvino.Core()
        model = core.read_model(io.BytesIO(self._onnx))
        hints = {
            "INFERENCE_NUM_THREADS": self.threads,
            "INFERENCE_PRECISION_HINT": "f32",
            "PERFORMANCE_HINT": "LATENCY",
        }
        request = core.compile_model(model, "CPU", hints).create_infer_request()
        given = {"image": self._inputs.numpy()}
        return lambda: request.infer(given)

    @cached_property
    def _network(self) -> Any:
        import torch
        from golden.torch_deeplab import DeepLabV3Plus

        torch.set_num_threads(self.threads)
        network = DeepLabV3Plus(self.backbone).eval()
        network.load_state_dict({name: torch.from_numpy(value) for name, value in self.state.items()})
        return network

    @cached_property
    def _inputs(self) -> Any:
        import torch
        from golden.make_smp_golden import MEAN, STD

        scaled = (torch.from_numpy(self.image).float() / 255 - torch.tensor(MEAN)) / torch.tensor(STD)
        return scaled.permute(0, 3, 1, 2).contiguous()

    @cached_property
    def _onnx(self) -> bytes:
        import torch

        content, network = io.BytesIO(), self._network.to(memory_format=torch.contiguous_format)
        torch.onnx.export(
            network, (self._inputs,), content, input_names=["image"], output_names=["logits"], dynamo=False
        )
        return content.getvalue()
