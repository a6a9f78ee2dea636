"""Semi-global matching: a rectified pair in, disparity out."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from jaxmap.matching.aggregate import aggregate_planes
from jaxmap.matching.costs import cost_planes
from jaxmap.matching.design import MOST_P1, MOST_P2, MatchDesign, MatchParams
from jaxmap.matching.select import decide, winners

_SUBPIXELS = 16


def match(
    design: MatchDesign, left: Num[Array, "H W *rgb"], right: Num[Array, "H W *rgb"], params: MatchParams
) -> Float[Array, "H W"]:
    """Disparity of the left image in px, float32; NaN where it is unknown.

    But in soft mode it is a multiple of 1/16, as OpenCV's are and as observations are kept: a map comes out the same
    whichever way its frames went.

    Args:
        design: what is fixed before compiling.
        left: rectified, grey or RGB, 0 to 255.
        right: likewise, of the same size.
        params: the numbers.
    """
    left, right = grey(left), grey(right)
    costs, turned = (cost_planes(design, left, right, turned=turned) for turned in (False, True))
    p1, p2 = penalties(design, params)
    disparity_px = decide(design, aggregate_planes(costs, turned, p1, p2, design.paths, winners), params)
    return disparity_px if design.soft else jnp.round(disparity_px * _SUBPIXELS) / _SUBPIXELS


def penalties(design: MatchDesign, params: MatchParams) -> tuple[Array, Array]:
    """The penalties in the units of the volume of costs; where they are small integers, at most what 8 bits hold."""
    if design.soft:
        return params.p1, params.p2
    steps = (jnp.clip(params.p1, 0, MOST_P1), jnp.clip(params.p2, 0, MOST_P2))
    p1, p2 = (jnp.round(penalty * design.cost_steps).astype(jnp.uint8) for penalty in steps)
    return p1, p2


def grey(image: Num[Array, "H W *rgb"]) -> Num[Array, "H W"]:
    """Luminance of an RGB image (ITU-R BT.601); of integers in OpenCV's integer arithmetic, alike in any program."""
    if image.ndim == 2:
        return image
    red, green, blue = (image[..., channel] for channel in range(3))
    if not jnp.issubdtype(image.dtype, jnp.integer):
        return 0.299 * red + 0.587 * green + 0.114 * blue
    red, green, blue = (channel.astype(jnp.int32) for channel in (red, green, blue))
    return ((9798 * red + 19235 * green + 3735 * blue + (1 << 14)) >> 15).astype(image.dtype)
