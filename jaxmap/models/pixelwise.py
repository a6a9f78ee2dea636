"""From an image to the input of a network, and from its logits back to all pixels of the image.

`segment` and the labeller of the compiled step both use this; the labeller never holds the logits of all pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxmap.errors import UsageError
from jaxmap.models.architecture import Architecture
from jaxmap.models.base import Images, padded_size
from jaxmap.models.convolutions import PRECISION
from jaxmap.models.resizing import resize_bilinear, resize_rows

Size = tuple[int, int]
"""Height and width in pixels."""

_BLOCK_ROWS = 16
_BLOCK_COLUMNS = 128


def check_size(size_px: Size | None, where: object) -> None:
    """Refuses an invalid size.

    Raises:
        UsageError: the height or the width is below 1.
    """
    if size_px is not None and min(size_px) < 1:
        raise UsageError(f"size {size_px[0]} {size_px[1]}", where=where, fix="give a height and a width above 0")


def resized_input(images: Images, size_px: Size | None) -> UInt8[Array, "B h w 3"] | Float[Array, "B h w 3"]:
    """The images at the size that the network runs at; their own where it is None."""
    if size_px is None:
        return images
    return resize_bilinear(images.astype(jnp.float32), *size_px, align_corners=False)


def resized_output(logits: Float[Array, "B h w C"], image_px: Sequence[int]) -> Float[Array, "B H W C"]:
    """Logits at the size that the network runs at, brought to the pixels of the image."""
    height, width = image_px
    return resize_bilinear(logits, height, width, align_corners=False)


class Upsampling(NamedTuple):
    """From coarse logits straight to the pixels of an image: `rows @ logits @ columns.T` for each class."""

    rows: Float[np.ndarray, "H h"]
    columns: Float[np.ndarray, "W w"]


def upsampling(
    architecture: Architecture, coarse: Sequence[int], image_px: Sequence[int], size_px: Size | None
) -> Upsampling:
    """The network's own last upsampling, the cut of its padding, and `resized_output`, all in one.

    Args:
        architecture: the network.
        coarse: height and width of its coarse logits.
        image_px: those of the image.
        size_px: those that the network runs at; the image's where None.
    """

    def along(axis: int) -> np.ndarray:
        inside = image_px[axis] if size_px is None else size_px[axis]
        padded = padded_size(inside, architecture)
        matrix = resize_rows(np.eye(coarse[axis]), padded, align_corners=architecture.align_corners)[:inside]
        return resize_rows(matrix, image_px[axis], align_corners=False).astype(np.float32)

    return Upsampling(along(0), along(1))


def map_pixels(
    function: Callable[[Float[Array, "R C W"]], tuple[Array, ...]],
    coarse: Float[Array, "h w C"],
    places: Upsampling,
    more: Float[Array, "h2 w2 E"] | None = None,
    stride: int = 1,
    wanted: Bool[Array, "H W"] | None = None,
) -> tuple[Array, ...]:
    """Applies a function to the logits at all pixels, a few rows at a time.

    Args:
        function: from the logits of R rows to images (R, W); it must treat pixels alike.
        coarse: the coarse logits.
        places: where the pixels lie among them.
        more: further numbers of each pixel, which follow the logits: an image whose pixels are `stride` pixels wide.
        stride: a power of two, 16 at most.
        wanted: pixels whose values are asked for; where a few rows have none, they are zeros. All by default.

    Returns:
        The images (H, W) that the function gives.
    """
    height, width = len(places.rows), len(places.columns)
    rows, columns = cut_matrix(places.rows, _BLOCK_ROWS), cut_matrix(places.columns, _BLOCK_COLUMNS)
    # Classes between rows and columns: softmax and maximum over them are fastest there.
    coarse = jnp.swapaxes(coarse, 1, 2)

    # On the way back the logits are computed anew, so that they are never all held there either.
    @jax.checkpoint
    def block(start: Int[Array, ""], weights: Float[Array, "R near"], beside: Array | None) -> tuple[Array, ...]:
        near = jax.lax.dynamic_slice_in_dim(coarse, start, weights.shape[1])
        lines = jnp.einsum("Rn,ncw->Rcw", weights, near, precision=PRECISION)
        parts = [
            jnp.dot(lines[..., first : first + columns.weights.shape[2]], weights.T, precision=PRECISION)
            for first, weights in zip(columns.starts.tolist(), columns.weights, strict=True)
        ]
        logits = jnp.concatenate(parts, axis=-1)[..., :width]
        if beside is not None:
            # Only here, where they stay in the cache, they come to as many as the pixels.
            beside = jnp.repeat(jnp.repeat(beside, stride, axis=0), stride, axis=2)[..., :width]
            logits = jnp.concatenate([logits, beside], axis=1)
        # Without the barrier they would be computed anew for each use.
        return function(jax.lax.optimization_barrier(logits))

    if more is not None:
        missing = len(rows.starts) * (_BLOCK_ROWS // stride) - len(more)
        more = jnp.swapaxes(jnp.pad(more, ((0, missing), (0, 0), (0, 0))), 1, 2)
        more = more.reshape(-1, _BLOCK_ROWS // stride, *more.shape[1:])
    bands = (jnp.asarray(rows.starts), jnp.asarray(rows.weights), more)
    if wanted is None:
        images = jax.lax.map(lambda band: block(*band), bands)
    else:
        missing = len(rows.starts) * _BLOCK_ROWS - height
        some = jnp.pad(wanted, ((0, missing), (0, 0))).reshape(len(rows.starts), -1).any(axis=1)
        forms = jax.eval_shape(block, *jax.tree.map(lambda leaf: leaf[0], bands))

        def zeros(*band: Array | None) -> tuple[Array, ...]:
            return tuple(jnp.zeros(form.shape, form.dtype) for form in forms)

        images = jax.lax.map(lambda one: jax.lax.cond(one[0], block, zeros, *one[1]), (some, bands))
    return tuple(image.reshape(-1, width)[:height] for image in images)


class Bands(NamedTuple):
    """The rows of a matrix in bands, without most of the zeros: the column where each band starts, and its numbers."""

    starts: Int[np.ndarray, "bands"]
    weights: Float[np.ndarray, "bands size near"]


def cut_matrix(matrix: Float[np.ndarray, "pixels coarse"], size: int) -> Bands:
    """Cuts the matrix of an axis into bands of so many pixels.

    Neighbouring pixels depend on few coarse ones, and those are neighbours.
    """
    missing = -len(matrix) % size
    blocks = np.pad(matrix, ((0, missing), (0, 0))).reshape(-1, size, matrix.shape[1])
    met = [np.flatnonzero(block.any(axis=0)) for block in blocks]
    near = max(int(index[-1] - index[0]) + 1 for index in met)
    starts = np.array([min(int(index[0]), matrix.shape[1] - near) for index in met], np.int32)
    weights = [block[:, start : start + near] for start, block in zip(starts, blocks, strict=True)]
    return Bands(starts, np.stack(weights))
