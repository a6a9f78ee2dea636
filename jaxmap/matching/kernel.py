"""Matching by kernels in C++ (`native/sgm.cpp`, `native/select.cpp`), on a CPU: bit for bit as the plain form does it.

The plain form goes through whole rows of all disparities once for each operation. The kernel keeps a pixel's
disparities in registers, and what it needs of the row before in the cache; it also makes the costs of the census. Other
kinds of cost are given to it as a volume. What is doubtful is then left out in a few passes over the image, where XLA
hands labels of blobs from row to row many times.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaxmap.matching.costs import Image, cost_volume, kind_of
from jaxmap.matching.design import MatchDesign, MatchParams
from jaxmap.matching.select import Winners, most_speckle_px
from jaxmap.native.build import SELECT_TARGET, SGM_TARGET


def winners_cpu(
    design: MatchDesign, left: Image, right: Image, params: MatchParams, p1: Num[Array, ""], p2: Num[Array, ""]
) -> Winners:
    """The winners of a rectified pair.

    Args:
        design: of the hard mode.
        left: grey, 0 to 255.
        right: likewise.
        params: hold the weights of the cost network, where the design has one.
        p1: penalty of a disparity step of one, in steps of the cost, uint8.
        p2: penalty of a greater one, likewise.
    """
    height, width = left.shape
    block, scale = 1, 1
    if design.cost == "census":
        kind = kind_of(design)
        words = [jnp.stack(kind.describe(image)) for image in (left, right)]
        costs = jnp.zeros((0, 0, 0), jnp.uint8)
        block, scale = design.block_size, design.cost_steps // int(kind.greatest)
    else:
        words = [jnp.zeros((0, 0, 0), jnp.uint32)] * 2
        costs = cost_volume(design, left, right, params)
    call = jax.ffi.ffi_call(
        SGM_TARGET,
        tuple(jax.ShapeDtypeStruct((height, width), dtype) for dtype in (jnp.int16, *[jnp.uint16] * 4)),
        vmap_method="sequential",
    )
    numbers = {
        "paths": design.paths,
        "disparities": design.num_disparities,
        "first": design.min_disparity_px,
        "block": block,
        "scale": scale,
        "outside": design.cost_steps,
    }
    found = call(*words, costs, jnp.stack([p1, p2]), **{name: np.int64(number) for name, number in numbers.items()})
    return Winners(*found)


def decide_cpu(design: MatchDesign, winner: Winners, params: MatchParams) -> Float[Array, "H W"]:
    """`select.decide` of winners whose costs are small integers."""
    call = jax.ffi.ffi_call(
        SELECT_TARGET, jax.ShapeDtypeStruct(winner.place.shape, jnp.float32), vmap_method="sequential"
    )
    return call(
        *winner,
        params.uniqueness,
        disparities=np.int64(design.num_disparities),
        first=np.int64(design.min_disparity_px),
        most_apart=np.float32(design.left_right_max_diff_px),
        speckle_range=np.float32(design.speckle_range_px),
        speckle_most=np.int64(most_speckle_px(design, winner.place.size)),
        edge_step=np.float32(design.edge_step_px),
        edge_window=np.int64(design.edge_window_px),
    )
