"""MC-CNN's fast network as matching cost: one minus the cosine of learned features, halved.

Zbontar and LeCun 2016, "Stereo matching by training a convolutional neural network to compare image patches", section
3.2: five 3x3 convolutions see 11x11 pixels of an image; patches match as far as their normalised features point the
same way. Weights trained on Middlebury come with the PyPI package `mccnn` (CNES, Apache-2.0), dense (148,000 numbers)
and with depthwise separable convolutions (19,000); no part of that package runs here.
"""

from __future__ import annotations

import importlib.util
import itertools
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped
from safetensors.numpy import save_file

from jaxmap.errors import JaxmapError, UsageError
from jaxmap.matching.correlation import correlate
from jaxmap.models.convolutions import convolve
from jaxmap.models.tensor_files import read_tensors
from jaxmap.types import to_device

PACKAGED = "mc_cnn_fast_dw.onnx"
"""The weights of the package that are taken where no file is named: within 11x11 pixels the least to compute."""

_PREFIX, _MODULE = "conv_blocks.", "mc_cnn"
_LEAST_NORM = 1e-6
_MOST_CHANNELS, _MOST_LAYERS = 1024, 64


class Convolution(NamedTuple):
    """A convolution; one channel wide between channels, as `kernel` (K, K, 1, C), it is depthwise."""

    kernel: Float[Array, "K K G O"]
    bias: Float[Array, "O"]


CostNetwork = tuple[tuple[Convolution, ...], ...]
"""Layers of convolutions, a ReLU between the layers; every number is differentiable."""


def load_cost_network(path: Path | None = None) -> CostNetwork:
    """The network of a file of weights: `.pt` or `.safetensors` with the package's names, or `.onnx` (float32).

    Args:
        path: the file; by default `PACKAGED`, of the installed package.

    Raises:
        UsageError: no file is named, and the package, or what reads its file, is not installed.
        JaxmapError: the file is missing, broken, or holds another network.
    """
    path = packaged_weights() if path is None else path
    tensors = _read_onnx(path) if path.suffix.lower() == ".onnx" else read_tensors(path)
    # A checkpoint of the package holds the optimiser's state, too.
    named = {name.removeprefix("model.").removeprefix("module."): value for name, value in tensors.items()}
    return cost_network({name: value for name, value in named.items() if name.startswith(_PREFIX)}, path)


def cost_network(tensors: dict[str, np.ndarray], where: object) -> CostNetwork:
    """The network of tensors named as in a PyTorch `Sequential`: numbers that are left out are those of ReLUs.

    Args:
        tensors: `conv_blocks.N.weight` (O, I, K, K) and `conv_blocks.N.bias` (O).
        where: they come from, for errors.

    Raises:
        JaxmapError: they do not make a network from one channel to features.
    """
    numbers = sorted({int(name.split(".")[1]) for name in tensors if name.split(".")[1].isdecimal()})
    if not numbers or len(numbers) > _MOST_LAYERS:
        raise _other_network(f"{len(numbers)} convolutions {_PREFIX}N", where)
    layers: list[tuple[Convolution, ...]] = []
    channels = 1
    for before, number in itertools.pairwise([-2, *numbers]):
        convolution, channels = _convolution(tensors, number, channels, where)
        if number == before + 1:
            layers[-1] += (convolution,)
        elif number == before + 2:
            layers.append((convolution,))
        else:
            raise _other_network(f"nothing between {_PREFIX}{before} and {_PREFIX}{number}", where)
    if sum(part.kernel.shape[0] // 2 for layer in layers for part in layer) == 0:
        raise _other_network("no convolution that sees more than one pixel", where)
    return tuple(layers)


def save_cost_network(network: CostNetwork, path: Path) -> None:
    """Writes a network as safetensors, which `load_cost_network` reads."""
    tensors: dict[str, np.ndarray] = {}
    number = 0
    for layer in network:
        for kernel, bias in layer:
            name = f"{_PREFIX}{number}"
            tensors[f"{name}.weight"] = np.ascontiguousarray(np.asarray(kernel, np.float32).transpose(3, 2, 0, 1))
            tensors[f"{name}.bias"] = np.asarray(bias, np.float32)
            number += 1
        number += 1
    save_file(tensors, path)


def image_features(network: CostNetwork, image: Shaped[Array, "H W"]) -> Float[Array, "H W C"]:
    """Features of unit length of every pixel.

    Those of the package, whose image of features is smaller by what the network sees around a pixel; here the image is
    continued by its outermost pixels.

    Args:
        network: the weights.
        image: grey; its mean is taken away and its standard deviation made 1, so brightness and contrast do not matter.
    """
    with jax.named_scope("mccnn_features"):
        dtype = network[0][0].kernel.dtype
        grey = image.astype(dtype)
        variance = grey.var()
        # Of a blank image, too, there are gradients.
        grey = (grey - grey.mean()) * jax.lax.rsqrt(jnp.where(variance > 0, variance, 1.0))
        around = sum(part.kernel.shape[0] // 2 for layer in network for part in layer)
        values = jnp.pad(grey, around, mode="edge")[None, :, :, None]
        for number, layer in enumerate(network):
            values = jax.nn.relu(values) if number else values
            for kernel, bias in layer:
                depthwise = kernel.shape[2] != values.shape[-1]
                edge = kernel.shape[0] // 2
                whole = convolve(values, kernel, depthwise=depthwise)
                values = whole[:, edge : whole.shape[1] - edge, edge : whole.shape[2] - edge] + bias
        # Not the root of the sum alone: its gradient at zero, where no feature answers, would be infinite.
        square = (values * values).sum(axis=-1, keepdims=True)
        return (values * jax.lax.rsqrt(jnp.maximum(square, _LEAST_NORM**2)))[0]


def feature_costs(
    network: CostNetwork,
    left: Shaped[Array, "H W"],
    right: Shaped[Array, "H W"],
    min_disparity_px: int,
    num_disparities: int,
) -> Float[Array, "H W D"]:
    """Costs of matches, `(1 - cosine) / 2` between 0 and 1; beyond the right image, with its outermost column.

    Args:
        network: the weights.
        left: rectified grey image.
        right: likewise, of the same size.
        min_disparity_px: the first disparity.
        num_disparities: how many.
    """
    left_features, right_features = (image_features(network, image) for image in (left, right))
    with jax.named_scope("mccnn_costs"):
        cosine = correlate(left_features, right_features, min_disparity_px, num_disparities)
        return jnp.clip(0.5 - 0.5 * cosine, 0.0, 1.0)


def _convolution(tensors: dict[str, np.ndarray], number: int, channels: int, where: object) -> tuple[Convolution, int]:
    """One convolution for images of so many channels, and those that it gives."""
    name = f"{_PREFIX}{number}"
    try:
        weight, bias = tensors[f"{name}.weight"], tensors[f"{name}.bias"]
    except KeyError as missing:
        raise _other_network(f"no {missing.args[0]}", where) from None
    shape = weight.shape
    square = len(shape) == 4 and shape[2] == shape[3] and shape[2] % 2 == 1
    fits = square and (shape[1] == channels or (shape[1] == 1 and shape[0] == channels))
    if not fits or bias.shape != shape[:1] or not 1 <= shape[0] <= _MOST_CHANNELS:
        raise _other_network(f"{name} is {shape} with a bias {bias.shape}, from {channels} channels", where)
    for part, values in (("weight", weight), ("bias", bias)):
        if not np.isfinite(values).all():
            raise JaxmapError(f"{name}.{part} is not finite", where=where, fix="copy or download the file again")
    kernel = to_device(weight.transpose(2, 3, 1, 0), np.float32)
    return Convolution(kernel, to_device(bias, np.float32)), shape[0]


def packaged_weights() -> Path:
    """The file `PACKAGED` of the installed package.

    Raises:
        UsageError: it is not installed.
    """
    spec = importlib.util.find_spec(_MODULE)
    if spec is None or spec.origin is None:
        raise UsageError(
            "the cost network's weights are missing",
            where="--stereo.matcher mccnn",
            fix='pip install "jaxmap[mccnn]", or name a file of weights with --stereo.cost-network',
        )
    return Path(spec.origin).parent / "weights" / PACKAGED


def _read_onnx(path: Path) -> dict[str, np.ndarray]:
    """The float tensors that an ONNX graph holds, by name."""
    try:
        import onnx
        from onnx import numpy_helper
    except ImportError:
        raise UsageError(
            "an ONNX file is read by a package that is not installed", where=path, fix='pip install "jaxmap[mccnn]"'
        ) from None
    if not path.is_file():
        raise JaxmapError("no such file", where=path, fix="give a file of the cost network's weights")
    try:
        graph = onnx.load(str(path), load_external_data=False).graph
        held = [one for one in graph.initializer if one.data_type == onnx.TensorProto.FLOAT]
        return {one.name: numpy_helper.to_array(one) for one in held}
    except Exception as fault:
        # Damaged bytes make the parser raise any exception.
        reason = " ".join(str(fault).split())[:120] or type(fault).__name__
        raise JaxmapError(f"no whole ONNX file ({reason})", where=path, fix="copy or download it again") from fault


def _other_network(what: str, where: object) -> JaxmapError:
    return JaxmapError(
        f"another network than MC-CNN's fast one: {what}",
        where=where,
        fix="give mc_cnn_fast_dw.onnx or mc_cnn_fast_mb_weights.pt of the package mccnn",
    )
