"""Convolution blocks of all networks, in Flax NNX; images are NHWC, kernels HWIO.

Kernels start as zeros, which `deeplab.initial_weights` or a file replaces.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from jaxmap.models.architecture import Activation, Norm, Padding
from jaxmap.models.batch_norm import BatchNorm, activate, add_bias
from jaxmap.models.convolutions import WINOGRAD_MIN_CHANNELS, convolve, convolve_winograd

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

    def __call__(self, images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
        """Applies the block."""
        kernel = self.kernel[...]
        if kernel.shape[0] != self.size:
            images = convolve_winograd(images, kernel, self.dilation)
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
