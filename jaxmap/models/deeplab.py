"""DeepLabv3 and DeepLabv3+ (Chen et al. 2017, 2018): the network, its pure form, batch-norm folding."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from types import MappingProxyType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray, UInt8

from jaxmap.errors import JaxmapError
from jaxmap.models.architecture import Architecture, folded
from jaxmap.models.backbones import (
    INVERTED_RESIDUAL_STAGES,
    RESNET_UNITS,
    InvertedResidualNet,
    ResNet,
    Xception65,
)
from jaxmap.models.convolutions import winograd_kernel
from jaxmap.models.heads import Aspp, Decoder
from jaxmap.models.layers import ConvBlock
from jaxmap.models.resizing import resize_area, resize_bilinear
from jaxmap.types import to_device

Weights = dict[str, Array]
"""The arrays of a network by their dotted path, such as `backbone.units.3.expand.kernel`."""

AnyArray = Array | np.ndarray
"""Of JAX or of NumPy."""

Images = UInt8[Array, "B H W 3"] | Float[Array, "B H W 3"]
"""RGB, 0 to 255, of any size."""

Relief = Float[Array, "B g v R"]
"""Channels of relief over the field of view of the images, of any size; zeros where nothing is known."""

LOW_LEVEL_STRIDE = 4
"""Input pixels for each pixel of the decoder."""

_BACKBONES: dict[str, Callable[[Architecture], InvertedResidualNet | ResNet | Xception65]] = {
    **dict.fromkeys(INVERTED_RESIDUAL_STAGES, InvertedResidualNet),
    **dict.fromkeys(RESNET_UNITS, ResNet),
    "xception65": Xception65,
}


class DeepLab(nnx.Module):
    """A segmentation network, fixed by its `Architecture`."""

    def __init__(self, record: Architecture) -> None:
        self.record = record
        self.backbone = _BACKBONES[record.backbone](record)
        self.aspp = Aspp(self.backbone.channels, record)
        self.decoder = Decoder(self.backbone.low_level_channels, record) if record.decoder else None
        self.classifier = ConvBlock(record.head_channels, len(record.classes), norm="bias", activation="none")

    def __call__(
        self, images: Images, relief: Relief | None = None, *, dropout_key: PRNGKeyArray | None = None
    ) -> Float[Array, "B H W C"]:
        """Class logits at the size of the images; see `coarse_logits`."""
        height, width = images.shape[1:3]
        logits = self.coarse_logits(images, relief, dropout_key=dropout_key)
        padded = (padded_size(height, self.record), padded_size(width, self.record))
        with jax.named_scope("upsample"):
            logits = resize_bilinear(logits, *padded, align_corners=self.record.align_corners)
        return logits[:, :height, :width]

    def coarse_logits(
        self, images: Images, relief: Relief | None = None, *, dropout_key: PRNGKeyArray | None = None
    ) -> Float[Array, "B h w C"]:
        """Class logits before the last upsampling, over the padded images: at stride 4, or the output stride.

        Raises:
            JaxmapError: relief that is not what the network was made for; None is unknown relief to those that see it.
        """
        relief = placed_relief(relief, images.shape, self.record)
        with jax.named_scope("backbone"):
            features, low_level = self.backbone(normalise(images, self.record))
        with jax.named_scope("aspp"):
            features = self.aspp(features, dropout_key)
        if self.decoder is None:
            return self.classifier(features)
        with jax.named_scope("decoder"):
            return self.decoder(features, low_level, self.classifier, relief)


def padded_size(size: int, record: Architecture) -> int:
    """The least size not below `size` that the output stride divides, apart from `size_remainder`."""
    stride, remainder = record.output_stride, record.size_remainder
    return max(-(-(size - remainder) // stride), 1) * stride + remainder


def normalise(images: Images, record: Architecture) -> Float[Array, "B h w 3"]:
    """Images on the scale the network was trained on, padded below and to the right with zeros (the mean)."""
    # Whole numbers and halves become float32; float64, which checks of gradients need, stays.
    dtype = jnp.promote_types(images.dtype, jnp.float32)
    mean, std = (jnp.asarray(values, dtype) * 255 for values in (record.mean, record.std))
    scaled = (images.astype(dtype) - mean) / std
    after = [padded_size(size, record) - size for size in images.shape[1:3]]
    return jnp.pad(scaled, ((0, 0), (0, after[0]), (0, after[1]), (0, 0)))


def placed_relief(relief: Relief | None, images: tuple[int, ...], record: Architecture) -> Array | None:
    """Relief on the pixels of the decoder, padded as the images are; zeros where there is none.

    Raises:
        JaxmapError: the network sees none, or one of another shape.
    """
    channels, (batch, *size, _) = record.relief_channels, images
    if relief is None:
        if not channels:
            return None
        relief = jnp.zeros((batch, 1, 1, channels))
    if relief.ndim != 4 or (relief.shape[0], relief.shape[3]) != (batch, channels) or not channels:
        wanted = f"relief of {batch} images in {channels} channels" if channels else "no relief"
        raise JaxmapError(
            f"relief of shape {list(relief.shape)}, the network sees {wanted}",
            where="relief",
            fix="give what the network was trained on, or none",
        )
    inside = [-(-length // LOW_LEVEL_STRIDE) for length in size]
    after = [
        -(-padded_size(length, record) // LOW_LEVEL_STRIDE) - pixels
        for length, pixels in zip(size, inside, strict=True)
    ]
    with jax.named_scope("relief"):
        return jnp.pad(resize_area(relief, *inside), ((0, 0), (0, after[0]), (0, after[1]), (0, 0)))


def make_network(architecture: Architecture, key: PRNGKeyArray) -> DeepLab:
    """A network with random weights, in evaluation mode."""
    return _filled(_skeleton(architecture), initial_weights(architecture, key))


@cache
def _skeleton(architecture: Architecture) -> DeepLab:
    """A network of shapes alone, to be filled; never to be changed."""
    return nnx.eval_shape(lambda: DeepLab(architecture))


def initial_weights(architecture: Architecture, key: PRNGKeyArray) -> Weights:
    """Random weights: kernels by He et al. 2015, norms that do nothing, biases of 0.

    They are drawn on the host, the same on every machine.
    """
    draw = np.random.default_rng(np.asarray(jax.random.key_data(key)))

    def array(name: str, shape: tuple[int, ...]) -> Array:
        if len(shape) == 4:
            # The variance is kept on the way back through the ReLUs; a depthwise kernel feeds one output.
            fan = shape[0] * shape[1] * (shape[3] if shape[2] > 1 or shape[0] == 1 else 1)
            return jnp.asarray(draw.standard_normal(shape, np.float32) * np.float32(np.sqrt(2 / fan)))
        return jnp.asarray(np.full(shape, name.endswith((".norm.scale", ".norm.var")), np.float32))

    return {name: array(name, shape) for name, shape in weight_shapes(architecture).items()}


def _filled(network: DeepLab, weights: Weights) -> DeepLab:
    """A network with these arrays in the place of its own."""
    graph, state = nnx.split(network)
    flat = {path: variable.replace(weights[".".join(map(str, path))]) for path, variable in nnx.to_flat_state(state)}
    return nnx.merge(graph, nnx.from_flat_state(flat))


class PureNetwork(NamedTuple):
    """A network as a pure function and its weights.

    Attributes:
        architecture: the network.
        weights: its arrays by dotted path; a pytree.
        apply: `(weights, images, relief=None) -> logits`, not yet jitted; see `DeepLab`.
        apply_coarse: the same for `DeepLab.coarse_logits`.
    """

    architecture: Architecture
    weights: Weights
    apply: Callable[..., Float[Array, "B H W C"]]
    apply_coarse: Callable[..., Float[Array, "B h w C"]]


def pure_form(network: DeepLab) -> PureNetwork:
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


def network_weights(network: DeepLab) -> Weights:
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
