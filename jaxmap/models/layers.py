"""The blocks that every network is made of, in Flax NNX; images are NHWC, kernels HWIO.

Blocks start with kernels of zeros: `deeplab.initial_weights` or a file fills them, which spares drawing what
a file replaces.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jaxmap.models.architecture import Activation, Norm, Padding
from jaxmap.models.batch_norm import BatchNorm, activate, add_bias
from jaxmap.models.convolutions import convolve
from jaxmap.models.winograd import MIN_CHANNELS, convolve_transformed

BATCH_NORM_MOMENTUM = 0.9
"""Weight of the old running statistics; torch calls the same 0.1."""

_NO_KEYS: Any = SimpleNamespace(params=lambda: None)
"""In place of `nnx.Rngs`: norms start as ones and zeros, and drawing keys for them took half the time of building."""


class ConvBlock(nnx.Module):
    """Convolution, then batch norm or a bias, then an activation.

    Weights: `kernel` (K, K, I, O), or (K, K, 1, C) depthwise; `norm.{scale,bias,mean,var}` (O,) where
    `norm` is `batch`, `bias` (O,) where it is `bias`. For inference, the kernel of a `transformable` block may be the
    (4, 4, I, O) that `winograd.transformed_kernel` makes of it.
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

    def __call__(self, images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
        """Applies the block."""
        kernel = self.kernel[...]
        if kernel.shape[0] != self.size:
            images = convolve_transformed(images, kernel, self.dilation)
        else:
            images = convolve(
                images,
                kernel,
                stride=self.stride,
                dilation=self.dilation,
                padding=self.padding,
                depthwise=self.depthwise,
            )
        return self.finish(images)

    def finish(self, images: Float[Array, "B h w O"]) -> Float[Array, "B h w O"]:
        """What follows the convolution: bias or norm, then the activation."""
        if self.bias is not None:
            return add_bias(images, self.bias[...], self.activation)
        if self.norm is not None:
            return self.norm(images, self.activation)
        return activate(images, self.activation)

    @property
    def transformable(self) -> bool:
        """Whether the kernel may be transformed, and the block becomes faster by it."""
        plain = self.size == 3 and self.stride == 1 and not self.depthwise
        return plain and min(self.kernel.shape[2:]) >= MIN_CHANNELS


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

    def __call__(self, images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
        """Applies the block."""
        return self.pointwise(self.depthwise(images))


def dilations(strides: list[int], start: int, output_stride: int, dilate_first: bool) -> list[tuple[int, int]]:
    """Strides and dilations of units in a row, such that the features end at `output_stride`.

    Strides beyond it become dilation: of that unit already where `dilate_first`, else from the next
    one on (which leaves the field of view of the unit itself as it was trained).

    Args:
        strides: of the units, as designed.
        start: input pixels for each pixel that enters the first unit.
        output_stride: input pixels for each feature wanted.
        dilate_first: see `Architecture`.

    Returns:
        (stride, dilation) of every unit.
    """
    result, reached, rate = [], start, 1
    for stride in strides:
        if reached * stride <= output_stride:
            reached *= stride
            result.append((stride, rate))
        else:
            result.append((1, rate * stride if dilate_first else rate))
            rate *= stride
    return result
