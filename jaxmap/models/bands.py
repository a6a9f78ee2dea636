"""Images made a few rows at a time, so that what lies between input and result stays in the processor's cache."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

BAND_BYTES = 1 << 20
"""What a band of rows may hold, so that it stays in the processor's cache."""


def rows_per_band(rows: int, row_bytes: int, limit: int = BAND_BYTES) -> int:
    """Rows of equal bands of at most `limit` bytes; at least one."""
    bands = -(-rows // max(limit // row_bytes, 1))
    return -(-rows // bands)


def by_bands(
    function: Callable[[Int[Array, ""]], Float[Array, "B h W C"]], rows: int, band: int
) -> Float[Array, "B H W C"]:
    """The `rows` rows of an image, of which `function` gives `band` from a first one on.

    Where bands do not fill the rows, the last one begins earlier and writes some rows again.
    """
    shape = jax.eval_shape(function, jax.ShapeDtypeStruct((), jnp.int32))

    def put(index: Array, result: Array) -> Array:
        first = jnp.minimum(index * band, rows - band)
        return jax.lax.dynamic_update_slice_in_dim(result, function(first), first, axis=1)

    empty = jnp.zeros((shape.shape[0], rows, *shape.shape[2:]), shape.dtype)
    return jax.lax.fori_loop(0, -(-rows // band), put, empty)
