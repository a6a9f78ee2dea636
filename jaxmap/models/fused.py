"""Convolutions in a row by the compiled kernel of `jaxmap.native`, where it fits.

The kernel takes an optional 1x1 expansion, an optional depthwise convolution, and a 1x1 projection; or one convolution
alone, 1x1 or dense. It makes a few rows of the expanded image at a time. Batch norms must have been folded. Elsewhere,
and wherever a derivative is taken, a module computes by its `plain`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, Protocol, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from jaxmap.models.architecture import Activation
from jaxmap.models.convolutions import Axis
from jaxmap.native.build import TARGET, has_kernel

LEAST_PIXELS = 64
"""Of an image with fewer, the kernel would spend its time on the weights."""

RANGES: dict[Activation, tuple[float, float]] = {"relu": (0, np.inf), "relu6": (0, 6), "none": (-np.inf, np.inf)}
"""The values that an activation lets through; others become the nearest of them."""


class Convolution(Protocol):
    """What is asked of a convolution; see `layers.ConvBlock`."""

    size: int
    activation: Activation
    kernel: nnx.Param
    bias: nnx.Param | None
    norm: Any

    def axis(self, size: int) -> Axis:
        """How the kernel slides along an axis of so many pixels."""
        ...


class InARow(Protocol):
    """A module that is convolutions in a row: `blocks`; its input is added to the result where `shortcut`."""

    shortcut: bool

    @property
    def blocks(self) -> Sequence[Convolution]:
        """The convolutions, in the order that the kernel knows."""
        ...

    def plain(self, images: Array) -> Array:
        """What the module computes, in JAX."""
        ...


def apply_fused(module: InARow, images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
    """The module's result, by the kernel where it fits; the two differ by rounding alone."""
    if not fits(module.blocks, images):
        return module.plain(images)
    graph, state = nnx.split(cast(nnx.Module, module))
    return _fused(graph, state, images)


def fits(blocks: Sequence[Convolution], images: Array) -> bool:
    """Whether there is a kernel, norms are folded, kernels are not transformed, and all numbers are float32."""
    known = images.dtype == jnp.float32 and all(
        block.norm is None and block.kernel.shape[0] == block.size and block.kernel.dtype == jnp.float32
        for block in blocks
    )
    return known and math.prod(images.shape[:3]) >= LEAST_PIXELS and has_kernel()


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _fused(graph: Any, state: Any, images: Array) -> Array:
    module = nnx.merge(graph, state)
    *before, project = module.blocks
    expand, depthwise = (None, None, *before)[-2:]
    window = depthwise or project
    rows, columns = (window.axis(size) for size in images.shape[1:3])
    shape = (images.shape[0], rows.outputs, columns.outputs, project.kernel.shape[3])
    layers = (expand, depthwise, project)
    kernel = partial(
        jax.ffi.ffi_call(TARGET, jax.ShapeDtypeStruct(shape, jnp.float32), vmap_method="sequential"),
        window=np.array([rows.kernel, rows.stride, rows.dilation, rows.before, columns.before], np.int64),
        ranges=np.array([RANGES[layer.activation if layer else "none"] for layer in layers], np.float32).reshape(-1),
        shortcut=module.shortcut,
    )
    arrays = [array for layer in layers for array in _arrays(layer)]
    # A program may be lowered for another device than this machine's.
    return jax.lax.platform_dependent(images, *arrays, cpu=kernel, default=lambda images, *arrays: module.plain(images))


def _fused_forward(graph: Any, state: Any, images: Array) -> tuple[Array, Any]:
    # Under differentiation the module computes as if there were no kernel.
    return jax.vjp(lambda state, images: nnx.merge(graph, state).plain(images), state, images)


_fused.defvjp(_fused_forward, lambda graph, pull_back, cotangent: pull_back(cotangent))


def _arrays(layer: Convolution | None) -> tuple[Array, Array]:
    """Kernel and bias; empty where there is no layer."""
    if layer is None:
        nothing = jnp.zeros(0, jnp.float32)
        return nothing, nothing
    kernel = layer.kernel[...]
    return kernel, jnp.zeros(kernel.shape[3], jnp.float32) if layer.bias is None else layer.bias[...]
