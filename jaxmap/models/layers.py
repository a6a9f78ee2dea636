"""Convolution blocks of all networks, in Flax NNX; images are NHWC, kernels HWIO.

Kernels start as zeros, which `network.initial_weights` or a file replaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxmap.models.architecture import Activation, Norm, Padding
from jaxmap.models.bands import by_bands, rows_per_band
from jaxmap.models.batch_norm import BatchNorm, activate, add_bias
from jaxmap.models.convolutions import WINOGRAD_MIN_CHANNELS, Axis, convolve_along, convolve_winograd
from jaxmap.models.fused import apply_fused

BATCH_NORM_MOMENTUM = 0.9
"""Weight of the old running statistics; 0.1 in torch, which gives that of the new ones."""

_NO_KEYS: Any = SimpleNamespace(params=lambda: None)
"""In place of `nnx.Rngs`: norms start as ones and zeros, and drawing keys for them took half the time of building."""


class ConvBlock(nnx.Module):
    """Convolution, then batch norm or a bias, then an activation.

    Weights: `kernel` (K, K, I, O), or (K, K, 1, C) depthwise; `norm.{scale,bias,mean,var}` (O,) where
    `norm` is `batch`, `bias` (O,) where it is `bias`. For inference, the kernel of a `transformable` block may be the
    (4, 4, I, O) that `winograd_kernel` makes of it.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        size: int = 1,
        *,
        stride: int = 1,
        dilation: int = 1,
        padding: Padding = "torch",
        depthwise: bool = False,
        norm: Norm = "batch",
        eps: float = 1e-5,
        activation: Activation = "relu",
    ) -> None:
        self.size, self.stride, self.dilation, self.depthwise = size, stride, dilation, depthwise
        self.padding: Padding = padding
        self.activation: Activation = activation
        self.kernel = nnx.Param(jnp.zeros((size, size, 1 if depthwise else inputs, outputs)))
        self.bias = nnx.Param(jnp.zeros(outputs)) if norm == "bias" else None
        self.norm = (
            BatchNorm(outputs, use_running_average=True, momentum=BATCH_NORM_MOMENTUM, epsilon=eps, rngs=_NO_KEYS)
            if norm == "batch"
            else None
        )

    shortcut = False

    @property
    def blocks(self) -> list[ConvBlock]:
        """Itself."""
        return [self]

    def __call__(self, images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
        """Applies the block."""
        return self.plain(images) if self.depthwise else apply_fused(self, images)

    def plain(self, images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
        """The same without the compiled kernel."""
        kernel = self.kernel[...]
        if kernel.shape[0] != self.size:
            return self.finish(convolve_winograd(images, kernel, self.dilation))
        return self.along((self.axis(images.shape[1]), self.axis(images.shape[2])), images)

    def axis(self, size: int) -> Axis:
        """How the kernel slides along an axis of so many pixels."""
        return Axis.of(size, self.size, self.stride, self.dilation, self.padding)

    def along(self, axes: tuple[Axis, Axis], images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
        """Applies the block along given axes of rows and columns."""
        return self.finish(convolve_along(axes, images, self.kernel[...], self.depthwise))

    def finish(self, images: Float[Array, "B h w O"]) -> Float[Array, "B h w O"]:
        """Bias or norm, then the activation."""
        if self.bias is not None:
            return add_bias(images, self.bias[...], self.activation)
        if self.norm is not None:
            return self.norm(images, self.activation)
        return activate(images, self.activation)

    @property
    def transformable(self) -> bool:
        """Whether the kernel may be transformed, and the block becomes faster by it."""
        plain = self.size == 3 and self.stride == 1 and not self.depthwise
        return plain and min(self.kernel.shape[2:]) >= WINOGRAD_MIN_CHANNELS


def dropped(features: Float[Array, "B H W C"], share: float, key: PRNGKeyArray | None) -> Float[Array, "B H W C"]:
    """Features of which a share is dropped, and the others grow by as much; all as they are without a key."""
    if key is None or share == 0:
        return features
    return jnp.where(jax.random.bernoulli(key, 1 - share, features.shape), features / (1 - share), 0)


def apply_by_bands(blocks: Sequence[ConvBlock], images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
    """Blocks one after the other, a few rows at a time, so that what lies between them stays in the cache.

    Norms that learn need all pixels at once. Rows that two bands need are made twice. On the way back everything is
    made anew, at once.
    """
    return _by_bands(*nnx.split(nnx.List(blocks)), images)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _by_bands(graph: Any, state: Any, images: Array) -> Array:
    blocks = nnx.merge(graph, state)
    places, size = [], images.shape[1:3]
    for block in blocks:
        places.append(tuple(block.axis(length) for length in size))
        size = tuple(axis.outputs for axis in places[-1])
    height = size[0]
    row_bytes = [
        images.shape[0] * rows.outputs * columns.outputs * block.kernel.shape[3] * images.dtype.itemsize // height
        for block, (rows, columns) in zip(blocks, places, strict=True)
    ]
    # For each block the rows that it is given, at `first` of the result from row `first * step + offset` on.
    given = [_Rows(rows_per_band(height, max(row_bytes)), 1, 0)]
    for rows, _ in reversed(places):
        many, step, offset = given[0]
        given.insert(0, _Rows(rows.reach(many), step * rows.stride, offset * rows.stride - rows.before))
    band, start = given[-1].many, given[0]
    after = max((height - band) * start.step + start.offset + start.many - images.shape[1], 0)
    padded = jnp.pad(images, ((0, 0), (-start.offset, after), (0, 0), (0, 0)))

    def some(first: Int[Array, ""]) -> Array:
        result = jax.lax.dynamic_slice_in_dim(padded, first * start.step, start.many, axis=1)
        for block, (rows, columns), before, behind in zip(blocks, places, given, given[1:], strict=False):
            result = block.along((rows._replace(size=before.many, before=0, outputs=behind.many), columns), result)
            # Beyond the image the next block meets zeros, not what this one makes of zeros.
            place = first * behind.step + behind.offset + jnp.arange(behind.many)[:, None, None]
            result = jnp.where((place >= 0) & (place < rows.outputs), result, 0)
        return result

    return by_bands(some, height, band)


def _by_bands_forward(graph: Any, state: Any, images: Array) -> tuple[Array, tuple[Any, Array]]:
    return _by_bands(graph, state, images), (state, images)


def _by_bands_backward(graph: Any, residuals: tuple[Any, Array], cotangent: Array) -> tuple[Any, Array]:
    def at_once(state: Any, images: Array) -> Array:
        for block in nnx.merge(graph, state):
            images = block.plain(images)
        return images

    return jax.vjp(at_once, *residuals)[1](cotangent)


_by_bands.defvjp(_by_bands_forward, _by_bands_backward)


class _Rows(NamedTuple):
    """Rows of an image that a band of the result depends on: how many, rows between those of two results, first one."""

    many: int
    step: int
    offset: int


class SeparableBlock(nnx.Module):
    """A 3x3 depthwise convolution, then a pointwise one with norm and activation.

    Where `norm_inside`, norm and `inner_activation` stand between the two as well.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        stride: int = 1,
        dilation: int = 1,
        padding: Padding = "torch",
        norm: Norm = "batch",
        norm_inside: bool = False,
        eps: float = 1e-5,
        activation: Activation = "relu",
        inner_activation: Activation = "relu",
    ) -> None:
        self.depthwise = ConvBlock(
            inputs,
            inputs,
            3,
            stride=stride,
            dilation=dilation,
            padding=padding,
            depthwise=True,
            norm=norm if norm_inside else "none",
            eps=eps,
            activation=inner_activation if norm_inside else "none",
        )
        self.pointwise = ConvBlock(inputs, outputs, norm=norm, eps=eps, activation=activation)

    shortcut = False

    @property
    def blocks(self) -> list[ConvBlock]:
        """Its convolutions in their order."""
        return [self.depthwise, self.pointwise]

    def __call__(self, images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
        """Applies the block."""
        return apply_fused(self, images)

    def plain(self, images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
        """The same without the compiled kernel."""
        return self.pointwise.plain(self.depthwise.plain(images))
