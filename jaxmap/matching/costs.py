"""What it costs to match a pixel of the left image with one of the right, for every disparity."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num, UInt32

from jaxmap.matching.design import MatchDesign, MatchParams


def cost_volume(
    design: MatchDesign, left: Num[Array, "H W"], right: Num[Array, "H W"], params: MatchParams
) -> Num[Array, "H W D"]:
    """Costs of all pixels at all disparities searched.

    Args:
        design: names the kind of cost.
        left: rectified grey image, 0 to 255.
        right: likewise.
        params: hold the weights of the cost network, where the design has one.

    Returns:
        uint8 in steps of 1 / `design.cost_steps`, or in soft mode float32 in [0, 1]; the largest cost where the match
        lies outside the right image.
    """
    kinds = {"census": _census_cost, "bt": _birchfield_tomasi_cost}
    cost = kinds[design.cost](design, left, right)
    if design.block_size > 1:
        cost = _block_mean(cost, design.block_size)
    if not design.soft:
        cost = jnp.round(cost * design.cost_steps).astype(jnp.uint8)
    worst = jnp.asarray(1 if design.soft else design.cost_steps, cost.dtype)
    return jnp.where(inside(design, left.shape[1])[None], cost, worst)


def inside(design: MatchDesign, width_px: int) -> Bool[Array, "W D"]:
    """Whether the match of a column at a disparity lies in the right image."""
    column = _right_columns(design, width_px)
    return (column >= 0) & (column < width_px)


def _right_columns(design: MatchDesign, width_px: int) -> Num[Array, "W D"]:
    return jnp.arange(width_px)[:, None] - (design.min_disparity_px + jnp.arange(design.num_disparities))


def along_disparities(design: MatchDesign, right: Num[Array, "H W *c"]) -> Num[Array, "H W D *c"]:
    """The value in the right image that each disparity compares with a column of the left one; the nearest outside."""
    return right[:, jnp.clip(_right_columns(design, right.shape[1]), 0, right.shape[1] - 1)]


def census(image: Num[Array, "H W"], window_px: tuple[int, int]) -> UInt32[Array, "H W words"]:
    """One bit for each neighbour: whether it is darker than the centre (Zabih and Woodfill, ECCV 1994)."""
    rows, columns = (size // 2 for size in window_px)
    height, width = image.shape
    padded = jnp.pad(image, ((rows, rows), (columns, columns)), "edge")
    bits = [
        padded[v : v + height, u : u + width] < image
        for v in range(window_px[0])
        for u in range(window_px[1])
        if (v, u) != (rows, columns)
    ]
    words = []
    for first in range(0, len(bits), 32):
        word = jnp.zeros((height, width), jnp.uint32)
        for place, bit in enumerate(bits[first : first + 32]):
            word |= bit.astype(jnp.uint32) << place
        words.append(word)
    return jnp.stack(words, -1)


def _census_cost(design: MatchDesign, left: Num[Array, "H W"], right: Num[Array, "H W"]) -> Float[Array, "H W D"]:
    """Share of the bits that differ."""
    left_code, right_code = (census(image, design.census_window_px) for image in (left, right))
    differ = jax.lax.population_count(left_code[:, :, None] ^ along_disparities(design, right_code))
    bits = design.census_window_px[0] * design.census_window_px[1] - 1
    return differ.sum(-1).astype(jnp.float32) / bits


def _birchfield_tomasi_cost(
    design: MatchDesign, left: Num[Array, "H W"], right: Num[Array, "H W"]
) -> Float[Array, "H W D"]:
    """As OpenCV has it: of the truncated horizontal gradient, and a quarter of that of the grey levels."""
    cap = design.pre_filter_cap
    gradient = _sampling_insensitive(design, _gradient(left, cap), _gradient(right, cap))
    grey = _sampling_insensitive(design, left.astype(jnp.float32), right.astype(jnp.float32))
    return (gradient + grey / 4) / (2 * cap + 255 / 4)


def _gradient(image: Num[Array, "H W"], cap: int) -> Float[Array, "H W"]:
    """Sobel's horizontal derivative, truncated and moved to [0, 2 cap]."""
    padded = jnp.pad(image.astype(jnp.float32), 1, "edge")
    step = padded[:, 2:] - padded[:, :-2]
    sobel = step[:-2] + 2 * step[1:-1] + step[2:]
    return jnp.clip(sobel, -cap, cap) + cap


def _sampling_insensitive(
    design: MatchDesign, left: Float[Array, "H W"], right: Float[Array, "H W"]
) -> Float[Array, "H W D"]:
    """The dissimilarity of Birchfield and Tomasi (PAMI 1998): from a value to the range half a pixel around the other."""
    left_range, right_range = _half_pixel_range(left), _half_pixel_range(right)
    other, lowest, highest = (along_disparities(design, values) for values in (right, *right_range))
    one_way = jnp.maximum(jnp.maximum(left[..., None] - highest, lowest - left[..., None]), 0)
    back = jnp.maximum(jnp.maximum(other - left_range[1][..., None], left_range[0][..., None] - other), 0)
    return jnp.minimum(one_way, back)


def _half_pixel_range(image: Float[Array, "H W"]) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
    """Least and greatest value within half a pixel along the row."""
    padded = jnp.pad(image, ((0, 0), (1, 1)), "edge")
    before, after = (image + padded[:, :-2]) / 2, (image + padded[:, 2:]) / 2
    return (
        jnp.minimum(image, jnp.minimum(before, after)),
        jnp.maximum(image, jnp.maximum(before, after)),
    )


def _block_mean(cost: Float[Array, "H W D"], size: int) -> Float[Array, "H W D"]:
    half = size // 2
    padded = jnp.pad(cost, ((half, half), (half, half), (0, 0)), "edge")
    window = (size, size, 1)
    return jax.lax.reduce_window(padded, 0.0, jax.lax.add, window, (1, 1, 1), "valid") / size**2
