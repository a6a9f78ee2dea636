"""Convolutions and pooling of NHWC images, and their gradients, written for what XLA makes fast on a CPU.

Measured there: grouped convolutions are some 60 times slower than the same sum of shifted slices, and a 1x1
convolution takes twice as long as the same matrix product. What autodiff makes of a depthwise convolution keeps nine
shifted copies of the images; its kernel's gradient, nine sums over all pixels, took three quarters of a training
step. Cotangents are cut off from the computations before them by barriers: fused into a matrix product, those are
stored transposed, element by element.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmap.models.architecture import Padding

PRECISION = jax.lax.Precision.HIGHEST
"""Full float32 products on accelerators too, where the default would cut the mantissa to 10 bits."""

_BLOCK = 1 << 15
"""Elements worked on at a time: a few arrays of them fit into the cache of a core."""


class Axis(NamedTuple):
    """How a kernel slides along one axis of an image.

    Attributes:
        size: pixels of the image.
        kernel: elements of the kernel.
        stride: pixels between the windows of neighbouring outputs.
        dilation: pixels between the elements of the kernel.
        before: zeros before the image.
        outputs: pixels of the result.
    """

    size: int
    kernel: int
    stride: int
    dilation: int
    before: int
    outputs: int

    @classmethod
    def of(cls, size: int, kernel: int, stride: int, dilation: int, padding: Padding) -> Axis:
        """The axis for a convention of padding."""
        before, after = pad_amounts(size, kernel, stride, dilation, padding)
        count = (size + before + after - dilation * (kernel - 1) - 1) // stride + 1
        return cls(size, kernel, stride, dilation, before, count)

    def reach(self, outputs: int) -> int:
        """The pixels that so many neighbouring outputs meet, padding and all."""
        return (outputs - 1) * self.stride + (self.kernel - 1) * self.dilation + 1

    def first(self, index: int) -> int:
        """The pixel that an element of the kernel meets at the first output; negative in the padding."""
        return index * self.dilation - self.before

    def windows(self) -> tuple[tuple[int, int], list[tuple[int, slice]]]:
        """The padding needed, and the slice of the padded image that each element meets.

        Elements that meet nothing but padding are left out, and nothing is padded for them: at a dilation
        as large as the image (36 on 32x32 features) only the middle one is left.
        """
        span = (self.outputs - 1) * self.stride
        firsts = {index: self.first(index) for index in range(self.kernel)}
        firsts = {index: first for index, first in firsts.items() if first < self.size and first + span >= 0}
        start = max(0, -min(firsts.values()))
        end = max(0, max(firsts.values()) + span - (self.size - 1))
        slices = [
            (index, slice(first + start, first + start + span + 1, self.stride)) for index, first in firsts.items()
        ]
        return (start, end), slices

    def meeting(self, index: int) -> tuple[slice, slice]:
        """The pixels that an element meets, and the outputs at which it does."""
        first, stride = self.first(index), self.stride
        low = max(0, -(first // stride))
        high = min(self.outputs, (self.size - 1 - first) // stride + 1)
        return slice(first + low * stride, max(first + (high - 1) * stride + 1, 0), stride), slice(low, max(high, low))


Axes = tuple[Axis, Axis]
"""Rows and columns."""


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
    return convolve_along(_axes(images, kernel.shape[0], stride, dilation, padding), images, kernel, depthwise)


def convolve_along(
    axes: Axes, images: Float[Array, "B H W I"], kernel: Float[Array, "K K G O"], depthwise: bool
) -> Float[Array, "B h w O"]:
    """The same along given axes."""
    if depthwise:
        return _depthwise(axes, images, kernel)
    stride, dilation = axes[0].stride, axes[0].dilation
    if kernel.shape[0] == 1:
        return _pointwise(images[:, ::stride, ::stride], kernel[0, 0])
    # Other products promote by themselves, as double precision needs.
    dtype = jnp.result_type(images, kernel)
    return jax.lax.conv_general_dilated(
        images.astype(dtype),
        kernel.astype(dtype),
        window_strides=(stride, stride),
        padding=[(axis.before, axis.reach(axis.outputs) - axis.size - axis.before) for axis in axes],
        rhs_dilation=(dilation, dilation),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=PRECISION,
    )


def max_pool(
    images: Float[Array, "B H W C"], *, size: int = 3, stride: int = 2, padding: Padding = "torch"
) -> Float[Array, "B h w C"]:
    """The largest value in each window; padding never wins."""
    axes = _axes(images, size, stride, 1, padding)
    return reduce(jnp.maximum, [window for _, _, window in _windows(images, axes, -jnp.inf)])


def _axes(images: Array, size: int, stride: int, dilation: int, padding: Padding) -> Axes:
    rows, columns = (Axis.of(images.shape[axis], size, stride, dilation, padding) for axis in (1, 2))
    return rows, columns


def _windows(images: Array, axes: Axes, fill: float) -> Iterator[tuple[int, int, Array]]:
    """Row and column of each element of a kernel, and the pixels that it meets."""
    (pad_rows, rows), (pad_columns, columns) = (axis.windows() for axis in axes)
    padded = jnp.pad(images, ((0, 0), pad_rows, pad_columns, (0, 0)), constant_values=fill)
    # Without the barrier XLA computes the padding anew for each of the slices.
    padded = jax.lax.optimization_barrier(padded)
    for row, vertical in rows:
        for column, horizontal in columns:
            yield row, column, padded[:, vertical, horizontal]


@jax.custom_vjp
def _pointwise(images: Float[Array, "B H W I"], kernel: Float[Array, "I O"]) -> Float[Array, "B H W O"]:
    return jnp.dot(images, kernel, precision=PRECISION)


def _pointwise_forward(images: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return _pointwise(images, kernel), (images, kernel)


def _pointwise_backward(residuals: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    images, kernel = residuals
    cotangent = jax.lax.optimization_barrier(cotangent)
    # Over rows of a matrix: summed over several axes, the images would be transposed first.
    pixels, back = images.reshape(-1, images.shape[-1]), cotangent.reshape(-1, cotangent.shape[-1])
    of_kernel = jax.lax.dot_general(pixels, back, (((0,), (0,)), ((), ())), precision=PRECISION)
    return jnp.dot(cotangent, kernel.T, precision=PRECISION), of_kernel


_pointwise.defvjp(_pointwise_forward, _pointwise_backward)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _depthwise(axes: Axes, images: Float[Array, "B H W C"], kernel: Float[Array, "K K 1 C"]) -> Float[Array, "B h w C"]:
    """Each channel with its own kernel, as a sum of shifted slices."""
    total: Array | float = 0.0
    for row, column, window in _windows(images, axes, 0.0):
        total = total + window * kernel[row, column, 0]
    return jnp.asarray(total)


def _depthwise_forward(axes: Axes, images: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return _depthwise(axes, images, kernel), (images, kernel)


def _depthwise_backward(axes: Axes, residuals: tuple[Array, Array], cotangent: Array) -> tuple[Array, Array]:
    images, kernel = jax.lax.optimization_barrier(residuals)
    cotangent = jax.lax.optimization_barrier(cotangent)
    of_kernel = jax.lax.platform_dependent(
        images,
        cotangent,
        cpu=partial(kernel_gradient_by_rows, axes=axes),
        default=partial(kernel_gradient, axes=axes),
    )
    return _depthwise_images_gradient(cotangent, kernel, axes), of_kernel


_depthwise.defvjp(_depthwise_forward, _depthwise_backward)


def _depthwise_images_gradient(
    cotangent: Float[Array, "B h w C"], kernel: Float[Array, "K K 1 C"], axes: Axes
) -> Float[Array, "B H W C"]:
    """The turned kernel slid over the cotangent, between whose pixels lie stride - 1 zeros."""
    slices, pads = [], []
    for axis in axes:
        spread = (axis.outputs - 1) * axis.stride + 1
        # Pixel p met element k at p - first(k) of the spread cotangent.
        firsts = {index: -axis.first(index) for index in range(axis.kernel)}
        firsts = {index: first for index, first in firsts.items() if first < spread and first + axis.size > 0}
        start = max(0, -min(firsts.values()))
        pads.append((start, max(0, max(firsts.values()) + axis.size - spread), axis.stride - 1))
        slices.append({index: slice(first + start, first + start + axis.size) for index, first in firsts.items()})
    spread = jax.lax.pad(cotangent, jnp.zeros((), cotangent.dtype), ((0, 0, 0), *pads, (0, 0, 0)))
    spread = jax.lax.optimization_barrier(spread)
    total: Array | float = 0.0
    for row, vertical in slices[0].items():
        for column, horizontal in slices[1].items():
            total = total + spread[:, vertical, horizontal] * kernel[row, column, 0]
    return jnp.asarray(total)


def kernel_gradient(
    images: Float[Array, "B H W C"], cotangent: Float[Array, "B h w C"], *, axes: Axes
) -> Float[Array, "K K 1 C"]:
    """Gradient of a depthwise kernel: the pixels that each element met, times the cotangent there, summed."""

    def one(row: int, column: int) -> Array:
        (rows, rows_out), (columns, columns_out) = axes[0].meeting(row), axes[1].meeting(column)
        return (images[:, rows, columns] * cotangent[:, rows_out, columns_out]).sum((0, 1, 2))

    elements = range(axes[0].kernel)
    return jnp.stack([jnp.stack([one(row, column) for column in elements]) for row in elements])[:, :, None]


def kernel_gradient_by_rows(
    images: Float[Array, "B H W C"], cotangent: Float[Array, "B h w C"], *, axes: Axes
) -> Float[Array, "K K 1 C"]:
    """The same, a few rows at a time, which stay in the cache for all elements, summed by matrix products."""
    rows, columns = axes
    batch, channels = images.shape[0], images.shape[3]
    most = _BLOCK // (columns.outputs * channels)
    several = max(n for n in range(1, batch + 1) if batch % n == 0 and (n == 1 or n <= most))
    elements = [(row, column) for row in range(rows.kernel) for column in range(columns.kernel)]

    def rows_of(array: Array, image: Array, row: Array) -> Array:
        return jax.lax.dynamic_slice(array, (image, row, 0, 0), (several, 1, *array.shape[2:]))[:, 0]

    def add_row(step: Array, totals: list[Array]) -> list[Array]:
        image, row_out = step // rows.outputs * several, step % rows.outputs
        back = rows_of(cotangent, image, row_out)
        result = []
        for total, (row, column) in zip(totals, elements, strict=True):
            source = row_out * rows.stride + rows.first(row)
            met, at = columns.meeting(column)
            product = rows_of(images, image, source)[:, met] * back[:, at]
            product = jax.lax.optimization_barrier(product).reshape(-1, channels)
            part = jnp.dot(jnp.ones(len(product), product.dtype), product, precision=PRECISION)
            result.append(total + jnp.where((source >= 0) & (source < rows.size), part, 0))
        return result

    zeros = [jnp.zeros(channels, cotangent.dtype)] * len(elements)
    totals = jax.lax.fori_loop(0, batch // several * rows.outputs, add_row, zeros)
    return jnp.stack(totals).reshape(rows.kernel, columns.kernel, 1, channels)


WINOGRAD_MIN_CHANNELS = 128
"""With fewer channels the transforms take longer than the products they spare."""

_TILE = 2
"""Side of the part of the result that is computed at once."""

_OF_IMAGE = np.array([[1, 0, -1, 0], [0, 1, 1, 0], [0, -1, 1, 0], [0, 1, 0, -1]], np.float32)
_OF_KERNEL = np.array([[1, 0, 0], [0.5, 0.5, 0.5], [0.5, -0.5, 0.5], [0, 0, 1]], np.float32)
_OF_RESULT = np.array([[1, 1, 1, 0], [0, 1, -1, -1]], np.float32)
"""B', G and A' of Lavin and Gray 2016, section 4.1."""


def winograd_kernel(kernel: Float[Array, "3 3 I O"]) -> Float[Array, "4 4 I O"]:
    """The kernel as `convolve_winograd` takes it."""
    parts = _winograd(_OF_KERNEL, [[kernel[row, column] for column in range(3)] for row in range(3)])
    return jnp.stack([jnp.stack(row) for row in parts])


def convolve_winograd(
    images: Float[Array, "B H W I"], kernel: Float[Array, "4 4 I O"], dilation: int
) -> Float[Array, "B H W O"]:
    """Dense 3x3 convolution of stride 1, zeros beyond the images, with fewer products.

    F(2x2, 3x3) of Lavin and Gray 2016, "Fast Algorithms for Convolutional Neural Networks": each 2x2 of the result
    comes from a 4x4 of the image by 16 products a pair of channels, where the plain sum takes 36. Image, kernel and
    result are transformed by `A' [(G g G') * (B' d B)] A`, in which the star stands for sixteen matrix products over
    all tiles. With dilation, pixels that far apart are the neighbours.
    """
    batch, height, width, channels = images.shape
    down, across = (-(-size // (_TILE * dilation)) for size in (height, width))
    after = [_TILE * dilation * count + dilation - size for count, size in ((down, height), (across, width))]
    padded = jnp.pad(images, ((0, 0), (dilation, after[0]), (dilation, after[1]), (0, 0)))
    # Rows and columns as (pixel of one phase, phase).
    phases = padded.reshape(batch, _TILE * down + 2, dilation, _TILE * across + 2, dilation, channels)
    pixels = [
        [
            phases[:, row : row + _TILE * down : _TILE, :, column : column + _TILE * across : _TILE]
            for column in range(4)
        ]
        for row in range(4)
    ]
    patches = jnp.stack([jnp.stack(row) for row in _winograd(_OF_IMAGE, pixels)])
    products = jnp.einsum("rcbytxui,rcio->rcbytxuo", patches, kernel, precision=PRECISION)
    parts = _winograd(_OF_RESULT, [list(row) for row in products])
    # (B, down, phase, across, phase, O) for each pixel of a tile, to (B, down, pixel, phase, across, pixel, phase, O).
    result = jnp.stack([jnp.stack(row, axis=4) for row in parts], axis=2)
    result = result.reshape(batch, _TILE * dilation * down, _TILE * dilation * across, kernel.shape[3])
    return result[:, :height, :width]


def _winograd(matrix: np.ndarray, values: list[list[Array]]) -> list[list[Array]]:
    """`matrix @ values @ matrix.T` for a matrix whose elements are arrays."""

    def combined(weights: np.ndarray, terms: list[Array]) -> Array:
        return reduce(jnp.add, [term * weight for weight, term in zip(weights, terms, strict=True) if weight])

    rows = [[combined(weights, list(column)) for column in zip(*values, strict=True)] for weights in matrix]
    return [[combined(weights, row) for weights in matrix] for row in rows]
