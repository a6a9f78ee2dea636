"""Relief: how the surface in view rises above the local ground, from the disparity of one frame and the direction up.

It is what tells a rock from its shadow, and what rovers read hazards from (Goldberg, Maimone and Matthies 2002, "Stereo
vision and rover navigation software for planetary exploration"). Turning about the vertical and moving change nothing:
the cells of the ground turn and move with the camera (`geometry.ground`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped

from jaxmap.geometry.camera import depth_sigma, disparity_to_points
from jaxmap.geometry.ground import Lattice, LevelPoints, fit_ground, fit_plane, mean_cells, safe_sqrt
from jaxmap.geometry.options import GroundOptions
from jaxmap.types import StereoCamera

RELIEF_STRIDE = 4
"""Pixels of the disparity image along each edge of a pixel of relief."""

RELIEF_CHANNELS = 6

_STEEPEST = 20.0
"""Greatest slope: seen at all, a surface that leans further is a wall."""
_NEAR_M, _HIGH_M = 0.3, 0.5
"""Points nearer to the plane of the ground lie on it; points farther above it may float."""
_LEAST_SHARE = 0.3
"""Of the points, that lie on the plane of the ground: on hills of half a metre it is 0.4, under a false up 0.25."""
_MOST_PX = 1e5
"""Greater disparities are none: no image is so wide."""
_STRIP_BLOCKS = 32


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
        floating: false matches in the air, straight below which farther ground is seen. Whatever stands on the ground
            hides what lies behind it.
        found: whether there is ground below the camera at all.
    """

    height_m: Float[Array, "h w"]
    sigma_m: Float[Array, "h w"]
    slope: Float[Array, "h w"]
    roughness_m: Float[Array, "h w"]
    step_m: Float[Array, "h w"]
    depth_m: Float[Array, "h w"]
    known: Bool[Array, "h w"]
    floating: Bool[Array, "h w"]
    found: Bool[Array, ""]


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
        up_camera: the direction away from the ground, in the camera frame.
        disparity_px: not finite where unknown.
        disparity_sigma_px: standard deviation of disparity.
        options: by default those of `GroundOptions`.
    """
    options = options or GroundOptions()
    with jax.named_scope("relief"):
        # The frame as a camera of larger pixels sees it.
        camera = _coarse(camera)
        disparity_px = block_means(disparity_px, RELIEF_STRIDE) / RELIEF_STRIDE
        points_camera, valid = disparity_to_points(camera, disparity_px)
        depth_m = points_camera[..., 2]
        sigma_depth_m = depth_sigma(camera, depth_m, disparity_sigma_px / RELIEF_STRIDE)
        R = level_rotation(up_camera)
        x, y, z = _turned(R, points_camera[..., 0], points_camera[..., 1], depth_m)
        points = LevelPoints(x, y, z, jnp.abs(z) * sigma_depth_m / depth_m)

        lattice, focal_px = Lattice.of(options), jnp.sqrt(camera.fx_px * camera.fy_px)
        index, inside = lattice.cell_of(points, valid)
        plane, found = fit_plane(mean_cells(lattice, points, index, inside, focal_px))
        above_m = z - plane.at(x, y)
        on_plane = inside & (jnp.abs(above_m) < _NEAR_M)
        # Under a wrong direction up, planes are found through walls and columns: few points lie on those.
        found &= on_plane.sum() >= _LEAST_SHARE * inside.sum()
        ground_m = _farthest_below(camera, R, jnp.where(on_plane, depth_m, 0.0), points)
        floating = found & valid & (above_m > _HIGH_M) & (depth_m + 1.0 + 3 * sigma_depth_m < ground_m)
        inside &= ~floating
        cells = mean_cells(lattice, points, index, inside, focal_px)
        ground = fit_ground(lattice, cells, plane, options).of_points(index)

        surface, (centre_x, centre_y) = ground.surface, lattice.centres(index)
        height_m = z - surface.at(x - centre_x, y - centre_y)
        # What a metre of depth adds to the height: the ray rises, and so does the ground below it.
        rise = jnp.abs(z - surface.slope_x * x - surface.slope_y * y) / depth_m
        slope = _surface_slope(camera, R[2], disparity_px)
        known = inside & ground.seen & found
        of_known = [
            jnp.where(known, value, 0.0)
            for value in (height_m, rise * sigma_depth_m, slope, ground.roughness_m, ground.step_m, depth_m)
        ]
        return Relief(*of_known, known=known, floating=floating, found=found)


def relief_channels(relief: Relief) -> Float[Array, "h w 6"]:
    """Relief as the input of a network: bounded numbers, 0 where unknown, the last channel 1 where known.

    They are the height on a scale that is linear near the ground and logarithmic above it, its ratio to its noise, the
    angle of the slope, and on logarithmic scales the step and the noise.
    """
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


def to_pixels(image: Shaped[Array, "h w *c"], image_px: tuple[int, int]) -> Shaped[Array, "H W *c"]:
    """An image of relief at the pixels of the disparity, whose height and width are given."""
    fine = jnp.repeat(jnp.repeat(image, RELIEF_STRIDE, axis=0), RELIEF_STRIDE, axis=1)
    return fine[: image_px[0], : image_px[1]]


def level_rotation(up_camera: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """R_level_camera: the level frame looks along the optical axis, or up the image where that points straight down."""
    up = up_camera / jnp.linalg.norm(up_camera)
    steep = jnp.abs(up[2]) > 0.999
    ahead = jnp.where(steep, jnp.array([0.0, -1.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    ahead = ahead - (ahead * up).sum() * up
    forward = ahead / jnp.linalg.norm(ahead)
    return jnp.stack([forward, jnp.cross(up, forward), up])


def block_means(disparity_px: Float[Array, "H W"], size: int) -> Float[Array, "h w"]:
    """Mean disparity of square blocks; NaN where less than half of their pixels are known."""
    height, width = (-(-edge // size) for edge in disparity_px.shape)
    strip = min(width, _STRIP_BLOCKS)
    strips = -(-width // strip)
    missing = (height * size - disparity_px.shape[0], strips * strip * size - disparity_px.shape[1])
    padded = jnp.pad(disparity_px, [(0, count) for count in missing], constant_values=jnp.nan)
    # Columns of a block add up by a product: strided slices within a row are slow.
    gather = jnp.asarray(np.repeat(np.eye(strip), size, axis=0), padded.dtype)

    def sums(values: list[Array]) -> Array:
        rows = sum(values[1:], start=values[0]).reshape(height * strips, strip * size)
        return jnp.dot(rows, gather, precision="highest").reshape(height, -1)[:, :width]

    lines = [padded[first::size] for first in range(size)]
    known = [jnp.abs(line) < _MOST_PX for line in lines]
    count = sums([there.astype(padded.dtype) for there in known])
    total = sums([jnp.where(there, line, 0.0) for there, line in zip(known, lines, strict=True)])
    return jnp.where(count >= size * size / 2, total / jnp.maximum(count, 1.0), jnp.nan)


def _coarse(camera: StereoCamera) -> StereoCamera:
    """The camera of the blocks: its pixels are larger, and so are disparities in them smaller."""
    shift = (RELIEF_STRIDE - 1) / 2
    return replace(
        camera,
        fx_px=camera.fx_px / RELIEF_STRIDE,
        fy_px=camera.fy_px / RELIEF_STRIDE,
        cx_px=(camera.cx_px - shift) / RELIEF_STRIDE,
        cy_px=(camera.cy_px - shift) / RELIEF_STRIDE,
        doffs_px=camera.doffs_px / RELIEF_STRIDE,
    )


def _turned(R: Float[Array, "3 3"], x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
    """Vectors in another frame; written out, as a product with so small a matrix is slow."""
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )


def _farthest_below(
    camera: StereoCamera, R: Float[Array, "3 3"], ground_m: Float[Array, "h w"], points: LevelPoints
) -> Float[Array, "h w"]:
    """The greatest of depths on the ground, 0 for none, that are seen straight below each point.

    Verticals lean in a tilted image, and are columns of the one that a level camera sees; its rows begin at the
    horizon.
    """
    height, width = ground_m.shape
    focal_px, middle = jnp.sqrt(camera.fx_px * camera.fy_px), (width - 1) / 2
    down, left = jnp.arange(height)[:, None] / focal_px, (middle - jnp.arange(width)) / focal_px
    x, y, z = _turned(R.T, jnp.ones_like(left), left, -down)
    z = jnp.maximum(z, 1e-3)
    level_m = _nearest(ground_m, camera.fy_px * y / z + camera.cy_px, camera.fx_px * x / z + camera.cx_px)
    farthest_m = jax.lax.cummax(level_m, axis=0, reverse=True)
    # In all of three columns: the edge of a boulder shares its own with what is seen beside it.
    padded = jnp.pad(farthest_m, ((0, 0), (1, 1)), mode="edge")
    farthest_m = jnp.minimum(jnp.minimum(padded[:, :-2], padded[:, 1:-1]), padded[:, 2:])
    ahead_m = jnp.maximum(points.x_m, 1e-3)
    row = jnp.maximum(-points.z_m / ahead_m * focal_px, 0.0)
    return _nearest(farthest_m, row, middle - points.y_m / ahead_m * focal_px)


def _nearest(image: Float[Array, "h w"], row: Float[Array, "*s"], column: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """The pixels nearest to places of an image; 0 outside."""
    height, width = image.shape
    row, column = jnp.round(row), jnp.round(column)
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    index = jnp.where(inside, row * width + column, 0.0).astype(jnp.int32)
    return jnp.where(inside, jnp.take(image.reshape(-1), index, mode="clip"), 0.0)


def _surface_slope(camera: StereoCamera, up_camera: Array, disparity_px: Array) -> Array:
    """Tangent of the surface's slope, from the plane that disparity follows nearby.

    On the plane `n . P = c` disparity is linear in the pixel, `d = a (u - cx) + b (v - cy) + d_c`, and
    `n ~ (a fx, b fy, d_c)`. So are means over boxes, at the mean place of the pixels that are known in them: from the
    differences of two pairs of boxes, beside and above one another, a and b are exact whatever the holes. Without one
    of a pair, disparity is taken as constant in its direction.
    """
    known = jnp.isfinite(disparity_px)
    height, width = disparity_px.shape
    u = jnp.broadcast_to(jnp.arange(width) - camera.cx_px, known.shape)
    v = jnp.broadcast_to(jnp.arange(height)[:, None] - camera.cy_px, known.shape)
    summed = [jnp.ones_like(u), u, v, disparity_px + camera.doffs_px]
    count, *sums = (box_sums(jnp.where(known, image, 0.0)) for image in summed)
    means = [total / jnp.maximum(count, 1.0) for total in sums]

    def differences(axis: int, instead: tuple[float, float, float]) -> list[Array]:
        """Of the means, over two pixels to both sides; at the edge from the last ones."""

        def ends(image: Array) -> tuple[Array, Array]:
            padded = jnp.pad(image, [(2, 2) if axis == along else (0, 0) for along in (0, 1)], mode="edge")
            return padded[:height, :width], padded[-height:, -width:]

        both = jnp.logical_and(*ends(count > 4))
        pairs = zip((ends(mean) for mean in means), instead, strict=True)
        return [jnp.where(both, after - before, other) for (before, after), other in pairs]

    (du, dv, dd), (eu, ev, ed) = differences(1, (1.0, 0.0, 0.0)), differences(0, (0.0, 1.0, 0.0))
    determinant = du * ev - dv * eu
    a, b = (dd * ev - ed * dv) / determinant, (ed * du - dd * eu) / determinant
    u, v, d = means
    x, y, z = a * camera.fx_px, b * camera.fy_px, d - a * u - b * v
    upright = x * up_camera[0] + y * up_camera[1] + z * up_camera[2]
    across = safe_sqrt(x**2 + y**2 + z**2 - upright**2)
    return jnp.minimum(across / jnp.maximum(jnp.abs(upright), 1e-6), _STEEPEST)


def box_sums(image: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Sums over the three by three pixels around each."""
    padded = jnp.pad(image, 1)
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
