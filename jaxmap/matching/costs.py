"""What it costs to match a pixel of the left image with one of the right, for every disparity.

A kind of cost turns each image into features of its pixels, and compares the features of two pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num, UInt8, UInt32

from jaxmap.matching.design import MatchDesign, MatchParams

Image = Num[Array, "H W"]
Features = tuple[Image, ...]


class Kind(NamedTuple):
    """A way to compare pixels.

    Attributes:
        describe: the features of an image, each of its size.
        compare: the cost of two pixels by their features, from 0 to `greatest`.
        greatest: the largest cost.
    """

    describe: Callable[[Image], Features]
    compare: Callable[[Features, Features], Image]
    greatest: float


def cost_volume(design: MatchDesign, left: Image, right: Image, params: MatchParams) -> Num[Array, "H W D"]:
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
    del params
    return jnp.moveaxis(cost_planes(design, left, right), 0, -1)


def cost_planes(design: MatchDesign, left: Image, right: Image, *, turned: bool = False) -> Num[Array, "D H W"]:
    """The same, one plane for each disparity.

    Args:
        design: names the kind of cost.
        left: rectified grey image, 0 to 255.
        right: likewise.
        turned: gives each plane as (W, H). To compute it twice is faster than to turn it.
    """
    kind = kind_of(design)
    width, axis = left.shape[1], 0 if turned else 1
    first, last = design.min_disparity_px, design.min_disparity_px + design.num_disparities - 1
    before, after = max(last, 0), max(-first, 0)
    margin = [(0, 0), (0, 0)]
    margin[axis] = (before, after)
    left_features, right_features = (
        tuple(one.T if turned else one for one in kind.describe(image)) for image in (left, right)
    )
    right_features = tuple(jnp.pad(one, margin, "edge") for one in right_features)
    column = jnp.arange(width) if not turned else jnp.arange(width)[:, None]

    def plane(disparity: Array) -> Num[Array, "H W"]:
        moved = tuple(jax.lax.dynamic_slice_in_dim(one, before - disparity, width, axis) for one in right_features)
        cost = kind.compare(left_features, moved)
        inside = (column >= disparity) & (column - disparity < width)
        return jnp.where(inside, *_scaled(design, kind, cost))

    return jax.lax.map(plane, jnp.arange(first, last + 1))


def _scaled(design: MatchDesign, kind: Kind, cost: Image) -> tuple[Image, Array]:
    """Averaged over blocks and in the units of the design; and the largest cost."""
    if design.block_size > 1:
        cost = block_mean(cost.astype(jnp.float32), design.block_size)
    if design.soft:
        return cost / kind.greatest, jnp.ones((), cost.dtype)
    if jnp.issubdtype(cost.dtype, jnp.integer):
        cost = cost * (design.cost_steps // int(kind.greatest))
    else:
        cost = jnp.round(cost * (design.cost_steps / kind.greatest))
    return cost.astype(jnp.uint8), jnp.uint8(design.cost_steps)


def kind_of(design: MatchDesign) -> Kind:
    """The kind of cost that the design names."""
    if design.cost == "census":
        window_px = design.census_window_px
        return Kind(lambda image: census(image, window_px), hamming, window_px[0] * window_px[1] - 1)
    cap = design.pre_filter_cap
    return Kind(lambda image: ranges(image, cap), birchfield_tomasi, 2 * cap + 255 / 4)


def census(image: Image, window_px: tuple[int, int]) -> tuple[UInt32[Array, "H W"], ...]:
    """One bit for each neighbour, 32 to a word: whether it is darker than the centre (Zabih and Woodfill, 1994)."""
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
    return tuple(words)


def hamming(left: Features, right: Features) -> UInt8[Array, "H W"]:
    """How many bits differ."""
    differ = [jax.lax.population_count(a ^ b) for a, b in zip(left, right, strict=True)]
    return sum(differ[1:], differ[0]).astype(jnp.uint8)


def ranges(image: Image, cap: int) -> tuple[Float[Array, "H W"], ...]:
    """The truncated horizontal gradient and a quarter of the grey level, each with its range half a pixel around.

    So OpenCV's StereoSGBM has it. The gradient is Sobel's, moved to [0, 2 cap].
    """
    grey = image.astype(jnp.result_type(image, jnp.float32))
    padded = jnp.pad(grey, 1, "edge")
    step = padded[:, 2:] - padded[:, :-2]
    gradient = jnp.clip(step[:-2] + 2 * step[1:-1] + step[2:], -cap, cap) + cap
    return (*_with_range(gradient), *_with_range(grey / 4))


def _with_range(values: Float[Array, "H W"]) -> tuple[Float[Array, "H W"], ...]:
    """The values, and the least and the greatest half a pixel around along the row."""
    padded = jnp.pad(values, ((0, 0), (1, 1)), "edge")
    before, after = (values + padded[:, :-2]) / 2, (values + padded[:, 2:]) / 2
    return (
        values,
        jnp.minimum(values, jnp.minimum(before, after)),
        jnp.maximum(values, jnp.maximum(before, after)),
    )


def birchfield_tomasi(left: Features, right: Features) -> Float[Array, "H W"]:
    """Dissimilarity that does not mind where pixels sample (Birchfield and Tomasi, PAMI 1998), over pairs of ranges."""
    total = jnp.zeros(left[0].shape, left[0].dtype)
    for first in range(0, len(left), 3):
        here, low, high = left[first : first + 3]
        there, other_low, other_high = right[first : first + 3]
        to_right = jnp.maximum(jnp.maximum(here - other_high, other_low - here), 0)
        to_left = jnp.maximum(jnp.maximum(there - high, low - there), 0)
        total += jnp.minimum(to_right, to_left)
    return total


def block_mean(cost: Float[Array, "H W"], size: int) -> Float[Array, "H W"]:
    """Mean over a square around each pixel; edges are repeated."""
    half = size // 2
    for axis in (0, 1):
        margin = [(0, 0), (0, 0)]
        margin[axis] = (half, half)
        padded, length = jnp.pad(cost, margin, "edge"), cost.shape[axis]
        cost = sum(
            (jax.lax.slice_in_dim(padded, i, i + length, axis=axis) for i in range(1, size)),
            jax.lax.slice_in_dim(padded, 0, length, axis=axis),
        )
    return cost / size**2
