"""Blocks of convolutions by the compiled kernel of `jaxmap.native`, where it fits.

The kernel takes an optional 1x1 expansion, an optional depthwise convolution, and a projection: 1x1, or without a
depthwise convolution before it a dense one. All have biases, or nothing, in the place of batch norms. It makes a few
rows of the expanded image at a time. Elsewhere, and wherever a derivative is taken, a module computes by its `plain`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Float

from jaxmap.models.architecture import Activation
from jaxmap.native.build import TARGET, has_kernel

if TYPE_CHECKING:
    from jaxmap.models.layers import ConvBlock

LEAST_PIXELS = 64
"""Of an image with fewer, the kernel would spend its time on the weights."""

_RANGES: dict[Activation, tuple[float, float]] = {
    "relu": (0, np.inf),
    "relu6": (0, 6),
    "none": (-np.inf, np.inf),
}


class Fusable(Protocol):
    """A module that is convolutions in a row.

    Attributes:
        blocks: the convolutions.
        shortcut: whether the input is added to the result.
    """

    @property
    def blocks(self) -> Sequence[ConvBlock]: ...

    shortcut: Any

    def plain(self, images: Array) -> Array: ...


def apply_fused(module: Any, images: Float[Array, "B H W I"]) -> Float[Array, "B h w O"]:
    """The module's result, by the kernel where it fits; the two differ by rounding alone."""
    if not _fits(module.blocks, images):
        return module.plain(images)
    return _fused(*nnx.split(module), images)


def _fits(blocks: Sequence[ConvBlock], images: Array) -> bool:
    known = all(
        block.norm is None and block.kernel.shape[0] == block.size and block.kernel.dtype == jnp.float32
        for block in blocks
    )
    *before, last = blocks
    pixels = images.shape[0] * images.shape[1] * images.shape[2]
    return known and images.dtype == jnp.float32 and pixels >= LEAST_PIXELS and has_kernel()


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _fused(graph: Any, state: Any, images: Array) -> Array:
    module = nnx.merge(graph, state)
    blocks = list(module.blocks)
    project = blocks.pop()
    depthwise = blocks.pop() if blocks else None
    expand = blocks.pop() if blocks else None
    window = depthwise or project
    rows, columns = window.axis(images.shape[1]), window.axis(images.shape[2])
    result = jax.ShapeDtypeStruct(
        (images.shape[0], rows.outputs, columns.outputs, project.kernel.shape[3]), jnp.float32
    )
    call = jax.ffi.ffi_call(TARGET, result, vmap_method="sequential")
    layers = (expand, depthwise, project)
    return call(
        images,
        *(array for layer in layers for array in _arrays(layer)),
        window=np.array([rows.kernel, rows.stride, rows.dilation, rows.before, columns.before], np.int64),
        ranges=np.array([_RANGES[layer.activation if layer else "none"] for layer in layers], np.float32).reshape(-1),
        shortcut=bool(module.shortcut),
    )


def _arrays(layer: ConvBlock | None) -> tuple[Array, Array]:
    """Kernel and bias; empty where there is no layer."""
    if layer is None:
        return jnp.zeros(0, jnp.float32), jnp.zeros(0, jnp.float32)
    kernel = layer.kernel[...]
    return kernel, jnp.zeros(kernel.shape[3], jnp.float32) if layer.bias is None else layer.bias[...]


def _fused_forward(graph: Any, state: Any, images: Array) -> tuple[Array, Any]:
    # Under differentiation the module computes as if there were no kernel.
    return jax.vjp(lambda state, images: nnx.merge(graph, state).plain(images), state, images)


_fused.defvjp(_fused_forward, lambda graph, pull_back, cotangent: pull_back(cotangent))
