"""Gradients of convolutions, written for what XLA makes fast on a CPU.

What autodiff makes of a depthwise convolution keeps nine shifted copies of the images; its kernel's gradient,
nine sums over all pixels, took three quarters of a training step. Cotangents are cut off from the
computations before them by barriers: fused into a matrix product, those are stored transposed, element by element.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

PRECISION = jax.lax.Precision.HIGHEST
"""Full float32 products on accelerators too, where the default would cut the mantissa to 10 bits."""

_BLOCK = 1 << 15
"""Elements worked on at a time: a few arrays of them fit into the cache of a core."""


class Sliding(NamedTuple):
    """How a square kernel slides over images.

    Attributes:
        size: of the kernel.
        stride: pixels between the windows of neighbouring outputs.
        dilation: pixels between the elements of a kernel.
        before: rows and columns of zeros above and left of the images.
    """

    size: int
    stride: int
    dilation: int
    before: tuple[int, int]

    def first(self, index: int, axis: int) -> int:
        """The pixel that an element of the kernel meets at the first output; negative in the padding."""
        return index * self.dilation - self.before[axis]


@jax.custom_vjp
def pointwise(images: Float[Array, "B H W I"], kernel: Float[Array, "I O"]) -> Float[Array, "B H W O"]:
    """A 1x1 convolution."""
    return jnp.dot(images, kernel, precision=PRECISION)


def _pointwise_forward(images: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return pointwise(images, kernel), (images, kernel)


def _pointwise_backward(residuals: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    images, kernel = residuals
    cotangent = jax.lax.optimization_barrier(cotangent)
    # Over rows of a matrix: summed over several axes, the images would be transposed first.
    pixels, back = images.reshape(-1, images.shape[-1]), cotangent.reshape(-1, cotangent.shape[-1])
    of_kernel = jax.lax.dot_general(pixels, back, (((0,), (0,)), ((), ())), precision=PRECISION)
    return jnp.dot(cotangent, kernel.T, precision=PRECISION), of_kernel


pointwise.defvjp(_pointwise_forward, _pointwise_backward)

Forward = Callable[[Array, Array], Array]


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def depthwise(
    forward: Forward, sliding: Sliding, images: Float[Array, "B H W C"], kernel: Float[Array, "K K 1 C"]
) -> Float[Array, "B h w C"]:
    """A depthwise convolution by `forward`, which slides as said, with the gradients of this file."""
    return forward(images, kernel)


def _depthwise_forward(
    forward: Forward, sliding: Sliding, images: Array, kernel: Array
) -> tuple[Array, tuple[Array, Array]]:
    return forward(images, kernel), (images, kernel)


def _depthwise_backward(
    forward: Forward, sliding: Sliding, residuals: tuple[Array, Array], cotangent: Array
) -> tuple[Array, Array]:
    images, kernel = jax.lax.optimization_barrier(residuals)
    cotangent = jax.lax.optimization_barrier(cotangent)
    of_kernel = jax.lax.platform_dependent(
        images,
        cotangent,
        cpu=partial(kernel_gradient_by_rows, sliding=sliding),
        default=partial(kernel_gradient, sliding=sliding),
    )
    return _depthwise_images_gradient(cotangent, kernel, sliding, images.shape), of_kernel


depthwise.defvjp(_depthwise_forward, _depthwise_backward)


def _depthwise_images_gradient(
    cotangent: Float[Array, "B h w C"], kernel: Float[Array, "K K 1 C"], sliding: Sliding, shape: tuple[int, ...]
) -> Float[Array, "B H W C"]:
    """The turned kernel slid over the cotangent, between whose pixels lie stride - 1 zeros."""
    taps, pads = [], []
    for axis in (0, 1):
        spread = (cotangent.shape[axis + 1] - 1) * sliding.stride + 1
        size = shape[axis + 1]
        # Pixel p met element k at p - first(k) of the spread cotangent.
        firsts = {index: -sliding.first(index, axis) for index in range(sliding.size)}
        firsts = {index: first for index, first in firsts.items() if first < spread and first + size > 0}
        start = max(0, -min(firsts.values()))
        pads.append((start, max(0, max(firsts.values()) + size - spread), sliding.stride - 1))
        taps.append({index: first + start for index, first in firsts.items()})
    spread = jax.lax.pad(cotangent, jnp.zeros((), cotangent.dtype), ((0, 0, 0), *pads, (0, 0, 0)))
    spread = jax.lax.optimization_barrier(spread)
    total: Array | float = 0.0
    for row, top in taps[0].items():
        for column, left in taps[1].items():
            total = total + spread[:, top : top + shape[1], left : left + shape[2]] * kernel[row, column, 0]
    return jnp.asarray(total)


def _meeting(sliding: Sliding, index: int, axis: int, size: int, count: int) -> tuple[slice, slice]:
    """The pixels of `size` that an element meets, and the outputs of `count` at which it does."""
    first, stride = sliding.first(index, axis), sliding.stride
    low = max(0, -(first // stride))
    high = min(count, (size - 1 - first) // stride + 1)
    return slice(first + low * stride, max(first + (high - 1) * stride + 1, 0), stride), slice(low, max(high, low))


def kernel_gradient(images: Array, cotangent: Array, *, sliding: Sliding) -> Float[Array, "K K 1 C"]:
    """Sum over the pixels that each element met, times what came back from there."""

    def one(row: int, column: int) -> Array:
        rows, rows_out = _meeting(sliding, row, 0, images.shape[1], cotangent.shape[1])
        columns, columns_out = _meeting(sliding, column, 1, images.shape[2], cotangent.shape[2])
        return (images[:, rows, columns] * cotangent[:, rows_out, columns_out]).sum((0, 1, 2))

    elements = range(sliding.size)
    return jnp.stack([jnp.stack([one(row, column) for column in elements]) for row in elements])[:, :, None]


def kernel_gradient_by_rows(images: Array, cotangent: Array, *, sliding: Sliding) -> Float[Array, "K K 1 C"]:
    """The same, a few rows at a time, which stay in the cache for all elements, summed by matrix products."""
    batch, height, width, channels = images.shape
    rows_out, columns_out = cotangent.shape[1:3]
    several = max(n for n in range(1, batch + 1) if batch % n == 0 and (n == 1 or n * columns_out * channels <= _BLOCK))
    elements = [(row, column) for row in range(sliding.size) for column in range(sliding.size)]

    def rows_of(array: Array, image: Array, row: Array) -> Array:
        return jax.lax.dynamic_slice(array, (image, row, 0, 0), (several, 1, *array.shape[2:]))[:, 0]

    def add_row(step: Array, totals: list[Array]) -> list[Array]:
        image, row_out = step // rows_out * several, step % rows_out
        back = rows_of(cotangent, image, row_out)
        result = []
        for total, (row, column) in zip(totals, elements, strict=True):
            source = row_out * sliding.stride + sliding.first(row, 0)
            met, at = _meeting(sliding, column, 1, width, columns_out)
            product = rows_of(images, image, source)[:, met] * back[:, at]
            product = jax.lax.optimization_barrier(product).reshape(-1, channels)
            part = jnp.dot(jnp.ones(len(product), product.dtype), product, precision=PRECISION)
            result.append(total + jnp.where((source >= 0) & (source < height), part, 0))
        return result

    zeros = [jnp.zeros(channels, cotangent.dtype)] * len(elements)
    totals = jax.lax.fori_loop(0, batch // several * rows_out, add_row, zeros)
    return jnp.stack(totals).reshape(sliding.size, sliding.size, 1, channels)


def resized(
    cotangent: Float[Array, "B H W C"], taps: tuple[np.ndarray, np.ndarray, np.ndarray], source: int, axis: int
) -> Float[Array, "B h w C"]:
    """The gradient of what was resized along an axis, as a matrix product; autodiff would scatter.

    Args:
        cotangent: of the resized images.
        taps: the two source pixels of each target pixel, and the share of the second.
        source: pixels along the axis before.
        axis: 1 (rows) or 2 (columns).
    """
    low, high, share = taps
    weights = np.zeros((source, len(low)), np.float32)
    np.add.at(weights, (low, np.arange(len(low))), 1 - share)
    np.add.at(weights, (high, np.arange(len(low))), share)
    batch, height, width, channels = cotangent.shape
    # A stack of matrices whose rows lie along the axis, without moving a pixel.
    stack = (batch, height, -1) if axis == 1 else (batch * height, width, channels)
    rows = cotangent.reshape(stack)
    matrices = jnp.broadcast_to(jnp.asarray(weights, cotangent.dtype), (len(rows), *weights.shape))
    result = jnp.matmul(matrices, rows, precision=PRECISION)
    return result.reshape((batch, source, width, channels) if axis == 1 else (batch, height, source, channels))
