"""Convolutions, pooling and resizing on NHWC images, written for what XLA makes fast on a CPU.

Measured there (DESIGN section 7): grouped convolutions are some 60 times slower than the same sum of
shifted slices, and a 1x1 convolution takes twice as long as the same matrix product.
"""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmap.models.architecture import Padding

PRECISION = jax.lax.Precision.HIGHEST
"""Full float32 products on accelerators too, where the default would cut the mantissa to 10 bits."""


def pad_amounts(size: int, kernel: int, stride: int, dilation: int, padding: Padding) -> tuple[int, int]:
    """Zeros before and after an axis of `size` pixels.

    `torch` pads both sides alike, whatever the stride; `same` pads as little as gives
    `ceil(size / stride)` outputs, the odd one at the end (TensorFlow).
    """
    reach = dilation * (kernel - 1)
    if padding == "torch":
        return reach // 2, reach - reach // 2
    total = max((-(-size // stride) - 1) * stride + reach + 1 - size, 0)
    return total // 2, total - total // 2


def convolve(
    images: Float[Array, "B H W I"],
    kernel: Float[Array, "K K G O"],
    *,
    stride: int = 1,
    dilation: int = 1,
    padding: Padding = "torch",
    depthwise: bool = False,
) -> Float[Array, "B h w O"]:
    """Convolution without bias; a depthwise kernel has G = 1 and as many outputs as inputs."""
    if depthwise:
        return depthwise_convolve(images, kernel, stride=stride, dilation=dilation, padding=padding)
    size = kernel.shape[0]
    if size == 1:
        return jnp.dot(images[:, ::stride, ::stride], kernel[0, 0], precision=PRECISION)
    return jax.lax.conv_general_dilated(
        images,
        kernel,
        window_strides=(stride, stride),
        padding=[pad_amounts(images.shape[axis], size, stride, dilation, padding) for axis in (1, 2)],
        rhs_dilation=(dilation, dilation),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=PRECISION,
    )


def depthwise_convolve(
    images: Float[Array, "B H W C"],
    kernel: Float[Array, "K K 1 C"],
    *,
    stride: int = 1,
    dilation: int = 1,
    padding: Padding = "torch",
) -> Float[Array, "B h w C"]:
    """Each channel with its own kernel, as a sum of shifted slices."""
    total: Array | float = 0.0
    for row, column, window in _windows(images, kernel.shape[0], stride, dilation, padding, 0.0):
        total = total + window * kernel[row, column, 0]
    return jnp.asarray(total)


def max_pool(
    images: Float[Array, "B H W C"], *, size: int = 3, stride: int = 2, padding: Padding = "torch"
) -> Float[Array, "B h w C"]:
    """The largest value in each window; what is padded never wins."""
    windows = [window for _, _, window in _windows(images, size, stride, 1, padding, -jnp.inf)]
    largest = windows[0]
    for window in windows[1:]:
        largest = jnp.maximum(largest, window)
    return largest


def _windows(images: Array, size: int, stride: int, dilation: int, padding: Padding, fill: float):
    """Row, column and the pixels that a kernel's element there meets, for every element that meets any."""
    height, width = images.shape[1:3]
    before_y, after_y = pad_amounts(height, size, stride, dilation, padding)
    before_x, after_x = pad_amounts(width, size, stride, dilation, padding)
    padded = jnp.pad(images, ((0, 0), (before_y, after_y), (before_x, after_x), (0, 0)), constant_values=fill)
    # Without the barrier XLA computes the padding anew for each of the slices.
    padded = jax.lax.optimization_barrier(padded)
    rows = (height + before_y + after_y - dilation * (size - 1) - 1) // stride + 1
    columns = (width + before_x + after_x - dilation * (size - 1) - 1) // stride + 1
    for row in range(size):
        for column in range(size):
            top, left = row * dilation, column * dilation
            yield (
                row,
                column,
                padded[
                    :,
                    top : top + (rows - 1) * stride + 1 : stride,
                    left : left + (columns - 1) * stride + 1 : stride,
                ],
            )


@cache
def _resize_matrix(source: int, target: int, align_corners: bool) -> np.ndarray:
    """float32 (target, source): rows of bilinear weights along one axis."""
    index = np.arange(target, dtype=np.float64)
    if align_corners:
        position = index * ((source - 1) / (target - 1)) if target > 1 else np.zeros(1)
    else:
        position = ((index + 0.5) * (source / target) - 0.5).clip(0, source - 1)
    low = np.minimum(np.floor(position).astype(int), source - 1)
    high = np.minimum(low + 1, source - 1)
    matrix = np.zeros((target, source))
    np.add.at(matrix, (np.arange(target), low), 1 - (position - low))
    np.add.at(matrix, (np.arange(target), high), position - low)
    return matrix.astype(np.float32)


def resize_bilinear(
    images: Float[Array, "B H W C"], height: int, width: int, *, align_corners: bool
) -> Float[Array, "B h w C"]:
    """Bilinear resizing without antialiasing, as torch and TensorFlow do it."""
    if images.shape[1:3] == (height, width):
        return images
    if images.shape[1:3] == (1, 1):
        return jnp.broadcast_to(images, (images.shape[0], height, width, images.shape[3]))
    rows = jnp.asarray(_resize_matrix(images.shape[1], height, align_corners))
    columns = jnp.asarray(_resize_matrix(images.shape[2], width, align_corners))
    images = jnp.einsum("yh,bhwc->bywc", rows, images, precision=PRECISION)
    return jnp.einsum("xw,bywc->byxc", columns, images, precision=PRECISION)
