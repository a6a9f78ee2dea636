"""Smaller images to be matched many times over: fewer pixels at fewer disparities, for the map of full size."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jaxmap.datasets.images import as_rgb
from jaxmap.matching.design import MatchDesign
from jaxmap.matching.match import grey
from jaxmap.matching.select import usual_speckle_px
from jaxmap.stereo.front_end import RectifiedFrame
from jaxmap.types import to_device


class SmallPair(NamedTuple):
    """Both rectified images in grey, made smaller."""

    left: UInt8[Array, "h w"]
    right: UInt8[Array, "h w"]


def small_design(design: MatchDesign, image_px: int, times: int) -> MatchDesign:
    """A soft design that searches the same depths in images so many times smaller, and checks them as strictly.

    Args:
        design: of the images as they are.
        image_px: their pixels.
        times: how many times smaller, in rows and columns.
    """
    least = design.min_disparity_px // times
    last = -(-(design.min_disparity_px + design.num_disparities) // times)
    window = usual_speckle_px(image_px) if design.speckle_window_px is None else design.speckle_window_px
    return replace(
        design,
        soft=True,
        min_disparity_px=least,
        num_disparities=last - least,
        speckle_window_px=window // times**2,
        speckle_range_px=design.speckle_range_px / times,
        block_size=design.block_size // (2 * times) * 2 + 1,
        edge_window_px=design.edge_window_px // (2 * times) * 2 + 1,
        edge_step_px=design.edge_step_px / times,
    )


def small_pair(rectified: RectifiedFrame, times: int) -> SmallPair:
    """The images of a frame, so many times smaller; rows and columns that are left over are cut off."""
    return SmallPair(*(to_device(_mean(as_rgb(image), times)) for image in (rectified.left, rectified.right)))


def at_full_size(small: Float[Array, "h w"], shape: tuple[int, int], times: int) -> Float[Array, "H W"]:
    """Each pixel as a square of so many a side, with NaN in rows and columns left over; not scaled.

    Relief takes means over squares of four pixels, which are the small ones again, or of them.
    """
    large = jnp.repeat(jnp.repeat(small, times, 0), times, 1)
    left_over = [(0, wanted - there) for wanted, there in zip(shape, large.shape, strict=True)]
    return jnp.pad(large, left_over, constant_values=jnp.nan)


def _mean(image: np.ndarray, times: int) -> np.ndarray:
    """Means of squares of pixels, in grey and rounded: a network, too, takes small integers."""
    rows, columns = (size // times for size in image.shape[:2])
    cut = image[: rows * times, : columns * times].astype(np.float32)
    means = np.rint(cut.reshape(rows, times, columns, times, -1).mean((1, 3))).astype(np.uint8)
    return np.asarray(grey(to_device(means)))
