"""The local ground of a frame: the height field of cells that its surface rises above.

The cells lie around the camera in its level frame: x forward, y left, z up, metres, origin at the camera. A robust
plane through all of them comes first. Then follows the opening of what rises above it (Serra 1982, "Image Analysis and
Mathematical Morphology"), which nothing narrower than `rock_m` survives. Last come locally weighted planes (Cleveland
1979, "Robust Locally Weighted Regression and Smoothing Scatterplots") through the cells near that surface: as many lie
above it as below, so that noise does not bend the ground, which is how it bends an opening.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxmap.geometry.options import GroundOptions

_MOST_CELLS_AHEAD = 160
_PLANE_SCALES_M = (2.0, 1.0, 0.5, 0.3, 0.2, 0.15, 0.15)
"""How far cells may lie from the plane, round by round."""
_FEWEST_CELLS = 30
_STEEPEST = 1.2
"""Tangent of the slope beyond which a plane is a wall."""
_REFITS = 3
_RIDGE_M = 0.1
"""Keeps the slopes of local planes small where their cells lie in a row."""
_LEAST_MASS = 1e-6
_FAR = 1e6
"""Above all heights; its negative is below them."""


class LevelPoints(NamedTuple):
    """Points in the level frame, of any shape, and the standard deviation of their height."""

    x_m: Float[Array, "*s"]
    y_m: Float[Array, "*s"]
    z_m: Float[Array, "*s"]
    sigma_m: Float[Array, "*s"]


class Incline(NamedTuple):
    """Planes that are no walls: the height over a place of their own, and the slopes along x and y."""

    height_m: Float[Array, "*s"]
    slope_x: Float[Array, "*s"]
    slope_y: Float[Array, "*s"]

    def at(self, x_m: Float[Array, "*t"], y_m: Float[Array, "*t"]) -> Float[Array, "*t"]:
        """Heights so far from that place."""
        return self.height_m + self.slope_x * x_m + self.slope_y * y_m


class Lattice(NamedTuple):
    """The cells: rows of them ahead of the camera, columns to both sides; in lists, row by row."""

    edge_m: float
    rows: int
    columns: int

    @classmethod
    def of(cls, options: GroundOptions) -> Lattice:
        """A lattice that reaches as far as the options say, and three quarters as far to either side."""
        edge_m = max(options.cell_m, options.range_m / _MOST_CELLS_AHEAD)
        rows = round(options.range_m / edge_m)
        return cls(edge_m, rows, 2 * round(0.75 * rows))

    @property
    def size(self) -> int:
        """How many cells there are."""
        return self.rows * self.columns

    def cell_of(self, points: LevelPoints, valid: Bool[Array, "*s"]) -> tuple[Int[Array, "*s"], Bool[Array, "*s"]]:
        """The cell that each point lies in, `size` for those in none, and whether it lies in one."""
        row, column = jnp.floor(points.x_m / self.edge_m), jnp.floor(points.y_m / self.edge_m) + self.columns // 2
        inside = valid & (row >= 0) & (row < self.rows) & (column >= 0) & (column < self.columns)
        flat = jnp.where(inside, row * self.columns + column, 0.0).astype(jnp.int32)
        return jnp.where(inside, flat, self.size), inside

    def centres(self, index: Int[Array, "*s"]) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
        """The middle of cells: x and y."""
        row, column = index // self.columns, index % self.columns - self.columns // 2
        return (row + 0.5) * self.edge_m, (column + 0.5) * self.edge_m

    def field(self, values: Shaped[Array, "N"]) -> Shaped[Array, "X Y"]:
        """A list of cells as an image of them."""
        return values.reshape(self.rows, self.columns)


class Cells(NamedTuple):
    """What was seen of each cell.

    Attributes:
        mean: of its points; the middle of the cell, at height 0, where none was seen.
        seen: which cells hold enough points.
        centre_x_m, centre_y_m: the middle of each cell.
    """

    mean: LevelPoints
    seen: Bool[Array, "X Y"]
    centre_x_m: Float[Array, "X Y"]
    centre_y_m: Float[Array, "X Y"]

    @property
    def weight(self) -> Float[Array, "X Y"]:
        """1 for cells that were seen, else 0."""
        return self.seen.astype(self.mean.z_m.dtype)


class Ground(NamedTuple):
    """The ground by cells.

    Attributes:
        surface: around the middle of each cell.
        roughness_m: root mean square of the distances, of half a metre at most, of the cells around from the ground.
        step_m: greatest difference of height, above the plane of the ground, between the cells around.
        seen: cells that hold points; over others the ground is a guess.
    """

    surface: Incline
    roughness_m: Float[Array, "X Y"]
    step_m: Float[Array, "X Y"]
    seen: Bool[Array, "X Y"]

    def of_points(self, index: Int[Array, "*s"]) -> Ground:
        """The ground under points, from the index of their cells; means nothing for points in no cell."""
        return jax.tree.map(lambda field: jnp.take(field.reshape(-1), index, mode="clip"), self)


def mean_cells(
    lattice: Lattice,
    points: LevelPoints,
    index: Int[Array, "*s"],
    inside: Bool[Array, "*s"],
    focal_px: Float[Array, ""],
) -> Cells:
    """Gathers points into cells.

    Args:
        lattice: of the cells.
        points: any number of them.
        index: the cell of each.
        inside: which points count.
        focal_px: of the camera whose pixels the points are.
    """

    def total(values: Array) -> Array:
        values = jnp.where(inside, values, 0.0).reshape(-1)
        return lattice.field(jnp.zeros(lattice.size, values.dtype).at[index.reshape(-1)].add(values, mode="drop"))

    points_in = total(jnp.ones_like(points.z_m))
    x, y, z, sigma_m = (total(values) / jnp.maximum(points_in, 1.0) for values in points)
    # False matches scatter: a true surface fills a tenth at least of the pixels that a cell across the view would.
    facing_px = (focal_px * lattice.edge_m) ** 2 / jnp.maximum(x * x + y * y + z * z, 0.01)
    seen = points_in > 0.1 * facing_px.clip(0, 100)
    centre_x, centre_y = lattice.centres(lattice.field(jnp.arange(lattice.size)))
    x, y, z = (jnp.where(seen, *pair) for pair in ((x, centre_x), (y, centre_y), (z, 0.0)))
    return Cells(LevelPoints(x, y, z, sigma_m), seen, centre_x, centre_y)


def fit_plane(cells: Cells) -> tuple[Incline, Bool[Array, ""]]:
    """The plane through most of the ground, and whether there is one below the camera.

    Least squares, reweighted by Cauchy weights (Holland and Welsch 1977) of ever narrower scale. What lies high counts
    less than what lies low: rocks stand on the ground.
    """
    x, y, z, sigma_m = cells.mean
    weight = cells.weight
    plane = _plane_through(weight, x, y, z)
    for scale_m in _PLANE_SCALES_M:
        above_m = z - plane.at(x, y)
        scale_m = jnp.where(above_m > 0, scale_m, 2 * scale_m) + 2 * sigma_m
        plane = _plane_through(weight / (1 + (above_m / scale_m) ** 2), x, y, z)
    gentle = jnp.hypot(plane.slope_x, plane.slope_y) < _STEEPEST
    return plane, (weight.sum() >= _FEWEST_CELLS) & (plane.height_m < 0) & gentle


def fit_ground(lattice: Lattice, cells: Cells, plane: Incline, options: GroundOptions) -> Ground:
    """The ground of all cells.

    Args:
        lattice: of the cells.
        cells: what was seen of them.
        plane: through most of the ground.
        options: the width of rocks, and the neighbourhood that the ground is fitted to.
    """
    x, y, z, sigma_m = cells.mean
    above_m = jnp.where(cells.seen, z - plane.at(x, y), 0.0)
    dx, dy, weight = x - cells.centre_x_m, y - cells.centre_y_m, cells.weight
    near = _Blur.of(lattice, 0.8 * lattice.edge_m)
    mass, total_m = near(weight, weight * above_m)
    smooth_m, present = total_m / jnp.maximum(mass, _LEAST_MASS), mass > 0.05

    reach = max(1, round(options.rock_m / lattice.edge_m / 2))
    level_m = _opened(jax.lax.stop_gradient(smooth_m), present, reach)
    surface = Incline(level_m, jnp.zeros_like(level_m), jnp.zeros_like(level_m))
    wide = _Blur.of(lattice, options.smooth_m)
    scale_m = 3 * (options.tolerance_m + 2 * sigma_m)
    for _ in range(_REFITS):
        off_m = above_m - surface.at(dx, dy)
        # Tukey's biweight, as Cleveland takes it.
        biweight = jnp.maximum(1 - (off_m / scale_m) ** 2, 0.0) ** 2
        surface = _local_planes(wide, weight * biweight, cells, above_m)

    off_m = above_m - surface.at(dx, dy)
    mass, total_m2 = _Blur.of(lattice, 2.5 * lattice.edge_m)(weight, weight * jnp.minimum(off_m**2, 0.25))
    roughness_m = safe_sqrt(total_m2 / jnp.maximum(mass, _LEAST_MASS))
    lowest_m, highest_m = _least(jnp.where(present, smooth_m, _FAR), 2), -_least(jnp.where(present, -smooth_m, _FAR), 2)
    step_m = jnp.where(highest_m > lowest_m, highest_m - lowest_m, 0.0)
    height_m = surface.height_m + plane.at(cells.centre_x_m, cells.centre_y_m)
    tilted = Incline(height_m, surface.slope_x + plane.slope_x, surface.slope_y + plane.slope_y)
    return Ground(tilted, roughness_m, step_m, cells.seen)


def safe_sqrt(values: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Square root whose gradient is finite at 0."""
    return jnp.sqrt(jnp.maximum(values, 1e-12))


def _plane_through(weight: Array, x: Array, y: Array, z: Array) -> Incline:
    """The plane of least squares through weighted points, with its height at the origin."""

    def mean(values: Array) -> Array:
        return jnp.vdot(weight, values, precision="highest") / jnp.maximum(weight.sum(), _LEAST_MASS)

    mean_x, mean_y, mean_z = mean(x), mean(y), mean(z)
    dx, dy, dz = x - mean_x, y - mean_y, z - mean_z
    slope_x, slope_y = _slopes(mean(dx * dx), mean(dx * dy), mean(dy * dy), mean(dx * dz), mean(dy * dz), 1e-6)
    return Incline(mean_z - slope_x * mean_x - slope_y * mean_y, slope_x, slope_y)


def _local_planes(blur: _Blur, weight: Array, cells: Cells, z: Array) -> Incline:
    """The planes of least squares through the weighted surroundings of each cell; 0 far from all weight."""
    x, y = cells.mean.x_m, cells.mean.y_m
    moments = (jnp.ones_like(x), x, y, z, x * x, x * y, y * y, x * z, y * z)
    mass, *sums = blur(*(weight * moment for moment in moments))
    share = jax.lax.optimization_barrier(1.0 / jnp.maximum(mass, _LEAST_MASS))
    mean_x, mean_y, mean_z, xx, xy, yy, xz, yz = (total * share for total in sums)
    slope_x, slope_y = _slopes(
        xx - mean_x**2 + _RIDGE_M**2,
        xy - mean_x * mean_y,
        yy - mean_y**2 + _RIDGE_M**2,
        xz - mean_x * mean_z,
        yz - mean_y * mean_z,
        _RIDGE_M**4,
    )
    height_m = mean_z + slope_x * (cells.centre_x_m - mean_x) + slope_y * (cells.centre_y_m - mean_y)
    trust = mass / (mass + 1e-3)
    return Incline(trust * height_m, trust * slope_x, trust * slope_y)


def _slopes(xx: Array, xy: Array, yy: Array, xz: Array, yz: Array, least: float) -> tuple[Array, Array]:
    """Slopes by least squares from central moments, whose determinant is `least` at least."""
    determinant = jnp.maximum(xx * yy - xy * xy, least)
    return (yy * xz - xy * yz) / determinant, (xx * yz - xy * xz) / determinant


class _Blur(NamedTuple):
    """Gaussian sums over cells, by one product along each axis: faster than a convolution, however wide they are."""

    along_rows: Float[Array, "X X"]
    along_columns: Float[Array, "Y Y"]

    @classmethod
    def of(cls, lattice: Lattice, sigma_m: float) -> _Blur:
        def weights(count: int) -> Array:
            apart_m = np.subtract.outer(np.arange(count), np.arange(count)) * lattice.edge_m
            return jnp.asarray(np.exp(-0.5 * (apart_m / sigma_m) ** 2), jnp.float32)

        return cls(weights(lattice.rows), weights(lattice.columns))

    def __call__(self, *fields: Float[Array, "X Y"]) -> list[Float[Array, "X Y"]]:
        # Side by side within rows: so both products are plain ones, of large matrices. A GPU would round the factors,
        # and the differences of these sums need all digits.
        along = jnp.tensordot(self.along_rows, jnp.stack(fields, axis=1), 1, precision="highest")
        both = jnp.dot(along, self.along_columns, precision="highest")
        return [both[:, number] for number in range(len(fields))]


def _opened(heights_m: Array, present: Array, reach: int) -> Array:
    """The opening of heights by a square: the greatest around of the least around; 0 far from all that is present."""
    least_m = _least(jnp.where(present, heights_m, _FAR), reach)
    opened_m = -_least(jnp.where(least_m < _FAR / 2, -least_m, _FAR), reach)
    return jnp.where(opened_m > -_FAR / 2, opened_m, 0.0)


def _least(field: Array, reach: int) -> Array:
    """The least value of the square of cells around each."""
    least: Any = jax.lax.min
    for size in ((2 * reach + 1, 1), (1, 2 * reach + 1)):
        # From infinity: from any other number it has no gradient.
        field = jax.lax.reduce_window(field, jnp.inf, least, size, (1, 1), "SAME")
    return field
