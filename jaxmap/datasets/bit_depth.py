"""From deep images to 8 bits: cameras store 10, 12 or 14 bits in files of 16, and files do not say how many."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, get_args

import numpy as np
from jaxtyping import UInt8, UInt16

from jaxmap.datasets.options import Bits

BRIGHT_SHARE = 0.005
"""Share of the pixels that may be brighter than the range: hot pixels, dead columns, glints. They become white."""

_TOP = 65535
_MOST_PIXELS = 200_000


class BitDepth(NamedTuple):
    """How many bits images use, and the share of their pixels that are brighter all the same."""

    bits: Bits
    brighter: float


def used_bits(images: Iterable[UInt16[np.ndarray, "H W *rgb"]]) -> BitDepth:
    """The least depth that holds all but `BRIGHT_SHARE` of the pixels of 16-bit images.

    Pixels of 65535 have no say: they are saturated, hot, or mark what was not seen. In images that do use 16 bits,
    others are bright, too.

    Args:
        images: of one sequence, best of both cameras, or the channels of one picture.
    """
    samples = []
    for pixels in images:
        step = max(1, round((pixels.shape[0] * pixels.shape[1] / _MOST_PIXELS) ** 0.5))
        samples.append(pixels[::step, ::step].ravel())
    values = np.concatenate(samples)
    seen = values[values < _TOP]
    bright = np.quantile(seen, 1 - BRIGHT_SHARE) if len(seen) else _TOP
    bits = next(bits for bits in get_args(Bits) if bright < 2**bits)
    return BitDepth(bits, float((values >= 2**bits).mean()))


def bits_note(bits: int, brighter: float) -> str:
    """What a reader tells of the depth that it found."""
    return (
        f"the 16-bit images are taken to use {bits} bits ({100 * brighter:.2g} % of their pixels are brighter, and "
        "become white); --image-bits sets it"
    )


def to_8_bits(pixels: UInt8[np.ndarray, "H W *rgb"] | UInt16[np.ndarray, "H W *rgb"], bits: int) -> np.ndarray:
    """Shifts 16-bit pixels that use so many bits down to uint8, brighter ones to 255; 8-bit pixels stay as they are."""
    if pixels.dtype == np.uint8:
        return pixels
    return (np.minimum(pixels, 2**bits - 1) >> (bits - 8)).astype(np.uint8)
