"""Bilinear resizing of NHWC images without antialiasing, as torch and TensorFlow do it, and its gradient."""

from __future__ import annotations

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmap.models.convolutions import PRECISION


def resize_bilinear(
    images: Float[Array, "B H W C"], height: int, width: int, *, align_corners: bool
) -> Float[Array, "B h w C"]:
    """Images of another size; `align_corners` maps the centres of corner pixels onto each other, else their edges."""
    return _resize_axis(_resize_axis(images, height, 1, align_corners), width, 2, align_corners)


def resize_rows(
    matrix: Float[np.ndarray, "source N"], target: int, *, align_corners: bool
) -> Float[np.ndarray, "target N"]:
    """Resizes along the first axis on the host, as precisely as the matrix.

    The identity becomes the matrix that takes the pixels there to those wanted.
    """
    low, high, share = resize_taps(len(matrix), target, align_corners)
    return matrix[low] + (matrix[high] - matrix[low]) * share[:, None]


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


def resize_area(images: Float[Array, "B H W C"], height: int, width: int) -> Float[Array, "B h w C"]:
    """Images of another size, edges onto edges: averaged where they shrink, interpolated where they grow."""
    batch, rows, columns, channels = images.shape
    if rows != height:
        matrix = _area_matrix(rows, height)
        images = jnp.matmul(matrix, images.reshape(batch, rows, -1), precision=PRECISION)
        images = images.reshape(batch, height, columns, channels)
    if columns != width:
        matrix = _area_matrix(columns, width)
        images = jnp.matmul(matrix, images, precision=PRECISION)
    return images


@cache
def _area_matrix(source: int, target: int) -> Float[np.ndarray, "target source"]:
    """The share of each source pixel in each target pixel along an axis."""
    if source < target:
        return resize_rows(np.eye(source), target, align_corners=False).astype(np.float32)
    edges = np.arange(target + 1) * (source / target)
    pixels = np.arange(source)
    covered = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return (covered.clip(0) * (target / source)).astype(np.float32)


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
    # An empty array carries the one number that the way back needs, the size of the axis.
    return _resize_axis(images, target, axis, align_corners), jnp.zeros((images.shape[axis], 0))


def _resize_axis_backward(target: int, axis: int, align_corners: bool, before: Array, cotangent: Array) -> tuple[Array]:
    """A matrix product, where autodiff would scatter."""
    source = len(before)
    if source == target:
        return (cotangent,)
    low, high, share = resize_taps(source, target, align_corners)
    weights = np.zeros((source, target), np.float32)
    np.add.at(weights, (low, np.arange(target)), 1 - share)
    np.add.at(weights, (high, np.arange(target)), share)
    batch, height, width, channels = cotangent.shape
    # A stack of matrices whose rows lie along the axis, without moving a pixel.
    stack = (batch, height, -1) if axis == 1 else (batch * height, width, channels)
    rows = cotangent.reshape(stack)
    matrices = jnp.broadcast_to(jnp.asarray(weights, cotangent.dtype), (len(rows), *weights.shape))
    result = jnp.matmul(matrices, rows, precision=PRECISION)
    return (result.reshape((batch, source, width, channels) if axis == 1 else (batch, height, source, channels)),)


_resize_axis.defvjp(_resize_axis_forward, _resize_axis_backward)
