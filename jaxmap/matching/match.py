"""Semi-global matching: a rectified pair in, disparity out."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from jaxmap.matching.aggregate import aggregate_planes
from jaxmap.matching.costs import cost_planes, cost_volume
from jaxmap.matching.design import MOST_P1, MOST_P2, MatchDesign, MatchParams
from jaxmap.matching.kernel import decide_cpu, winners_cpu
from jaxmap.matching.select import Winners, decide, winners
from jaxmap.matching.soft import soft_match
from jaxmap.native.build import SELECT_TARGET, SGM_TARGET, has_kernel

_SUBPIXELS = 16


def match(
    design: MatchDesign, left: Num[Array, "H W *rgb"], right: Num[Array, "H W *rgb"], params: MatchParams
) -> Float[Array, "H W"]:
    """Disparity of the left image in px, float32; NaN where it is unknown.

    Except in soft mode it is a multiple of 1/16, as OpenCV's is and as observations keep it, so that a map is the same
    whether the step matches or its frames were matched before.

    Args:
        design: what is fixed before compiling.
        left: rectified, grey or RGB, 0 to 255.
        right: likewise, of the same size.
        params: the numbers.
    """
    left, right = grey(left), grey(right)
    if design.soft:
        found = soft_match(design, left, right, params)
        return jnp.where(found.confidence >= 0.5, found.disparity_px, jnp.nan)
    disparity_px = leave_out_doubtful(design, find_winners(design, left, right, params), params)
    return jnp.round(disparity_px * _SUBPIXELS) / _SUBPIXELS


def find_winners(
    design: MatchDesign, left: Num[Array, "H W"], right: Num[Array, "H W"], params: MatchParams
) -> Winners:
    """The cheapest disparities of two grey images, by the device's own kernels if it has some; bit for bit alike."""
    p1, p2 = penalties(design, params)

    def by_rows(left: Array, right: Array) -> Winners:
        return aggregate_planes(cost_planes(design, left, right, params), p1, p2, design.paths, winners)

    def by_paths(left: Array, right: Array) -> Winners:
        from jaxmap.matching.aggregate_gpu import check_cards, winners_gpu

        check_cards(jax.devices())
        return winners_gpu(cost_volume(design, left, right, params, at_once=True), p1, p2, design.paths)

    def on_cpu(left: Array, right: Array) -> Winners:
        return winners_cpu(design, left, right, params, p1, p2)

    if not design.kernels:
        return by_rows(left, right)
    # Where there is nothing but a CPU, the GPU's way is not even traced: to import Pallas takes a quarter of a second.
    by_device = {"cpu": on_cpu} if has_kernel(SGM_TARGET) else {}
    if jax.default_backend() != "cpu":
        by_device["cuda"] = by_paths
    return jax.lax.platform_dependent(left, right, default=by_rows, **by_device)


def leave_out_doubtful(design: MatchDesign, winner: Winners, params: MatchParams) -> Float[Array, "H W"]:
    """The disparities of winners that nothing makes doubtful; likewise."""
    plain = partial(decide, design)
    if not (design.kernels and has_kernel(SELECT_TARGET)):
        return plain(winner, params)
    return jax.lax.platform_dependent(winner, params, cpu=partial(decide_cpu, design), default=plain)


def penalties(design: MatchDesign, params: MatchParams) -> tuple[Array, Array]:
    """The penalties in the units of the volume of costs, at most what 8 bits hold."""
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
