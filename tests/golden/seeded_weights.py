"""Weights and images that a seed and a name make, so that golden files need not carry them."""

from __future__ import annotations

import ast
import zlib
from functools import lru_cache
from pathlib import Path

import numpy as np

GOLDEN = Path(__file__).with_name("smp_golden.npz")


def _generator(name: str) -> np.random.Generator:
    return np.random.default_rng(zlib.crc32(name.encode()))


def seeded_tensor(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """A tensor of a torch state dict: float32 by its name alone; counters are int64 zeros.

    Norms stay near the identity and shrink a little, so that fifty layers neither blow up nor fade.
    """
    draw = _generator(name)
    if name.endswith("num_batches_tracked"):
        return np.zeros(shape, np.int64)
    if name.endswith("running_var"):
        return draw.uniform(0.8, 1.2, shape).astype(np.float32)
    if name.endswith(("running_mean", "bias")):
        return draw.normal(0, 0.1, shape).astype(np.float32)
    if len(shape) == 1:
        return draw.uniform(0.5, 0.9, shape).astype(np.float32)
    fan_in = int(np.prod(shape[1:]))
    kernel = draw.normal(0, np.sqrt(2 / fan_in), shape)
    if name.startswith(("segmentation_head", "classifier.4.")):
        # Features are positive: without this one class would win everywhere.
        kernel = 4 * (kernel - kernel.mean(axis=1, keepdims=True))
    return kernel.astype(np.float32)


def seeded_state(names: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """A whole state dict."""
    return {name: seeded_tensor(name, shape) for name, shape in names.items()}


def seeded_state_of(backbone: str) -> dict[str, np.ndarray]:
    """A state dict of segmentation_models_pytorch's form with seeded weights."""
    with np.load(GOLDEN) as golden:
        lines = str(golden[f"names/{backbone}"]).splitlines()
    return seeded_state({name: ast.literal_eval(shape) for name, _, shape in (line.partition(" ") for line in lines)})


def seeded_image(height: int, width: int) -> np.ndarray:
    """uint8 (H, W, 3): blocks of colour under noise, so that classes differ from place to place."""
    draw = _generator(f"image {height}x{width}")
    blocks = draw.integers(0, 256, (-(-height // 16), -(-width // 16), 3))
    image = np.kron(blocks, np.ones((16, 16, 1)))[:height, :width] + draw.normal(0, 20, (height, width, 3))
    return image.clip(0, 255).astype(np.uint8)


def seeded_weights(architecture) -> dict[str, np.ndarray]:
    """Weights of one of our own networks, by our names."""
    return dict(_seeded_weights(architecture))


@lru_cache(maxsize=3)
def _seeded_weights(architecture) -> dict[str, np.ndarray]:
    from jaxmap.models.network import weight_shapes

    def tensor(name: str, shape: tuple[int, ...]) -> np.ndarray:
        if len(shape) == 4:
            return seeded_tensor(name, shape[::-1]).transpose()
        return seeded_tensor(name.replace(".norm.mean", ".running_mean").replace(".norm.var", ".running_var"), shape)

    return {name: tensor(name, shape) for name, shape in weight_shapes(architecture).items()}


def exported(architecture, rows, naming, weights=None) -> dict[str, np.ndarray]:
    """Weights of ours, by default the seeded ones, as the source would name and lay them out."""
    weights, result = seeded_weights(architecture) if weights is None else weights, {}
    back = np.argsort(naming.transpose)
    for row in rows:
        result[row.convolution + naming.kernel] = np.ascontiguousarray(weights[f"{row.block}.kernel"].transpose(back))
        if f"{row.block}.bias" in weights:
            result[row.convolution + naming.bias] = weights[f"{row.block}.bias"]
        for leaf, suffix in naming.norm.items() if row.norm else ():
            result[row.norm + suffix] = weights[f"{row.block}.norm.{leaf}"]
            result[f"{row.norm}.num_batches_tracked"] = np.zeros((), np.int64)
    return result
