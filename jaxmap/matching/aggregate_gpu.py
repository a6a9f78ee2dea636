"""Semi-global aggregation on a GPU: each path line is walked by one warp, its costs in registers."""

from __future__ import annotations

import functools
import operator
import re
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu
from jaxtyping import Array, Int, UInt8

from jaxmap.errors import UsageError
from jaxmap.matching.select import Winners

STEPS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
"""Rows and columns from one pixel of a path to the next: along rows and columns, then along diagonals."""
_LANES, _IN_WORD = 32, 4
"""Threads of a warp, and costs in a 32-bit word."""
_FAR, _MOST = 1 << 14, (1 << 16) - 1
"""Greater than all costs of a path, and the greatest sum of 16 bits: those of disparities that are not searched."""
_FIELDS, _PART = 4, 128
"""Numbers that are kept of a pixel, and pixels of a row that one warp works off."""
_MOST_WORDS = 1 << 31
"""Of the costs of all paths: places are 32-bit integers."""
_TOO_OLD = re.compile(r"[1-7]\.\d")
"""Compute capabilities that Triton does not support."""

Costs = list[Int[Array, "lanes"]]
"""The costs of a pixel; thread `i` holds the disparities `i n` to `(i + 1) n - 1` as its items in the n
arrays, so that only the first and the last need another thread's."""

_Shift = Callable[[Array, int], Array]
"""Moves the items of an array to the next threads of the warp (1), or to those before (-1)."""


def check_cards(devices: Sequence[Any]) -> None:
    """Says it where the kernels cannot be compiled for one of JAX's devices, before Triton does so at length.

    Raises:
        UsageError: a card is too old for them.
    """
    for one in devices:
        # AMD's devices have other names for it, CPUs have none.
        if _TOO_OLD.fullmatch(capability := str(getattr(one, "compute_capability", ""))):
            raise UsageError(
                f"{one.device_kind} has compute capability {capability}, and the kernels of stereo matching need 8.0",
                fix="give --stereo.no-kernels: the same disparities, more slowly",
            )


def winners_gpu(volume: UInt8[Array, "H W D"], p1: Any, p2: Any, paths: int = 8, *, interpret: bool = False) -> Winners:
    """The winners of the volume, its costs aggregated along paths: those of `aggregate` and `select`, bit for bit.

    Two kernels: of each path the costs are written apart, 8 bits each, since to add them up in memory would move more;
    then they are read once for the sum and all that is kept of it, which is never written.

    Args:
        volume: matching costs; with `p2` at most 255.
        p1: penalty of a disparity step of one.
        p2: penalty of a greater step; with `p1` at most 255.
        paths: 4 (rows and columns) or 8 (and diagonals).
        interpret: runs the kernels as JAX operations, on any device.

    Raises:
        UsageError: the costs of all paths are more than 32 bits can count.
    """
    height, width, count = volume.shape
    shape = {"size": (height, width), "count": count}
    run = functools.partial(
        pl.pallas_call, compiler_params=plgpu.CompilerParams(num_warps=1, num_stages=1), interpret=interpret
    )
    padded = jnp.pad(volume, ((0, 0), (0, 0), (0, -count % (_LANES * _IN_WORD))))
    words = jax.lax.bitcast_convert_type(padded.reshape(height, width, -1, _IN_WORD), jnp.int32)
    if paths * words.size >= _MOST_WORDS:
        raise UsageError(
            f"{width}x{height} px, {count} disparities and {paths} paths are more than the kernels of stereo can count",
            fix="search fewer disparities (--stereo.num-disparities) or give --stereo.no-kernels",
        )
    ends = run(
        functools.partial(_walk, **shape, shift=_rolled if interpret else _shuffled),
        out_shape=jax.ShapeDtypeStruct((paths * words.size,), jnp.int32),
        grid=(max(height, width), paths),
        name="walk_paths",
    )(
        words.reshape(-1),
        jnp.asarray(STEPS[:paths], jnp.int32),
        jnp.stack([jnp.asarray(penalty, jnp.int32) for penalty in (p1, p2)]),
    )
    found = run(
        functools.partial(_choose, **shape, paths=paths),
        out_shape=jax.ShapeDtypeStruct((height * width * _FIELDS,), jnp.int32),
        grid=(-(-width // _PART), height),
        name="choose_winners",
    )(ends)
    best, second, lower, higher = jnp.moveaxis(found.reshape(height, width, _FIELDS), -1, 0)
    return Winners(
        place=(best & ((1 << _bits(count)) - 1)).astype(jnp.int16),
        cost=(best >> _bits(count)).astype(jnp.uint16),
        second=second.astype(jnp.uint16),
        lower=lower.astype(jnp.uint16),
        higher=higher.astype(jnp.uint16),
    )


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
            placed = [(one & 0xFF) << 8 * byte for byte, one in four]
            plgpu.store(ends.at[place + word], functools.reduce(operator.or_, placed))
        return (next_row, next_column), ahead, [jnp.where(leaves, 0, one) for one in here]

    start = [jnp.zeros(_LANES, jnp.int32)] * (per_lane * _IN_WORD)
    jax.lax.fori_loop(0, steps, step, ((row, column), read(row, column), start))


def _cheapest_step(before: Sequence[Array], p1: Array, p2: Array, lane: Array, shift: _Shift) -> Costs:
    """What it costs to come from the pixel before, above its least cost; `p2` at most."""
    least = _least(before)
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


def _choose(ends: Any, found: Any, *, size: tuple[int, int], count: int, paths: int) -> None:
    """The program of a part of a row: sums the paths and keeps the winners.

    A cost and its disparity make one number, the least of which is the first winner.
    """
    (height, width), (part, row) = map(jnp.int32, size), (pl.program_id(0), pl.program_id(1))
    lane, per_lane = jax.lax.iota(jnp.int32, _LANES), -(-count // (_LANES * _IN_WORD))
    disparity = [lane * per_lane * _IN_WORD + item for item in range(per_lane * _IN_WORD)]

    def pixel(index: Any) -> Array:
        # Where the row ends before its last part does, its last pixel comes several times.
        return row * width + jnp.minimum(part * _PART + index, width - 1)

    def read(pixel: Array) -> list[list[Array]]:
        place, apart = (pixel * _LANES + lane) * per_lane, height * width * _LANES * per_lane
        return [[plgpu.load(ends.at[path * apart + place + word]) for path in range(paths)] for word in range(per_lane)]

    def step(index: Any, packed: list[list[Array]]) -> list[list[Array]]:
        ahead = read(pixel(index + 1))
        total = [one for words in packed for one in _sum_of_bytes(words)]
        if count % (_LANES * _IN_WORD):
            total = [jnp.where(at < count, one, _MOST) for at, one in zip(disparity, total, strict=True)]
        best = _least([(one << _bits(count)) | at for at, one in zip(disparity, total, strict=True)])
        place, cost = best & ((1 << _bits(count)) - 1), best >> _bits(count)
        second, lower, higher = (
            _least([jnp.where(wanted(at - place), one, _MOST) for at, one in zip(disparity, total, strict=True)])
            for wanted in (lambda by: jnp.abs(by) > 1, lambda by: by == -1, lambda by: by == 1)
        )
        lower = jnp.where(place > 0, lower, cost)
        higher = jnp.where(place < count - 1, higher, cost)
        # All threads write, those that have the same field the same number.
        field = lane % _FIELDS
        numbers = jnp.where(field < 2, jnp.where(field == 0, best, second), jnp.where(field == 2, lower, higher))
        plgpu.store(found.at[pixel(index) * _FIELDS + field], numbers)
        return ahead

    jax.lax.fori_loop(0, _PART, step, read(pixel(0)))


def _sum_of_bytes(words: Sequence[Array]) -> Costs:
    """The sums of the bytes of words, two at a time."""
    even = functools.reduce(operator.add, [word & 0x00FF00FF for word in words])
    odd = functools.reduce(operator.add, [(word >> 8) & 0x00FF00FF for word in words])
    return [even & 0xFFFF, odd & 0xFFFF, even >> 16, odd >> 16]


def _least(costs: Sequence[Array]) -> Array:
    return functools.reduce(jnp.minimum, costs).min()


def _bits(count: int) -> int:
    """Bits that hold a disparity."""
    return max(count - 1, 1).bit_length()
