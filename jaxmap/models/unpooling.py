"""SegNet's pair of max pooling and unpooling (Badrinarayanan et al. 2017, section 3): values go back where they were.

Windows are the four pixels of 2 x 2; of equal ones the first wins, row by row, as in torch. Both are sums of shifted
slices and comparisons, which XLA fuses and differentiates without a scatter.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, UInt8

Places = UInt8[Array, "B h w C"]
"""Which pixel of each 2 x 2 was the largest: 0 and 1 above, 2 and 3 below, from left to right."""

_PIXELS = ((0, 0), (0, 1), (1, 0), (1, 1))


def pool_with_places(images: Float[Array, "B H W C"]) -> tuple[Float[Array, "B h w C"], Places]:
    """The largest of each 2 x 2 pixels, and its place; sides must be even. The gradient goes to that place alone."""
    pixels = [images[:, row::2, column::2] for row, column in _PIXELS]
    largest, places = pixels[0], jnp.zeros(pixels[0].shape, jnp.uint8)
    for place, pixel in enumerate(pixels[1:], start=1):
        wins = pixel > largest
        largest = jnp.where(wins, pixel, largest)
        places = jnp.where(wins, jnp.uint8(place), places)
    return largest, places


def unpool(images: Float[Array, "B h w C"], places: Places) -> Float[Array, "B H W C"]:
    """Each value at its place in 2 x 2 pixels, and zeros beside it."""
    batch, height, width, channels = images.shape
    pixels = [jnp.where(places == place, images, 0) for place in range(len(_PIXELS))]
    rows = [jnp.stack(pixels[first : first + 2], axis=3) for first in (0, 2)]
    return jnp.stack(rows, axis=2).reshape(batch, 2 * height, 2 * width, channels)
