"""Scalar products of features along epipolar lines, as products of matrices."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_BLOCK = 128


def correlate(
    left: Float[Array, "H W C"], right: Float[Array, "H W C"], min_disparity_px: int, num_disparities: int
) -> Float[Array, "H W D"]:
    """The product of each pixel's features with those of its match at each disparity.

    Beyond the right image, with those of its outermost column.

    One product of matrices for each row and block of columns, and from each the band of the disparities.
    """
    height, width, channels = left.shape
    blocks = -(-width // _BLOCK)
    # Column j of block b of the right image is column b * _BLOCK + j - farthest.
    farthest = num_disparities - 1 + min_disparity_px
    columns = jnp.arange(blocks)[:, None] * _BLOCK + jnp.arange(_BLOCK + num_disparities) - farthest
    windows = right[:, jnp.clip(columns, 0, width - 1)]
    padded = jnp.pad(left, ((0, 0), (0, blocks * _BLOCK - width), (0, 0)))
    padded = padded.reshape(height, blocks, _BLOCK, channels)
    products = jnp.einsum("hbic,hbjc->hbij", padded, windows, precision=jax.lax.Precision.HIGHEST)
    band = _diagonals(products, num_disparities)[..., ::-1]
    return band.reshape(height, blocks * _BLOCK, num_disparities)[:, :width]


def _diagonals(matrices: Float[Array, "*b I J"], count: int) -> Float[Array, "*b I k"]:
    """Row i from its element i on: read with rows one longer, a matrix has its diagonals as columns."""
    *batch, rows, columns = matrices.shape
    flat = matrices.reshape(*batch, rows * columns)
    flat = jnp.pad(flat, [(0, 0)] * len(batch) + [(0, rows)])
    return flat.reshape(*batch, rows, columns + 1)[..., :count]
