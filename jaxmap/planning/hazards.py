"""Hazards of the ground under a rover, from heights alone: step, slope and roughness of a rover-sized disc.

They are those of GESTALT, the hazard avoidance of the Mars Exploration Rovers (Goldberg, Maimone and Matthies 2002,
"Stereo vision and rover navigation software for planetary exploration"; Maimone, Cheng and Matthies 2007, "Two years of
visual odometry on the Mars Exploration Rovers"): a plane is fitted to the disc around each cell; its tilt is the slope,
the scatter about it the roughness, and the greatest jump between neighbours the step.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

_LEAST_CELLS = 4
"""Through fewer heights there always is a plane."""
_FLATTEST = 1e-3
"""Least spread of the cells of a disc, as a part of its radius squared: along a line there is no plane."""


AnyArray = Array | np.ndarray
"""Of JAX or of NumPy."""


class Heights(NamedTuple):
    """Heights of the ground by cells: x is the first axis, y the second.

    `height_m` and its standard deviation `sigma_m` mean nothing where the ground is not `known`.
    """

    height_m: Float[AnyArray, "X Y"]
    sigma_m: Float[AnyArray, "X Y"]
    known: Bool[AnyArray, "X Y"]


class Hazards(NamedTuple):
    """Hazards of the disc around each cell, and the standard deviation of each; NaN where they are not known.

    Attributes:
        step_m: greatest jump of height over a short distance, less the slope and less its own standard deviation.
        slope_deg: tilt of the plane.
        roughness_m: root mean square of the distances of the cells from the plane.
    """

    step_m: Float[AnyArray, "X Y"]
    slope_deg: Float[AnyArray, "X Y"]
    roughness_m: Float[AnyArray, "X Y"]
    step_sigma_m: Float[AnyArray, "X Y"]
    slope_sigma_deg: Float[AnyArray, "X Y"]
    roughness_sigma_m: Float[AnyArray, "X Y"]


class Disc(NamedTuple):
    """Cells around a cell, as static offsets."""

    cells: tuple[tuple[int, int], ...]
    reach: tuple[int, int]


def disc_of(radius_m: float, cell_m: tuple[float, float]) -> Disc:
    """The cells whose centres lie within a radius."""
    # The slack keeps the same cells whatever the rounding of the sizes.
    reach = (int(radius_m / cell_m[0] + 1e-3), int(radius_m / cell_m[1] + 1e-3))
    i, j = np.mgrid[-reach[0] : reach[0] + 1, -reach[1] : reach[1] + 1]
    inside = np.hypot(i * cell_m[0], j * cell_m[1]) <= radius_m * (1 + 1e-3)
    return Disc(tuple(zip(i[inside].tolist(), j[inside].tolist(), strict=True)), reach)


def hazard_reach(cell_m: tuple[float, float], radius_m: float, gap_m: float) -> int:
    """Columns to every side on whose heights the hazards of a cell depend."""
    # To a cell of its disc, from there over a jump, to the middle of a disc that ends there, and to that disc's edge.
    return max(
        3 * reach + _gap(gap_m, size) for reach, size in zip(disc_of(radius_m, cell_m).reach, cell_m, strict=True)
    )


@partial(jax.jit, static_argnames=("cell_m", "radius_m", "gap_m", "least_share"))
def measure_hazards(
    heights: Heights, cell_m: tuple[float, float], radius_m: float, gap_m: float, least_share: float = 0.5
) -> Hazards:
    """Measures the hazards of the discs around all cells.

    A plane of least squares through the known cells of the disc gives slope and roughness. A jump is the difference of
    two heights `gap_m` apart, less what the slope of the ground on one side of both explains. So on any plane steps are
    0, where two planes meet as well, and at the edge of a step of h they are h.

    Sigmas assume errors of height that are independent between cells.

    Args:
        heights: of the ground.
        cell_m: size of a cell along x and y, static.
        radius_m: of the disc, static.
        gap_m: distance over which a jump is taken, about the radius of a wheel, static.
        least_share: of the disc's cells that must be known, static.
    """
    known = jnp.asarray(heights.known) & jnp.isfinite(heights.height_m) & jnp.isfinite(heights.sigma_m)
    z, variance = jnp.where(known, heights.height_m, 0.0), jnp.where(known, heights.sigma_m, 0.0) ** 2
    disc = disc_of(radius_m, cell_m)
    plane = _fit_planes(z, variance, known, disc, cell_m, radius_m)
    enough = plane.cells >= max(least_share * len(disc.cells), _LEAST_CELLS)
    enough &= plane.determinant > (_FLATTEST * radius_m**2 * plane.cells) ** 2

    jumps = _jumps(z, variance, known, plane, enough, disc, cell_m, gap_m)
    square, jump, jump_variance = _over_disc(z, known, plane, disc, cell_m, jumps)
    freedom = jnp.maximum(plane.cells - 3, 1.0)
    roughness_m = _root(square / plane.cells.clip(1))
    tangent = _root(plane.slope_x**2 + plane.slope_y**2)
    # Of a plane through cells of equal variance; the disc is near to round, so it is that of any direction.
    spread = jnp.sqrt(plane.determinant.clip(1e-12))
    slope_sigma = jnp.sqrt(plane.variance / spread) / (1 + tangent**2)
    values = (
        jump,
        jnp.degrees(jnp.arctan(tangent)),
        roughness_m,
        jnp.sqrt(jump_variance),
        jnp.degrees(slope_sigma),
        jnp.sqrt(plane.variance / (2 * freedom)),
    )
    return Hazards(*(jnp.where(enough, value, jnp.nan) for value in values))


def grown(values: Float[Array, "X Y"], disc: Disc, outside: float) -> Float[Array, "X Y"]:
    """The greatest value of the disc around each cell; beyond the edge of the map all are `outside`."""
    padded = _padded(values, disc.reach, outside)

    def take(best: Array, offset: Array) -> tuple[Array, None]:
        return jnp.maximum(best, _shifted(padded, offset, disc.reach, values.shape)), None

    return jax.lax.scan(take, values, jnp.array(disc.cells))[0]


def shares(values: Float[Array, "X Y"], disc: Disc) -> Float[Array, "X Y"]:
    """The mean over the disc around each cell; beyond the edge of the map all are 0."""
    padded = _padded(values, disc.reach, 0.0)

    def add(total: Array, offset: Array) -> tuple[Array, None]:
        return total + _shifted(padded, offset, disc.reach, values.shape), None

    return jax.lax.scan(add, jnp.zeros_like(values), jnp.array(disc.cells))[0] / len(disc.cells)


class _Planes(NamedTuple):
    """Planes through the known cells of the discs.

    `height_m` is that over the centre of the disc, `cells` how many are known, `determinant` that of the second moments
    of their places (metres to the fourth, times the count squared), `variance` the mean of theirs.
    """

    height_m: Array
    slope_x: Array
    slope_y: Array
    cells: Array
    determinant: Array
    variance: Array


def _fit_planes(
    z: Array, variance: Array, known: Array, disc: Disc, cell_m: tuple[float, float], radius_m: float
) -> _Planes:
    weight = known.astype(z.dtype)
    total = shares(z * weight, disc) / jnp.maximum(shares(weight, disc), 1e-6)
    # Heights are taken from the mean of their disc: sums of squares of great heights would lose the small ones.
    pads = [_padded(values, disc.reach, 0.0) for values in (weight, z, variance)]

    def add(sums: tuple[Array, ...], offset: Array) -> tuple[tuple[Array, ...], None]:
        w, height, noise = (_shifted(pad, offset, disc.reach, z.shape) for pad in pads)
        x, y = offset[0] * cell_m[0], offset[1] * cell_m[1]
        dz = w * (height - total)
        more = (w, w * x, w * y, w * x * x, w * x * y, w * y * y, dz, dz * x, dz * y, w * noise)
        return tuple(old + new for old, new in zip(sums, more, strict=True)), None

    start = tuple(jnp.zeros_like(z) for _ in range(10))
    n, x, y, xx, xy, yy, s, sx, sy, noise = jax.lax.scan(add, start, jnp.array(disc.cells))[0]
    count = jnp.maximum(n, 1.0)
    xx, xy, yy = xx - x * x / count, xy - x * y / count, yy - y * y / count
    sx, sy = sx - x * s / count, sy - y * s / count
    determinant = xx * yy - xy * xy
    safe = jnp.maximum(determinant, (_FLATTEST * radius_m**2) ** 2)
    slope_x, slope_y = (yy * sx - xy * sy) / safe, (xx * sy - xy * sx) / safe
    height = total + (s - slope_x * x - slope_y * y) / count
    return _Planes(height, slope_x, slope_y, n, determinant, noise / count)


def _gap(gap_m: float, size_m: float) -> int:
    return max(1, round(gap_m / size_m))


class _Cells(NamedTuple):
    """What a jump is made of: heights and their variances, and the slopes of planes where they are fitted."""

    z: Array
    variance: Array
    known: Array
    slope_x: Array
    slope_y: Array
    fitted: Array


def _jumps(
    z: Array,
    variance: Array,
    known: Array,
    plane: _Planes,
    fitted: Array,
    disc: Disc,
    cell_m: tuple[float, float],
    gap_m: float,
) -> tuple[Array, Array]:
    """The greatest jump from each cell to one a gap away, less its sigma, and its variance; -1 where there is none."""
    gap = np.array([_gap(gap_m, size) for size in cell_m])
    reach = tuple((gap + disc.reach).tolist())
    fields = _Cells(z, variance, known, plane.slope_x, plane.slope_y, fitted)
    pads = _Cells(*(_padded(field, reach, 0) for field in fields))
    ways = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)])
    # Discs that end at the two cells: whatever jumps between these makes neither lean.
    aside = np.rint(ways / np.linalg.norm(ways, axis=1, keepdims=True) * disc.reach).astype(int)

    def at(offset: Array) -> _Cells:
        return _Cells(*(_shifted(pad, offset, reach, z.shape) for pad in pads))

    def take(found: tuple[Array, Array], way: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
        (best, noise), (ahead, aside) = found, way
        end, beyond, behind = at(ahead), at(ahead + aside), at(-aside)
        x, y = ahead[0] * cell_m[0], ahead[1] * cell_m[1]

        def left(ground: _Cells) -> Array:
            return jnp.where(ground.fitted, jnp.abs(end.z - z - x * ground.slope_x - y * ground.slope_y), jnp.inf)

        jump = jnp.minimum(left(beyond), left(behind))
        jump = jnp.where(jump < jnp.inf, jump, left(fields))
        both = variance + end.variance
        jump = jnp.where(known & end.known & (jump < jnp.inf), jump - _root(both), -1.0)
        return (jnp.maximum(best, jump), jnp.where(jump > best, both, noise)), None

    start = (jnp.full_like(z, -1.0), jnp.zeros_like(z))
    return jax.lax.scan(take, start, (jnp.array(ways * gap), jnp.array(aside)))[0]


def _over_disc(
    z: Array, known: Array, plane: _Planes, disc: Disc, cell_m: tuple[float, float], jumps: tuple[Array, Array]
) -> tuple[Array, Array, Array]:
    """Over the disc: the sum of squares of distances from its plane, and the greatest jump with its variance."""
    fills = ((known, False), (z, 0.0), (jumps[0], -1.0), (jumps[1], 0.0))
    pads = [_padded(values, disc.reach, empty) for values, empty in fills]
    # Distances are upright to the plane.
    upright = 1 / (1 + plane.slope_x**2 + plane.slope_y**2)

    def add(sums: tuple[Array, Array, Array], offset: Array) -> tuple[tuple[Array, Array, Array], None]:
        square, best, noise = sums
        there, height, jump, more = (_shifted(pad, offset, disc.reach, z.shape) for pad in pads)
        x, y = offset[0] * cell_m[0], offset[1] * cell_m[1]
        off = height - plane.height_m - x * plane.slope_x - y * plane.slope_y
        square = square + jnp.where(there, off * off * upright, 0.0)
        return (square, jnp.maximum(best, jump), jnp.where(jump > best, more, noise)), None

    zero = jnp.zeros_like(z)
    return jax.lax.scan(add, (zero, zero, zero), jnp.array(disc.cells))[0]


def _root(square: Array) -> Array:
    """Square root, with a gradient of 0 at 0."""
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def _padded(values: Array, reach: tuple[int, int], outside: float) -> Array:
    return jnp.pad(values, [(reach[0], reach[0]), (reach[1], reach[1])], constant_values=outside)


def _shifted(padded: Array, offset: Array, reach: tuple[int, int], shape: tuple[int, ...]) -> Array:
    """The values so many cells further on."""
    return jax.lax.dynamic_slice(padded, (reach[0] + offset[0], reach[1] + offset[1]), shape)
