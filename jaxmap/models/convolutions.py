"""Convolutions, pooling and resizing on NHWC images, written for what XLA makes fast on a CPU.

Measured there (DESIGN section 7): grouped convolutions are some 60 times slower than the same sum of
shifted slices, and a 1x1 convolution takes twice as long as the same matrix product.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import cache, partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmap.models import convolution_gradients as gradients
from jaxmap.models.architecture import Padding
from jaxmap.models.convolution_gradients import PRECISION, Sliding

FEW_CHANNELS = 4
"""An image's channels, as opposed to features: the library takes twice as long with so few as with twice as many."""


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
    row_padding: tuple[int, int] | None = None,
) -> Float[Array, "B h w O"]:
    """Convolution without bias.

    Args:
        images: what is convolved.
        kernel: a depthwise one has G = 1 and as many outputs as inputs.
        stride: input pixels for each output pixel, along both axes.
        dilation: input pixels from one element of the kernel to the next.
        padding: how many zeros are put around the images, see `pad_amounts`.
        depthwise: whether each channel has a kernel of its own.
        row_padding: zeros above and below, where only a band of an image's rows is given (depthwise only).
    """
    size = kernel.shape[0]
    if depthwise:
        forward = partial(
            depthwise_convolve, stride=stride, dilation=dilation, padding=padding, row_padding=row_padding
        )
        top, left = (pad_amounts(images.shape[axis], size, stride, dilation, padding)[0] for axis in (1, 2))
        top = top if row_padding is None else row_padding[0]
        return gradients.depthwise(forward, Sliding(size, stride, dilation, (top, left)), images, kernel)
    if stride == 2 and size == 3 and images.shape[3] <= FEW_CHANNELS and images.shape[2] % 2 == 0:
        return _convolve_pairs(images, kernel, padding)
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


def _convolve_pairs(
    images: Float[Array, "B H W I"], kernel: Float[Array, "K K I O"], padding: Padding
) -> Float[Array, "B h w O"]:
    """Convolution at stride 2, two columns of the image taken as one of twice the channels.

    That is the same memory, read another way; the kernel gets a column of zeros where it lacks one.
    """
    batch, height, width, channels = images.shape
    size, outputs = kernel.shape[0], kernel.shape[3]
    rows = pad_amounts(height, size, 2, 1, padding)
    before, after = pad_amounts(width, size, 2, 1, padding)
    odd = before % 2
    count = (width + before + after - size) // 2 + 1
    pairs = -(-(size + odd) // 2)
    kernel = jnp.pad(kernel, ((0, 0), (odd, 2 * pairs - size - odd), (0, 0), (0, 0)))
    first = (before + odd) // 2
    dtype = jnp.result_type(images, kernel)
    return jax.lax.conv_general_dilated(
        images.reshape(batch, height, width // 2, 2 * channels).astype(dtype),
        kernel.reshape(size, pairs, 2 * channels, outputs).astype(dtype),
        window_strides=(2, 1),
        padding=[rows, (first, count + pairs - 1 - first - width // 2)],
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
    row_padding: tuple[int, int] | None = None,
) -> Float[Array, "B h w C"]:
    """Each channel with its own kernel, as a sum of shifted slices; arguments are those of `convolve`."""

    def weighted(windows: list[_Window]) -> Array:
        terms = [pixels * kernel[row, column, 0] for row, column, pixels in windows]
        return sum(terms[1:], start=terms[0])

    size = kernel.shape[0]
    paddings = [pad_amounts(images.shape[axis], size, stride, dilation, padding) for axis in (1, 2)]
    return _over_windows(weighted, images, size, stride, dilation, (row_padding or paddings[0], paddings[1]))


def max_pool(
    images: Float[Array, "B H W C"], *, size: int = 3, stride: int = 2, padding: Padding = "torch"
) -> Float[Array, "B h w C"]:
    """The largest value in each window; what is padded never wins."""

    def largest(windows: list[_Window]) -> Array:
        return reduce(jnp.maximum, [pixels for _, _, pixels in windows])

    rows, columns = (pad_amounts(images.shape[axis], size, stride, 1, padding) for axis in (1, 2))
    return _over_windows(largest, images, size, stride, 1, (rows, columns))


class _Window(NamedTuple):
    """Row and column of an element of a kernel, and the pixels that it meets."""

    row: int
    column: int
    pixels: Array


def _over_windows(
    function: Callable[[list[_Window]], Array],
    images: Array,
    size: int,
    stride: int,
    dilation: int,
    paddings: tuple[tuple[int, int], tuple[int, int]],
) -> Array:
    """The image that `function` makes of a kernel's windows.

    Nothing is padded: where elements of the kernel meet nothing but padding, at the edges, they are left out, and
    the parts that each have their own elements are put together. That spares a copy of the image, which at a
    dilation as large as the image would be nine times its size.
    """
    rows, columns = (
        _parts(images.shape[axis], size, stride, dilation, amounts) for axis, amounts in enumerate(paddings, start=1)
    )
    # XLA would compute what makes the image anew for each of the windows.
    images = jax.lax.optimization_barrier(images)

    def part(vertical: _Taps, horizontal: _Taps) -> Array:
        return function(
            [
                _Window(row, column, images[:, down, across])
                for row, down in vertical
                for column, across in horizontal
            ]
        )

    return jnp.concatenate(
        [jnp.concatenate([part(vertical, horizontal) for horizontal in columns], axis=2) for vertical in rows], axis=1
    )


_Taps = list[tuple[int, slice]]
"""Elements of a kernel along an axis, and the slice of the image that each meets."""


@cache
def _parts(size: int, kernel: int, stride: int, dilation: int, padding: tuple[int, int]) -> list[_Taps]:
    """The parts of an axis in which the same elements of a kernel lie inside the image."""
    before, after = padding
    count = (size + before + after - dilation * (kernel - 1) - 1) // stride + 1
    offsets = [index * dilation - before for index in range(kernel)]
    begins = [min(max(-(offset // stride), 0), count) for offset in offsets]
    ends = [min(max((size - 1 - offset) // stride + 1, 0), count) for offset in offsets]
    cuts = sorted({0, count, *begins, *ends})
    return [
        [
            (index, slice(first * stride + offset, (last - 1) * stride + offset + 1, stride))
            for index, offset in enumerate(offsets)
            if begins[index] <= first and last <= ends[index]
        ]
        for first, last in itertools.pairwise(cuts)
    ]


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
