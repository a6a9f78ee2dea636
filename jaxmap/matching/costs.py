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
from jaxmap.matching.mccnn import feature_costs
from jaxmap.matching.soft_costs import soft_census_costs

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


def cost_volume(
    design: MatchDesign, left: Image, right: Image, params: MatchParams, *, at_once: bool = False
) -> Num[Array, "H W D"]:
    """Costs of all pixels at all disparities searched.

    Args:
        design: names the kind of cost.
        left: rectified grey image, 0 to 255.
        right: likewise.
        params: hold the weights of the cost network, where the design has one.
        at_once: computes all disparities side by side, as a GPU likes it, and not one after the other.

    Returns:
        uint8 in steps of 1 / `design.cost_steps`, or in soft mode float32 in [0, 1]; the largest cost where the match
        lies outside the right image.
    """
    if at_once and not (design.soft or design.cost == "mccnn"):
        return _costs_at_once(design, left, right)
    return jnp.moveaxis(cost_planes(design, left, right, params), 0, -1)


def cost_planes(design: MatchDesign, left: Image, right: Image, params: MatchParams) -> Num[Array, "D H W"]:
    """The same, one plane for each disparity."""
    if design.soft or design.cost == "mccnn":
        return jnp.moveaxis(_float_costs(design, left, right, params), -1, 0)
    kind = kind_of(design)
    width = left.shape[1]
    first, column = design.min_disparity_px, jnp.arange(width)
    compare = _comparison(design, kind, left, right)

    def raw(place: Array) -> Image:
        return _in_steps(design, kind, compare(place))

    def cost(place: Array, plane: Image) -> Image:
        disparity = first + place
        inside = (column >= disparity) & (column - disparity < width)
        return jnp.where(inside, plane, _in_steps(design, kind, jnp.asarray(kind.greatest)))

    if design.block_size == 1:
        return jax.lax.map(lambda place: cost(place, raw(place)), jnp.arange(design.num_disparities))
    return _averaged(design, raw, cost, left.shape)


def _costs_at_once(design: MatchDesign, left: Image, right: Image) -> UInt8[Array, "H W D"]:
    """Small integers, all planes side by side."""
    kind, size = kind_of(design), design.block_size
    compare, places = _comparison(design, kind, left, right), jnp.arange(design.num_disparities)
    cost = jax.vmap(lambda place: _in_steps(design, kind, compare(place)), out_axes=-1)(places)
    if size > 1:
        total = cost.astype(jnp.uint16)
        for axis in (0, 1):
            # Kept in memory, else XLA might compare pixels anew for each of the block.
            total = _box_sum(jax.lax.optimization_barrier(total), size, axis)
        cost = ((total + size**2 // 2) // size**2).astype(jnp.uint8)
    column = jnp.arange(left.shape[1])[:, None] - design.min_disparity_px - places
    inside = (column >= 0) & (column < left.shape[1])
    return jnp.where(inside, cost, _in_steps(design, kind, jnp.asarray(kind.greatest)))


def _in_steps(design: MatchDesign, kind: Kind, cost: Array) -> Array:
    """In the units of the design."""
    if jnp.issubdtype(cost.dtype, jnp.integer):
        return (cost * (design.cost_steps // int(kind.greatest))).astype(jnp.uint8)
    return jnp.round(cost * (design.cost_steps / kind.greatest)).astype(jnp.uint8)


def _averaged(
    design: MatchDesign, raw: Callable[[Array], Image], cost: Callable[[Array, Image], Image], shape: tuple[int, ...]
) -> Num[Array, "D H W"]:
    """Planes of the mean over a block around each pixel; edges are repeated.

    While one plane is compared, the one before it is summed along one axis and the one before that along the other:
    each waits in memory for its turn, else XLA would compare pixels anew for each of the block.
    """
    size, count = design.block_size, design.num_disparities
    narrow, wide = jnp.uint8, jnp.uint16

    def step(i: Array, state: tuple[Image, Image, Array]) -> tuple[Image, Image, Array]:
        compared, summed, planes = state
        place = jnp.maximum(i - 2, 0)
        total = _box_sum(summed, size, 1)
        mean = ((total + size**2 // 2) // size**2).astype(narrow)
        planes = jax.lax.dynamic_update_index_in_dim(planes, cost(place, mean), place, 0)
        return raw(jnp.minimum(i, count - 1)), _box_sum(compared.astype(wide), size, 0), planes

    start = jnp.zeros(shape, narrow), jnp.zeros(shape, wide), jnp.zeros((count, *shape), narrow)
    return jax.lax.fori_loop(0, count + 2, step, start)[2]


def _box_sum(plane: Image, size: int, axis: int) -> Image:
    """Sums of so many neighbours along an axis."""
    margin = [(0, 0)] * plane.ndim
    margin[axis] = (size // 2, size // 2)
    padded, length = jnp.pad(plane, margin, "edge"), plane.shape[axis]
    parts = [jax.lax.slice_in_dim(padded, i, i + length, axis=axis) for i in range(size)]
    return sum(parts[1:], parts[0])


def _box_mean(plane: Image, size: int) -> Image:
    return _box_sum(_box_sum(plane, size, 0), size, 1) / size**2


def _float_costs(design: MatchDesign, left: Image, right: Image, params: MatchParams) -> Num[Array, "H W D"]:
    """Costs that are no small integers from the first: a network's, and all of the soft mode."""
    first, count = design.min_disparity_px, design.num_disparities
    if design.cost == "mccnn":
        cost = feature_costs(params.cost, left, right, first, count)
    elif design.cost == "census":
        cost = soft_census_costs(design, left, right, params.temperature)
    else:
        kind = kind_of(design)
        cost = jax.vmap(_comparison(design, kind, left, right), out_axes=-1)(jnp.arange(count)) / kind.greatest
    if design.block_size > 1:
        cost = jax.vmap(_box_mean, (-1, None), -1)(cost, design.block_size)
    column = jnp.arange(left.shape[1])[:, None] - first - jnp.arange(count)
    cost = jnp.where((column >= 0) & (column < left.shape[1]), cost, 1)
    return cost if design.soft else jnp.round(cost * design.cost_steps).astype(jnp.uint8)


def _comparison(design: MatchDesign, kind: Kind, left: Image, right: Image) -> Callable[[Array], Image]:
    """Gives what a match costs, in the units of its kind, from the place of a disparity among those searched."""
    width = left.shape[1]
    first, last = design.min_disparity_px, design.min_disparity_px + design.num_disparities - 1
    before, after = max(last, 0), max(-first, 0)
    left_features = kind.describe(left)
    right_features = tuple(jnp.pad(one, ((0, 0), (before, after)), "edge") for one in kind.describe(right))

    def compare(place: Array) -> Image:
        start = before - first - place
        moved = tuple(jax.lax.dynamic_slice_in_dim(one, start, width, 1) for one in right_features)
        return kind.compare(left_features, moved)

    return compare


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
