"""Semi-global aggregation on a GPU: each path line is walked by one warp, its costs in registers."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu
from jaxtyping import Array, Int, UInt8, UInt16

STEPS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
"""Rows and columns from one pixel of a path to the next: along rows and columns, then along diagonals."""
_LANES, _IN_WORD = 32, 4
"""Threads of a warp, and costs in a 32-bit word."""
_FAR = 1 << 14
"""Greater than all costs: that of disparities that are not searched."""

Costs = list[Int[Array, "lanes"]]
"""The costs of a pixel; thread `i` holds the disparities `i n` to `(i + 1) n - 1` as its items in the n
arrays, so that only the first and the last need another thread's."""

_Shift = Callable[[Array, int], Array]
"""Moves the items of an array to the next threads of the warp (1), or to those before (-1)."""


def aggregate_gpu(
    volume: UInt8[Array, "H W D"], p1: Any, p2: Any, paths: int = 8, *, interpret: bool = False
) -> UInt16[Array, "H W D"]:
    """`aggregate.aggregate` of a volume of small integers, bit for bit, as one kernel for all paths and one for their sum.

    Of each path the costs are written apart, 8 bits each, since to add them up in memory would move more.

    Args:
        volume: matching costs; with `p2` at most 255.
        p1: penalty of a disparity step of one.
        p2: penalty of a greater step; with `p1` at most 255.
        paths: 4 (rows and columns) or 8 (and diagonals).
        interpret: runs the kernel as JAX operations, on any device.
    """
    height, width, count = volume.shape
    padded = jnp.pad(volume, ((0, 0), (0, 0), (0, -count % (_LANES * _IN_WORD))))
    words = jax.lax.bitcast_convert_type(padded.reshape(height, width, -1, _IN_WORD), jnp.int32)
    ends = pl.pallas_call(
        functools.partial(_walk, size=(height, width), count=count, shift=_rolled if interpret else _shuffled),
        out_shape=jax.ShapeDtypeStruct((paths * words.size,), jnp.int32),
        grid=(max(height, width), paths),
        compiler_params=plgpu.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
        name="walk_paths",
    )(
        words.reshape(-1),
        jnp.asarray(STEPS[:paths], jnp.int32),
        jnp.stack([jnp.asarray(penalty, jnp.int32) for penalty in (p1, p2)]),
    )
    total = _sum_of_bytes(ends.reshape(paths, *words.shape))
    # Else each of its consumers would compute the sum anew.
    return jax.lax.optimization_barrier(total[..., :count])


def _walk(
    volume: Any, directions: Any, penalties: Any, ends: Any, *, size: tuple[int, int], count: int, shift: _Shift
) -> None:
    """The program of one line in one direction, and of one warp: thread `i` holds item `i` of every array."""
    (height, width), path = map(jnp.int32, size), pl.program_id(1)
    down, right = directions[path, 0], directions[path, 1]
    p1, p2 = penalties[0], penalties[1]
    lane, per_lane = jax.lax.iota(jnp.int32, _LANES), -(-count // (_LANES * _IN_WORD))
    along_row = down == 0
    steps, lines = jnp.where(along_row, width, height), jnp.where(along_row, height, width)
    # Where the image has fewer lines that way, the last one is walked several times.
    line = jnp.minimum(pl.program_id(0), lines - 1)
    row = jnp.where(along_row, line, jnp.where(down > 0, jnp.int32(0), height - 1))
    column = jnp.where(along_row, jnp.where(right > 0, jnp.int32(0), width - 1), line)

    def words(row: Array, column: Array) -> Array:
        return ((row * width + column) * _LANES + lane) * per_lane

    def read(row: Array, column: Array) -> list[Array]:
        return [plgpu.load(volume.at[words(row, column) + word]) for word in range(per_lane)]

    def step(_: Any, carry: tuple[Any, ...]) -> tuple[Any, ...]:
        (row, column), packed, before = carry
        next_row, next_column = row + down, column + right
        # A diagonal that leaves at one side goes on at the other, as a new path.
        leaves = (next_column < 0) | (next_column >= width)
        next_column = jnp.where(leaves, width - jnp.abs(next_column), next_column)
        # Read a step ahead, since memory takes longer than a step; after the last, any pixel.
        ahead = read(jnp.clip(next_row, 0, height - 1), next_column)
        costs = [(word >> 8 * byte) & 0xFF for word in packed for byte in range(_IN_WORD)]
        here = [cost + way for cost, way in zip(costs, _cheapest_step(before, p1, p2, lane, shift), strict=True)]
        if count % (_LANES * _IN_WORD):
            here = [jnp.where(lane * len(here) + item < count, one, _FAR) for item, one in enumerate(here)]
        place = path * (height * width * _LANES * per_lane) + words(row, column)
        for word in range(per_lane):
            four = enumerate(here[_IN_WORD * word : _IN_WORD * (word + 1)])
            plgpu.store(ends.at[place + word], sum((one & 0xFF) << 8 * byte for byte, one in four))
        return (next_row, next_column), ahead, [jnp.where(leaves, 0, one) for one in here]

    start = [jnp.zeros(_LANES, jnp.int32)] * (per_lane * _IN_WORD)
    jax.lax.fori_loop(0, steps, step, ((row, column), read(row, column), start))


def _cheapest_step(before: Sequence[Array], p1: Array, p2: Array, lane: Array, shift: _Shift) -> Costs:
    """What it costs to come from the pixel before, above its least cost; `p2` at most."""
    least = functools.reduce(jnp.minimum, before).min()
    stay = [jnp.minimum(one - least, p2) for one in before]
    lower = jnp.where(lane == 0, _FAR, shift(stay[-1], 1))
    upper = jnp.where(lane == _LANES - 1, _FAR, shift(stay[0], -1))
    ladder = [lower, *stay, upper]
    return [
        jnp.minimum(here, jnp.minimum(below, above) + p1)
        for below, here, above in zip(ladder, ladder[1:], ladder[2:])  # noqa: B905
    ]


def _shuffled(values: Array, by: int) -> Array:
    way = "up.b32 $0, $1, 1, 0" if by > 0 else "down.b32 $0, $1, 1, 31"
    [moved] = plgpu.elementwise_inline_asm(
        f"shfl.sync.{way}, -1;",
        args=[values],
        constraints="=r,r",
        pack=1,
        result_shape_dtypes=[jax.ShapeDtypeStruct(values.shape, values.dtype)],
    )
    return moved


def _rolled(values: Array, by: int) -> Array:
    return jnp.roll(values, by)


def _sum_of_bytes(words: Int[Array, "paths H W words"]) -> UInt16[Array, "H W D"]:
    """The sum over paths; two bytes of a word at a time, so that what is read and written stays whole words."""
    even = sum(one & 0x00FF00FF for one in words)
    odd = sum((one >> 8) & 0x00FF00FF for one in words)
    first, last = (even & 0xFFFF) | (odd << 16), ((even >> 16) & 0xFFFF) | (odd & -0x10000)
    pairs = jax.lax.bitcast_convert_type(jnp.stack([first, last], -1), jnp.uint16)
    return pairs.reshape(*words.shape[1:3], -1)
