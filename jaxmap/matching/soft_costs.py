"""The census as a smooth function of the images, so that its costs have gradients to them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from jaxmap.matching.correlation import correlate
from jaxmap.matching.design import MatchDesign

LEVELS = 40.0
"""Grey levels over which a bit of the census changes, for a temperature of 1."""


def soft_census(
    image: Num[Array, "H W"], window_px: tuple[int, int], temperature: Float[Array, ""] | float
) -> Float[Array, "H W bits"]:
    """For each neighbour how surely it is darker than the centre, between 0 and 1.

    The threshold lies between two grey levels: of an image of integers these are the bits of the census, as the
    temperature goes to 0.
    """
    rows, columns = (size // 2 for size in window_px)
    height, width = image.shape
    image = image.astype(jnp.result_type(temperature, jnp.float32))
    padded = jnp.pad(image, ((rows, rows), (columns, columns)), "edge")
    darker_by = [
        image - padded[v : v + height, u : u + width]
        for v in range(window_px[0])
        for u in range(window_px[1])
        if (v, u) != (rows, columns)
    ]
    return jax.nn.sigmoid((jnp.stack(darker_by, -1) - 0.5) / (LEVELS * temperature))


def soft_census_costs(
    design: MatchDesign,
    left: Num[Array, "H W"],
    right: Num[Array, "H W"],
    temperature: Float[Array, ""] | float,
) -> Float[Array, "H W D"]:
    """Mean squared difference of the soft bits: the share of bits that differ, as the temperature goes to 0.

    Args:
        design: the window of the census and the disparities.
        left: rectified grey image, 0 to 255.
        right: likewise.
        temperature: of `MatchParams`.
    """
    bits, others = (soft_census(image, design.census_window_px, temperature) for image in (left, right))
    least, count = design.min_disparity_px, design.num_disparities
    # The squares of a difference written out: one product of matrices in place of an array of all bits at all
    # disparities. A channel of ones carries the other image's own square along.
    own, other = ((each * each).sum(-1, keepdims=True) for each in (bits, others))
    product = correlate(
        jnp.concatenate([-2 * bits, jnp.ones_like(own)], -1), jnp.concatenate([others, other], -1), least, count
    )
    return jnp.clip((own + product) / bits.shape[-1], 0.0, 1.0)
