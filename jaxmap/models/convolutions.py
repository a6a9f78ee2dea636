"""Convolutions, pooling and resizing on NHWC images, written for what XLA makes fast on a CPU.

Measured there (DESIGN section 7): grouped convolutions are some 60 times slower than the same sum of
shifted slices, and a 1x1 convolution takes twice as long as the same matrix product.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmap.models import convolution_gradients as gradients
from jaxmap.models.architecture import Padding
from jaxmap.models.convolution_gradients import PRECISION, Sliding


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
    size = kernel.shape[0]
    if depthwise:
        forward = partial(depthwise_convolve, stride=stride, dilation=dilation, padding=padding)
        top, left = (pad_amounts(images.shape[axis], size, stride, dilation, padding)[0] for axis in (1, 2))
        return gradients.depthwise(forward, Sliding(size, stride, dilation, (top, left)), images, kernel)
    if size == 1:
        return gradients.pointwise(images[:, ::stride, ::stride], kernel[0, 0])
    # Other products promote by themselves, as double precision needs.
    dtype = jnp.result_type(images, kernel)
    return jax.lax.conv_general_dilated(
        images.astype(dtype),
        kernel.astype(dtype),
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


def _windows(
    images: Array, size: int, stride: int, dilation: int, padding: Padding, fill: float
) -> Iterator[tuple[int, int, Array]]:
    """Row and column of each element of a kernel, and the pixels that it meets.

    Elements that meet nothing but padding are left out, and nothing is padded for them: at a dilation
    as large as the image (36 on 32x32 features) only the middle one is left.
    """
    rows = _Axis.of(images.shape[1], size, stride, dilation, padding)
    columns = _Axis.of(images.shape[2], size, stride, dilation, padding)
    padded = jnp.pad(images, ((0, 0), rows.pad, columns.pad, (0, 0)), constant_values=fill)
    # Without the barrier XLA computes the padding anew for each of the slices.
    padded = jax.lax.optimization_barrier(padded)
    for row, vertical in rows.taps:
        for column, horizontal in columns.taps:
            yield row, column, padded[:, vertical, horizontal]


class _Axis(NamedTuple):
    """How a kernel slides along one axis: the padding needed, and the slice that each element meets."""

    pad: tuple[int, int]
    taps: list[tuple[int, slice]]

    @classmethod
    def of(cls, size: int, kernel: int, stride: int, dilation: int, padding: Padding) -> _Axis:
        before, after = pad_amounts(size, kernel, stride, dilation, padding)
        count = (size + before + after - dilation * (kernel - 1) - 1) // stride + 1
        firsts = {index: index * dilation - before for index in range(kernel)}
        span = (count - 1) * stride
        firsts = {index: first for index, first in firsts.items() if first < size and first + span >= 0}
        start = max(0, -min(firsts.values()))
        end = max(0, max(firsts.values()) + span - (size - 1))
        taps = [(index, slice(first + start, first + start + span + 1, stride)) for index, first in firsts.items()]
        return cls((start, end), taps)


@cache
def resize_taps(source: int, target: int, align_corners: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each target pixel along an axis: the source pixels before and after it, and the share of the latter."""
    index = np.arange(target, dtype=np.float64)
    if align_corners:
        position = index * ((source - 1) / max(target - 1, 1))
    else:
        position = ((index + 0.5) * (source / target) - 0.5).clip(0, source - 1)
    low = np.minimum(np.floor(position).astype(np.int32), source - 1)
    return low, np.minimum(low + 1, source - 1), (position - low).astype(np.float32)


@partial(jax.custom_vjp, nondiff_argnums=(1, 2, 3))
def _resize_axis(images: Array, target: int, axis: int, align_corners: bool) -> Array:
    source = images.shape[axis]
    if source == target:
        return images
    low, high, share = resize_taps(source, target, align_corners)
    shares = share.reshape([-1 if place == axis else 1 for place in range(4)])
    # Two taps a pixel: five times faster than a product with the matrix of weights.
    before = jnp.take(images, low, axis=axis, mode="clip")
    return before + (jnp.take(images, high, axis=axis, mode="clip") - before) * shares


def _resize_axis_forward(images: Array, target: int, axis: int, align_corners: bool) -> tuple[Array, Array]:
    # Only the size of the axis is needed on the way back, which an empty array tells.
    return _resize_axis(images, target, axis, align_corners), jnp.zeros((images.shape[axis], 0))


def _resize_axis_backward(target: int, axis: int, align_corners: bool, before: Array, cotangent: Array) -> tuple[Array]:
    source = len(before)
    if source == target:
        return (cotangent,)
    return (gradients.resized(cotangent, resize_taps(source, target, align_corners), source, axis),)


_resize_axis.defvjp(_resize_axis_forward, _resize_axis_backward)


def resize_bilinear(
    images: Float[Array, "B H W C"], height: int, width: int, *, align_corners: bool
) -> Float[Array, "B h w C"]:
    """Bilinear resizing without antialiasing, as torch and TensorFlow do it."""
    return _resize_axis(_resize_axis(images, height, 1, align_corners), width, 2, align_corners)


def resize_rows(matrix: Float[np.ndarray, "source N"], target: int, *, align_corners: bool) -> np.ndarray:
    """What `resize_bilinear` does along one axis, on the host: (target, N), as precise as the matrix.

    The identity becomes the matrix that takes the pixels there to those wanted.
    """
    low, high, share = resize_taps(len(matrix), target, align_corners)
    return matrix[low] + (matrix[high] - matrix[low]) * share[:, None]
