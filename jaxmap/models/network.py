"""Segmentation networks of every kind: made, filled with weights, as pure functions, and with batch norm folded."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache
from types import MappingProxyType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from jaxmap.models.architecture import Architecture, folded
from jaxmap.models.base import Images, Network, Relief
from jaxmap.models.convolutions import winograd_kernel
from jaxmap.models.deeplab import DeepLab
from jaxmap.models.fcn import Fcn
from jaxmap.models.layers import ConvBlock
from jaxmap.models.segnet import SegNet
from jaxmap.models.unet import UNet
from jaxmap.types import to_device

KINDS: dict[str, Callable[[Architecture], Network]] = {"deeplab": DeepLab, "fcn": Fcn, "segnet": SegNet, "unet": UNet}
"""What builds each `Architecture.kind`."""

Weights = dict[str, Array]
"""The arrays of a network by their dotted path, such as `backbone.units.3.expand.kernel`."""

AnyArray = Array | np.ndarray
"""Of JAX or of NumPy."""


def make_network(architecture: Architecture, key: PRNGKeyArray) -> Network:
    """A network with random weights, in evaluation mode."""
    return _filled(_skeleton(architecture), initial_weights(architecture, key))


@cache
def _skeleton(architecture: Architecture) -> Network:
    """A network of shapes alone, to be filled; never to be changed."""
    return nnx.eval_shape(lambda: KINDS[architecture.kind](architecture))


def initial_weights(architecture: Architecture, key: PRNGKeyArray) -> Weights:
    """Random weights: kernels by He et al. 2015, norms that do nothing, biases of 0.

    Classifiers start with logits on the scale of their features: large ones would have to be unlearnt first. All are
    drawn on the host, the same on every machine.
    """
    draw = np.random.default_rng(np.asarray(jax.random.key_data(key)))

    def array(name: str, shape: tuple[int, ...]) -> Array:
        if len(shape) == 4:
            # The variance is kept on the way back through the ReLUs; a depthwise kernel feeds one output.
            variance = 2 / (shape[0] * shape[1] * (shape[3] if shape[2] > 1 or shape[0] == 1 else 1))
            if name.startswith("classifier."):
                variance = 1 / math.prod(shape[:3])
            return jnp.asarray(draw.standard_normal(shape, np.float32) * np.float32(np.sqrt(variance)))
        return jnp.asarray(np.full(shape, name.endswith((".norm.scale", ".norm.var")), np.float32))

    return {name: array(name, shape) for name, shape in weight_shapes(architecture).items()}


def _filled(network: Network, weights: Weights) -> Network:
    """A network with these arrays in the place of its own."""
    graph, state = nnx.split(network)
    flat = {path: variable.replace(weights[".".join(map(str, path))]) for path, variable in nnx.to_flat_state(state)}
    return nnx.merge(graph, nnx.from_flat_state(flat))


class PureNetwork(NamedTuple):
    """A network as a pure function and its weights.

    Attributes:
        architecture: the network.
        weights: its arrays by dotted path; a pytree.
        apply: `(weights, images, relief=None) -> logits`, not yet jitted; see `Network`.
        apply_coarse: the same for `Network.coarse_logits`.
    """

    architecture: Architecture
    weights: Weights
    apply: Callable[..., Float[Array, "B H W C"]]
    apply_coarse: Callable[..., Float[Array, "B h w C"]]


def pure_form(network: Network) -> PureNetwork:
    """The pure form of a network: its calls cost no Python when they are jitted."""
    return pure_network(network.record, network_weights(network))


def pure_network(architecture: Architecture, weights: Mapping[str, ArrayLike]) -> PureNetwork:
    """The pure form of a network with given weights, which must be complete."""
    skeleton = _skeleton(architecture)

    def apply(weights: Weights, images: Images, relief: Relief | None = None) -> Array:
        return _filled(skeleton, weights)(images, relief)

    def apply_coarse(weights: Weights, images: Images, relief: Relief | None = None) -> Array:
        return _filled(skeleton, weights).coarse_logits(images, relief)

    arrays = {name: value if isinstance(value, Array) else to_device(value) for name, value in weights.items()}
    return PureNetwork(architecture, arrays, apply, apply_coarse)


def training_form(
    architecture: Architecture, batch_norms: tuple[str, ...]
) -> Callable[..., tuple[Float[Array, "B H W C"], Weights]]:
    """The network as it is trained: with dropout, and with batch norms that learn.

    Args:
        architecture: the network.
        batch_norms: prefixes of the paths of batch norms that normalise by the statistics of the batch and
            follow them; the others use the statistics they have.

    Returns:
        `(weights, images, dropout_key, relief=None) -> (logits, statistics)`: the running statistics after the
        batch, by dotted path.
    """
    skeleton = _skeleton(architecture)

    def apply(
        weights: Weights, images: Images, dropout_key: PRNGKeyArray, relief: Relief | None = None
    ) -> tuple[Array, Weights]:
        network = _filled(skeleton, weights)
        learning = []
        for path, module in nnx.iter_modules(network):
            name = ".".join(map(str, path))
            if isinstance(module, nnx.BatchNorm) and name.startswith(batch_norms):
                module.use_running_average = False
                learning += [f"{name}.mean", f"{name}.var"]
        logits = network(images, relief, dropout_key=dropout_key)
        after = network_weights(network)
        return logits, {name: after[name] for name in learning}

    return apply


def network_weights(network: Network) -> Weights:
    """The arrays of a network by dotted path."""
    return {".".join(map(str, path)): variable.get_value() for path, variable in nnx.to_flat_state(nnx.state(network))}


@cache
def weight_shapes(architecture: Architecture) -> Mapping[str, tuple[int, ...]]:
    """Shape of every weight of a network, by dotted path, without allocating any."""
    shapes = network_weights(_skeleton(architecture))
    return MappingProxyType({name: tuple(leaf.shape) for name, leaf in shapes.items()})


def fold_batch_norm(
    architecture: Architecture, weights: Mapping[str, AnyArray]
) -> tuple[Architecture, dict[str, AnyArray]]:
    """The same network without batch norm: its scale and shift go into the convolutions before it.

    `w (x - mean) scale / sqrt(var + eps) + bias` is a convolution of kernel `w scale / sqrt(var + eps)`.
    """
    result = {name: value for name, value in weights.items() if ".norm." not in name}
    for name, mean in weights.items():
        block, _, leaf = name.rpartition(".norm.")
        if leaf != "mean":
            continue
        eps = architecture.backbone_eps if block.startswith("backbone.") else architecture.head_eps
        # In operators that NumPy's arrays have, too: on the host nothing needs to be compiled for it.
        gain = weights[f"{block}.norm.scale"] / (weights[f"{block}.norm.var"] + eps) ** 0.5
        result[f"{block}.kernel"] = weights[f"{block}.kernel"] * gain
        result[f"{block}.bias"] = weights[f"{block}.norm.bias"] - mean * gain
    return folded(architecture), result


def inference_network(architecture: Architecture, weights: Mapping[str, ArrayLike]) -> PureNetwork:
    """The network in the form that computes logits fastest; its weights are not for training or for model files.

    Batch norm is folded, and on a CPU the kernels of large dense convolutions are transformed (`convolve_winograd`).
    """
    architecture, result = fold_batch_norm(architecture, {name: np.asarray(value) for name, value in weights.items()})
    if jax.default_backend() == "cpu":
        for path, block in nnx.iter_modules(_skeleton(architecture)):
            if isinstance(block, ConvBlock) and block.transformable:
                name = ".".join(map(str, (*path, "kernel")))
                result[name] = winograd_kernel(jnp.asarray(result[name]))
    return pure_network(architecture, result)
