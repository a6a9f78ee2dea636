"""Dense 3x3 convolution with fewer products (Lavin and Gray 2016, "Fast Algorithms for Convolutional Neural Networks").

F(2x2, 3x3): each 2x2 of the result comes from a 4x4 of the image by 16 products a pair of channels, where the plain
sum takes 36. Image, kernel and result are transformed by `A' [(G g G') * (B' d B)] A`, in which the star stands for
sixteen matrix products over all tiles. With dilation, pixels that far apart are the neighbours.
"""

from __future__ import annotations

from functools import reduce

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmap.models.convolutions import PRECISION

TILE = 2
"""Side of the part of the result that is computed at once."""

IMAGE = np.array([[1, 0, -1, 0], [0, 1, 1, 0], [0, -1, 1, 0], [0, 1, 0, -1]], np.float32)
KERNEL = np.array([[1, 0, 0], [0.5, 0.5, 0.5], [0.5, -0.5, 0.5], [0, 0, 1]], np.float32)
RESULT = np.array([[1, 1, 1, 0], [0, 1, -1, -1]], np.float32)
"""The paper's B', G and A' (its section 4.1)."""

MIN_CHANNELS = 128
"""With fewer channels the transforms take longer than the products they spare."""


def transformed_kernel(kernel: Float[Array, "3 3 I O"]) -> Float[Array, "4 4 I O"]:
    """The kernel as `convolve_transformed` wants it."""
    parts = _transformed(KERNEL, [[kernel[row, column] for column in range(3)] for row in range(3)])
    return jnp.stack([jnp.stack(row) for row in parts])


def convolve_transformed(
    images: Float[Array, "B H W I"], kernel: Float[Array, "4 4 I O"], dilation: int
) -> Float[Array, "B H W O"]:
    """Convolution of stride 1 whose result has the size of the images; zeros stand beyond them."""
    batch, height, width, channels = images.shape
    down, across = (-(-size // (TILE * dilation)) for size in (height, width))
    after = [TILE * dilation * count + dilation - size for count, size in ((down, height), (across, width))]
    padded = jnp.pad(images, ((0, 0), (dilation, after[0]), (dilation, after[1]), (0, 0)))
    # Rows and columns as (pixel of one phase, phase).
    phases = padded.reshape(batch, TILE * down + 2, dilation, TILE * across + 2, dilation, channels)
    pixels = [
        [phases[:, row : row + TILE * down : TILE, :, column : column + TILE * across : TILE] for column in range(4)]
        for row in range(4)
    ]
    patches = jnp.stack([jnp.stack(row) for row in _transformed(IMAGE, pixels)])
    products = jnp.einsum("rcbytxui,rcio->rcbytxuo", patches, kernel, precision=PRECISION)
    parts = _transformed(RESULT, [list(row) for row in products])
    # (B, down, phase, across, phase, O) for each pixel of a tile, to (B, down, pixel, phase, across, pixel, phase, O).
    result = jnp.stack([jnp.stack(row, axis=4) for row in parts], axis=2)
    result = result.reshape(batch, TILE * dilation * down, TILE * dilation * across, kernel.shape[3])
    return result[:, :height, :width]


def _transformed(matrix: np.ndarray, values: list[list[Array]]) -> list[list[Array]]:
    """`matrix @ values @ matrix.T` for a matrix whose elements are arrays."""

    def combined(weights: np.ndarray, terms: list[Array]) -> Array:
        return reduce(jnp.add, [term * weight for weight, term in zip(weights, terms, strict=True) if weight])

    rows = [[combined(weights, list(column)) for column in zip(*values, strict=True)] for weights in matrix]
    return [[combined(weights, row) for weights in matrix] for row in rows]
