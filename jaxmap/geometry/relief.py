"""Relief: how the surface in view rises above the local ground, from the disparity of one frame and the direction up.

The ground is a height field of cells around the camera, in the level frame (x forward, y left, z up, origin at the camera):
a robust plane through all cells first, then the opening of what rises above it (Serra 1982), which no rock narrower than
`rock_m` survives, and last, weighted linear fits (Cleveland 1979) to the cells near that surface, which are as often too
high as too low, so that noise does not bend the ground. Turning about the vertical and moving change nothing, because
the cells turn and move with the camera.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from annotated_types import Interval
from jaxtyping import Array, Bool, Float

from jaxmap.geometry.camera import depth_sigma, disparity_to_points
from jaxmap.host.settings import Positive, options
from jaxmap.types import StereoCamera

RELIEF_STRIDE = 4
"""Pixels of the disparity image along each edge of a pixel of relief."""

RELIEF_CHANNELS = 6

_HIGHEST = 1e6
_PLANE_SCALES_M = (2.0, 1.0, 0.5, 0.3, 0.2, 0.15, 0.15)
_REFIT_ROUNDS = 3
_RIDGE_M = 0.1
_MAX_GROUND_SLOPE = 1.2


@options("relief")
class GroundOptions:
    """The local ground that relief is measured from."""

    range_m: Annotated[float, Positive] = 12.8
    """How far ahead the ground is known."""
    cell_m: Annotated[float, Positive] = 0.1
    """Edge of a cell of the ground; at long ranges it grows, so that no more than 160 cells lie ahead."""
    rock_m: Annotated[float, Interval(gt=0, le=20)] = 1.5
    """What rises on less than this width is no ground."""
    smooth_m: Annotated[float, Positive] = 0.6
    """Standard deviation of the neighbourhood that the ground is fitted to."""
    tolerance_m: Annotated[float, Positive] = 0.06
    """How far cells of the ground lie from it, beside their noise."""


class Relief(NamedTuple):
    """Relief of a frame, as images (h, w) whose pixels are `RELIEF_STRIDE` pixels of the disparity wide.

    Attributes:
        height_m: of the surface above the local ground.
        sigma_m: standard deviation of that height, from the noise of one pixel's disparity.
        slope: tangent of the surface's angle to the horizontal.
        roughness_m: root mean square of what the cells around differ from the ground.
        step_m: greatest difference of height between the cells around.
        depth_m: of the surface along the optical axis.
        known: where all this is known; elsewhere it is 0.
        found: whether there is ground below the camera at all.
    """

    height_m: Float[Array, "h w"]
    sigma_m: Float[Array, "h w"]
    slope: Float[Array, "h w"]
    roughness_m: Float[Array, "h w"]
    step_m: Float[Array, "h w"]
    depth_m: Float[Array, "h w"]
    known: Bool[Array, "h w"]
    found: Bool[Array, ""]


class _Ground(NamedTuple):
    """The ground by cells (X, Y): height and slopes along x and y, of the level frame, and what surrounds each."""

    height_m: Array
    slope_x: Array
    slope_y: Array
    roughness_m: Array
    step_m: Array
    supported: Array
    found: Array


def relief_of(
    camera: StereoCamera,
    up_camera: Float[Array, "3"],
    disparity_px: Float[Array, "H W"],
    disparity_sigma_px: Float[Array, ""] | float = 0.5,
    options: GroundOptions | None = None,
) -> Relief:
    """Measures the relief of a frame.

    Args:
        camera: the rectified camera.
        up_camera: unit vector away from the ground, in the camera frame.
        disparity_px: NaN where unknown.
        disparity_sigma_px: standard deviation of disparity.
        options: by default those of `GroundOptions`.
    """
    options = options or GroundOptions()
    with jax.named_scope("relief"):
        blocks_px, valid = block_means(disparity_px, RELIEF_STRIDE)
        coarse = _coarse_camera(camera)
        points_camera, positive = disparity_to_points(coarse, jnp.where(valid, blocks_px, jnp.nan) / RELIEF_STRIDE)
        R = level_rotation(up_camera)
        depth_m = points_camera[..., 2]
        x, y, z = (sum(R[i, k] * points_camera[..., k] for k in range(3)) for i in range(3))
        sigma_depth_m = depth_sigma(camera, depth_m, disparity_sigma_px)
        cells = _Cells.of(options)
        index, inside = cells.index(x, y, valid & positive)
        focal_px = jnp.sqrt(coarse.fx_px * coarse.fy_px)
        sigma_height_m = jnp.abs(z) * sigma_depth_m / depth_m
        plane, found = _ground_plane(_mean_points(cells, index, (x, y, z), sigma_height_m, inside, focal_px))
        above_m = z - (plane[0] + plane[1] * x + plane[2] * y)
        inside &= ~_floating(above_m, depth_m, sigma_depth_m, inside)
        cell = _mean_points(cells, index, (x, y, z), sigma_height_m, inside, focal_px)
        ground = _fit_ground(cells, cell, plane, found, options)
        at = [jnp.take(field.reshape(-1), index, mode="clip") for field in ground[:6]]
        level_m, slope_x, slope_y, roughness_m, step_m, supported = at
        centre_x, centre_y = cells.centres(index)
        height_m = z - (level_m + slope_x * (x - centre_x) + slope_y * (y - centre_y))
        # What a metre of depth adds to the height: the ray rises, and so does the ground below it.
        rise = jnp.abs(z - slope_x * x - slope_y * y) / depth_m
        known = inside & (supported > 0) & ground.found
        values = (height_m, rise * sigma_depth_m, _surface_slope(coarse, R[2], blocks_px, valid), roughness_m, step_m, depth_m)
        return Relief(*(jnp.where(known, value, 0.0) for value in values), known, ground.found)


def relief_channels(relief: Relief) -> Float[Array, "h w 6"]:
    """Relief as the input of a network: bounded numbers, 0 where unknown, the last channel 1 where known."""
    known = relief.known.astype(relief.height_m.dtype)
    sigma_m = jnp.maximum(relief.sigma_m, 1e-3)
    channels = (
        jnp.arcsinh(relief.height_m.clip(-3, 3) / 0.05) / 2,
        jnp.tanh(relief.height_m / (3 * sigma_m)),
        jnp.arctan(relief.slope),
        jnp.log1p(relief.step_m.clip(0, 3) / 0.05) / 2,
        jnp.log1p(sigma_m.clip(0, 3) / 0.02) / 2,
        jnp.ones_like(known),
    )
    return jnp.stack([channel * known for channel in channels], axis=-1)


def level_rotation(up_camera: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """R_level_camera: the level frame looks along the optical axis, or up the image where that points straight down."""
    up = up_camera / jnp.linalg.norm(up_camera)
    steep = jnp.abs(up[2]) > 0.999
    ahead = jnp.where(steep, jnp.array([0.0, -1.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    ahead = ahead - (ahead @ up) * up
    forward = ahead / jnp.linalg.norm(ahead)
    return jnp.stack([forward, jnp.cross(up, forward), up])


def block_means(disparity_px: Float[Array, "H W"], size: int) -> tuple[Float[Array, "h w"], Bool[Array, "h w"]]:
    """Mean disparity of square blocks, and which have one: where half of their pixels are known."""
    missing = [-edge % size for edge in disparity_px.shape]
    padded = jnp.pad(disparity_px, [(0, count) for count in missing], constant_values=jnp.nan)
    h, w = (edge // size for edge in padded.shape)
    finite = jnp.isfinite(padded)
    clean = jnp.where(finite, padded, 0.0)
    # Rows add up as vectors; pairs of neighbours within a row as a product.
    gather = jnp.asarray(np.repeat(np.eye(w, dtype=np.float32), size, axis=0))

    def sums(values: Array) -> Array:
        rows = values.reshape(h, size, w * size).sum(axis=1)
        return jnp.dot(rows, gather, precision="highest")

    count = sums(finite.astype(clean.dtype))
    mean = sums(clean) / jnp.maximum(count, 1.0)
    return mean, count >= size * size / 2


def _coarse_camera(camera: StereoCamera) -> StereoCamera:
    """The camera of the blocks: pixels are larger, and so are disparities in them smaller."""
    from dataclasses import replace

    shift = (RELIEF_STRIDE - 1) / 2
    return replace(
        camera,
        fx_px=camera.fx_px / RELIEF_STRIDE,
        fy_px=camera.fy_px / RELIEF_STRIDE,
        cx_px=(camera.cx_px - shift) / RELIEF_STRIDE,
        cy_px=(camera.cy_px - shift) / RELIEF_STRIDE,
        doffs_px=camera.doffs_px / RELIEF_STRIDE,
    )


class _Cells(NamedTuple):
    """The lattice of the ground: cells ahead of the camera and to both sides."""

    edge_m: float
    ahead: int
    across: int

    @classmethod
    def of(cls, options: GroundOptions) -> _Cells:
        edge_m = max(options.cell_m, options.range_m / 160)
        ahead = round(options.range_m / edge_m)
        return cls(edge_m, ahead, 2 * round(0.75 * ahead))

    def index(self, x: Array, y: Array, valid: Array) -> tuple[Array, Array]:
        """The cell of each point, and whether it has one; others get the cell beyond the last."""
        row, column = jnp.floor(x / self.edge_m), jnp.floor(y / self.edge_m) + self.across // 2
        inside = valid & (row >= 0) & (row < self.ahead) & (column >= 0) & (column < self.across)
        flat = jnp.where(inside, row * self.across + column, 0.0).astype(jnp.int32)
        return jnp.where(inside, flat, self.ahead * self.across), inside

    def centres(self, index: Array) -> tuple[Array, Array]:
        """x and y of cells, metres in the level frame."""
        return ((index // self.across) + 0.5) * self.edge_m, (index % self.across + 0.5 - self.across // 2) * self.edge_m


class _Cell(NamedTuple):
    """Means of the points in each cell (X, Y), in the level frame; where none was seen, the cell's centre at height 0."""

    x: Array
    y: Array
    z: Array
    sigma_m: Array
    seen: Array


def _mean_points(
    cells: _Cells, index: Array, points: tuple[Array, Array, Array], sigma_m: Array, inside: Array, focal_px: Array
) -> _Cell:
    shape = (cells.ahead, cells.across)

    def summed(values: Array) -> Array:
        total = jnp.zeros(cells.ahead * cells.across, values.dtype)
        return total.at[index.reshape(-1)].add(jnp.where(inside, values, 0.0).reshape(-1), mode="drop").reshape(shape)

    count = summed(jnp.ones_like(sigma_m))
    x, y, z, sigma_m = (summed(values) / jnp.maximum(count, 1.0) for values in (*points, sigma_m))
    # False matches scatter: what is there shows a tenth of the pixels that a cell across the view would fill.
    facing = (focal_px * cells.edge_m) ** 2 / jnp.maximum(x * x + y * y + z * z, 0.01)
    seen = count > 0.1 * facing.clip(0, 100)
    centre_x, centre_y = (grid.reshape(shape) for grid in cells.centres(jnp.arange(cells.ahead * cells.across)))
    return _Cell(*(jnp.where(seen, *pair) for pair in ((x, centre_x), (y, centre_y), (z, 0.0))), sigma_m, seen)


def _ground_plane(cell: _Cell) -> tuple[Array, Array]:
    """Height at the origin and slopes of the plane through most of the ground, in ever narrower bounds; whether it is one."""
    plane, weight = jnp.zeros(3), cell.seen.astype(cell.z.dtype)
    robust = weight
    for scale_m in _PLANE_SCALES_M:
        plane = _weighted_plane(robust, cell.x, cell.y, cell.z)
        residual_m = cell.z - (plane[0] + plane[1] * cell.x + plane[2] * cell.y)
        # What lies high counts less than what lies low: rocks stand on the ground.
        scale = jnp.where(residual_m > 0, scale_m, 2 * scale_m) + 2 * cell.sigma_m
        robust = weight / (1 + (residual_m / scale) ** 2)
    plane = _weighted_plane(robust, cell.x, cell.y, cell.z)
    found = (weight.sum() >= 30) & (plane[0] < 0) & (jnp.hypot(plane[1], plane[2]) < _MAX_GROUND_SLOPE)
    return plane, found


def _floating(above_m: Array, depth_m: Array, sigma_m: Array, known: Array) -> Array:
    """Points high above the plane of the ground below which ground is seen, farther away: false matches in the sky.

    Down a column of the image, what stands on the ground is followed by ground that is nearer.
    """
    ground_m = jnp.where(known & (jnp.abs(above_m) < 0.3), depth_m, 0.0)
    below_m = jax.lax.cummax(ground_m, axis=0, reverse=True)
    return (above_m > 0.5) & (depth_m + 1.0 + 3 * sigma_m < below_m)


def _fit_ground(cells: _Cells, cell: _Cell, plane: Array, found: Array, options: GroundOptions) -> _Ground:
    x, y, sigma, shape = cell.x, cell.y, cell.sigma_m, cell.z.shape
    weight = cell.seen.astype(cell.z.dtype)
    centre_x, centre_y = (grid.reshape(shape) for grid in cells.centres(jnp.arange(cells.ahead * cells.across)))
    rest_m = jnp.where(cell.seen, cell.z - (plane[0] + plane[1] * x + plane[2] * y), 0.0)
    near = _Blur.of(cells, 0.8 * cells.edge_m)
    mass = near(weight)
    smooth_m = near(weight * rest_m) / jnp.maximum(mass, 1e-6)
    reach = max(1, round(options.rock_m / cells.edge_m / 2))
    present = mass > 0.05
    low_m = _extreme(jnp.where(present, smooth_m, _HIGHEST), reach, jax.lax.min, _HIGHEST)
    opened_m = _extreme(jnp.where(low_m < _HIGHEST / 2, low_m, -_HIGHEST), reach, jax.lax.max, -_HIGHEST)
    level_m = jax.lax.stop_gradient(jnp.where(opened_m > -_HIGHEST / 2, opened_m, 0.0))

    wide = _Blur.of(cells, options.smooth_m)
    slope_x = slope_y = jnp.zeros(shape)
    for _ in range(_REFIT_ROUNDS):
        off_m = rest_m - (level_m + slope_x * (x - centre_x) + slope_y * (y - centre_y))
        scale = options.tolerance_m + 2 * sigma
        near_ground = weight * jnp.maximum(1 - (off_m / (3 * scale)) ** 2, 0.0) ** 2
        level_m, slope_x, slope_y = _local_lines(wide, near_ground, x, y, rest_m, centre_x, centre_y)
    off_m = rest_m - (level_m + slope_x * (x - centre_x) + slope_y * (y - centre_y))
    around = _Blur.of(cells, 2.5 * cells.edge_m)
    roughness_m = _safe_sqrt(around(weight * jnp.minimum(off_m**2, 0.25)) / jnp.maximum(around(weight), 1e-6))
    top = _extreme(jnp.where(present, smooth_m, -_HIGHEST), 2, jax.lax.max, -_HIGHEST)
    bottom = _extreme(jnp.where(present, smooth_m, _HIGHEST), 2, jax.lax.min, _HIGHEST)
    step_m = jnp.where(top > bottom, top - bottom, 0.0)
    height_m = level_m + plane[0] + plane[1] * centre_x + plane[2] * centre_y
    return _Ground(height_m, slope_x + plane[1], slope_y + plane[2], roughness_m, step_m, weight, found)


def _weighted_plane(weight: Array, x: Array, y: Array, z: Array) -> Array:
    """Height at the origin and slopes of the plane through weighted points, by least squares."""
    total = jnp.maximum(weight.sum(), 1e-6)
    mean_x, mean_y, mean_z = (jnp.vdot(weight, v) / total for v in (x, y, z))
    dx, dy, dz = x - mean_x, y - mean_y, z - mean_z
    xx, xy, yy = (jnp.vdot(weight, v) / total for v in (dx * dx, dx * dy, dy * dy))
    xz, yz = (jnp.vdot(weight, v) / total for v in (dx * dz, dy * dz))
    determinant = jnp.maximum(xx * yy - xy * xy, 1e-6)
    slope_x, slope_y = (yy * xz - xy * yz) / determinant, (xx * yz - xy * xz) / determinant
    return jnp.stack([mean_z - slope_x * mean_x - slope_y * mean_y, slope_x, slope_y])


def _local_lines(
    blur: _Blur, weight: Array, x: Array, y: Array, z: Array, centre_x: Array, centre_y: Array
) -> tuple[Array, Array, Array]:
    """Height and slopes at each cell of the plane through its weighted surroundings.

    Far from all weight the height falls back to 0.
    """
    mass = blur(weight)
    safe = jnp.maximum(mass, 1e-6)
    mean_x, mean_y, mean_z = (blur(weight * v) / safe for v in (x, y, z))
    xx, xy, yy = (blur(weight * v) / safe for v in (x * x, x * y, y * y))
    xz, yz = blur(weight * x * z) / safe - mean_x * mean_z, blur(weight * y * z) / safe - mean_y * mean_z
    xx, xy, yy = xx - mean_x**2 + _RIDGE_M**2, xy - mean_x * mean_y, yy - mean_y**2 + _RIDGE_M**2
    determinant = jnp.maximum(xx * yy - xy * xy, _RIDGE_M**4)
    slope_x, slope_y = (yy * xz - xy * yz) / determinant, (xx * yz - xy * xz) / determinant
    trust = mass / (mass + 1e-3)
    level = mean_z + slope_x * (centre_x - mean_x) + slope_y * (centre_y - mean_y)
    return trust * level, trust * slope_x, trust * slope_y


class _Blur(NamedTuple):
    """Gaussian smoothing of cells as two products, which are faster than a convolution, however wide it is."""

    rows: Array
    columns: Array

    @classmethod
    def of(cls, cells: _Cells, sigma_m: float) -> _Blur:
        def along(count: int) -> Array:
            apart = np.subtract.outer(np.arange(count), np.arange(count)) * cells.edge_m / sigma_m
            return jnp.asarray(np.exp(-0.5 * apart**2).astype(np.float32))

        return cls(along(cells.ahead), along(cells.across))

    def __call__(self, field: Array) -> Array:
        return jnp.dot(jnp.dot(self.rows, field), self.columns)


def _extreme(field: Array, reach: int, choose: object, outside: float) -> Array:
    """Least or greatest value of the square of cells around each."""
    for axis in (0, 1):
        size = tuple(2 * reach + 1 if place == axis else 1 for place in (0, 1))
        field = jax.lax.reduce_window(field, outside, choose, size, (1, 1), "SAME")
    return field


def _surface_slope(camera: StereoCamera, up: Array, blocks_px: Array, valid: Array) -> Array:
    """Tangent of the surface's slope, from the plane that disparity follows nearby.

    On the plane `n . P = c` disparity is linear in the pixel, `d = a (u - cx) + b (v - cy) + d_c` with
    `n ~ (a fx, b fy, d_c)`.
    """
    mask = valid.astype(blocks_px.dtype)
    disparity = jnp.where(valid, blocks_px / RELIEF_STRIDE + camera.doffs_px, 0.0)

    def box(field: Array) -> Array:
        padded = jnp.pad(field, 1)
        rows = padded[:-2] + padded[1:-1] + padded[2:]
        return rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]

    mass = box(mask)
    mean = box(disparity) / jnp.maximum(mass, 1.0)
    there = mass > 4

    def difference(axis: int) -> Array:
        """Per pixel along an axis, over two pixels to both sides; 0 where either is unknown."""
        place = np.arange(mean.shape[axis])
        after, before = np.minimum(place + 2, place[-1]), np.maximum(place - 2, 0)
        span = np.expand_dims(np.maximum(after - before, 1), 1 - axis)
        both = jnp.take(there, after, axis=axis) & jnp.take(there, before, axis=axis)
        return jnp.where(both, (jnp.take(mean, after, axis=axis) - jnp.take(mean, before, axis=axis)) / span, 0.0)

    along_v, along_u = difference(0), difference(1)
    v = jnp.arange(mean.shape[0])[:, None] - camera.cy_px
    u = jnp.arange(mean.shape[1])[None, :] - camera.cx_px
    normal = (along_u * camera.fx_px, along_v * camera.fy_px, mean - along_u * u - along_v * v)
    upright = sum(component * up[axis] for axis, component in enumerate(normal))
    squared = sum(component**2 for component in normal)
    across = _safe_sqrt(jnp.maximum(squared - upright**2, 0.0))
    # Seen at all, a surface that leans further is a wall.
    return jnp.minimum(across / jnp.maximum(jnp.abs(upright), 1e-6), 20.0)


def _safe_sqrt(values: Array) -> Array:
    """Square root whose gradient is finite at 0."""
    return jnp.sqrt(jnp.maximum(values, 1e-12))
