"""Rectification within the compiled step: raw images and the numbers of their cameras in, a rectified pair out.

What `jaxmap.stereo.rectify` does on the host with OpenCV's maps; here also the calibration has gradients.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Num

from jaxmap.types import DistortionModel, StereoCamera

_LEAST_COSINE = 1e-3
"""Rays that are flatter are not in any image."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RawCamera:
    """A camera with a lens, OpenCV's conventions: pixel centres are integers.

    `distortion` are `k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tau_x tau_y`, of an equidistant camera `k1 k2 k3 k4`.
    """

    fx_px: Float[Array, ""]
    fy_px: Float[Array, ""]
    cx_px: Float[Array, ""]
    cy_px: Float[Array, ""]
    distortion: Float[Array, "14"] | Float[Array, "4"]
    model: DistortionModel = field(default="opencv", metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RawPair:
    """The calibration of a raw pair; every leaf is differentiable.

    `T_right_left` moves points from the left camera's frame into the right one's; `R_aligned` corrects the rays of the
    rectified right camera (`stereo.align`).
    """

    left: RawCamera
    right: RawCamera
    T_right_left: jaxlie.SE3
    R_aligned: jaxlie.SO3


class RectifiedPair(NamedTuple):
    """A rectified pair; `*_seen` mark the pixels whose light fell on the raw image, others are black or fade to it."""

    left: Float[Array, "H W *rgb"]
    right: Float[Array, "H W *rgb"]
    left_seen: Bool[Array, "H W"]
    right_seen: Bool[Array, "H W"]


def rectify_pair(
    pair: RawPair, camera: StereoCamera, left: Num[Array, "h w *rgb"], right: Num[Array, "h w *rgb"]
) -> RectifiedPair:
    """The pair as the rectified camera sees it.

    Args:
        pair: the calibration.
        camera: of `make_rectifier`: its focal lengths, principal point and size are those of the rectified images. How
            far the calibration is tuned afterwards, they may stay; its baseline is `T_right_left`'s length.
        left: raw image, 0 to 255.
        right: likewise.

    Returns:
        float32 images, bilinear; equal to OpenCV's but for its rounding of places to 32nds of a pixel.
    """
    R_left, R_right = rectifying_rotations(pair)
    left_image, left_seen = rectify_image(pair.left, R_left, camera, left)
    right_image, right_seen = rectify_image(pair.right, R_right, camera, right)
    return RectifiedPair(left_image, right_image, left_seen, right_seen)


def rectifying_rotations(pair: RawPair) -> tuple[jaxlie.SO3, jaxlie.SO3]:
    """Rotations of the raw cameras' frames into the rectified one, after Bouguet (as `cv2.stereoRectify` has them).

    Each camera turns half of the way to the other, then both turn until the baseline is their x axis.
    """
    half = jaxlie.SO3.exp(-0.5 * pair.T_right_left.rotation().log())
    baseline = -(half @ pair.T_right_left.translation())
    length = jnp.linalg.norm(baseline)
    # The turn of `baseline` onto x, as a quaternion: 1 + cos of the angle, and sin times its axis.
    x, y, z = baseline / length
    onto_x = jaxlie.SO3(jnp.stack([1 + x, jnp.zeros_like(x), z, -y])).normalize()
    return onto_x @ half.inverse(), pair.R_aligned @ onto_x @ half


def rectify_image(
    raw: RawCamera, R_rectified_raw: jaxlie.SO3, camera: StereoCamera, image: Num[Array, "h w *rgb"]
) -> tuple[Float[Array, "H W *rgb"], Bool[Array, "H W"]]:
    """A raw image as a rectified camera sees it, and where it sees it."""
    u = jnp.arange(camera.width_px, dtype=jnp.float32)
    v = jnp.arange(camera.height_px, dtype=jnp.float32)[:, None]
    ray_x, ray_y = jnp.broadcast_arrays((u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px)
    turned = R_rectified_raw.inverse().as_matrix()
    x, y, z = (row[0] * ray_x + row[1] * ray_y + row[2] for row in turned)
    ahead = z > _LEAST_COSINE
    z = jnp.where(ahead, z, 1)
    x, y = (_equidistant if raw.model == "equidistant" else _brown_conrady)(raw.distortion, x / z, y / z)
    values, seen = _bilinear(image, raw.fx_px * x + raw.cx_px, raw.fy_px * y + raw.cy_px)
    seen &= ahead
    return jnp.where(ahead.reshape(ahead.shape + (1,) * (image.ndim - 2)), values, 0), seen


def _brown_conrady(k: Float[Array, "14"], x: Array, y: Array) -> tuple[Array, Array]:
    """OpenCV's model: rational radial, tangential, thin prism, and a tilted sensor."""
    r2 = x * x + y * y
    radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
    bent_x = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x) + r2 * (k[8] + r2 * k[9])
    bent_y = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y + r2 * (k[10] + r2 * k[11])
    R = (jaxlie.SO3.from_y_radians(-k[13]) @ jaxlie.SO3.from_x_radians(-k[12])).as_matrix()
    across_x, across_y, along = (row[0] * bent_x + row[1] * bent_y + row[2] for row in R)
    # The tilted plane is projected back along the axis of the lens.
    return (R[2, 2] * across_x - R[0, 2] * along) / along, (R[2, 2] * across_y - R[1, 2] * along) / along


def _equidistant(k: Float[Array, "4"], x: Array, y: Array) -> tuple[Array, Array]:
    """Kannala and Brandt (PAMI 2006), as `cv2.fisheye`."""
    # Never zero, where neither the root nor the quotient has a derivative; no pixel is that near to the axis.
    r = jnp.sqrt(jnp.maximum(x * x + y * y, 1e-16))
    theta = jnp.arctan(r)
    t2 = theta * theta
    stretch = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / r
    return x * stretch, y * stretch


def _bilinear(
    image: Num[Array, "h w *rgb"], u: Float[Array, "H W"], v: Float[Array, "H W"]
) -> tuple[Float[Array, "H W *rgb"], Bool[Array, "H W"]]:
    """The values at places of an image, black around it; and whether all that they are made of lies in it."""
    height, width = image.shape[:2]
    near = (u > -1) & (u < width) & (v > -1) & (v < height)
    u, v = jnp.where(near, u, -1), jnp.where(near, v, -1)
    left, top = jnp.floor(u), jnp.floor(v)
    seen = (left >= 0) & (top >= 0) & (u <= width - 1) & (v <= height - 1)
    share_u, share_v = u - left, v - top
    left, top = left.astype(jnp.int32), top.astype(jnp.int32)
    pixels = jnp.asarray(image).reshape(height * width, *image.shape[2:])
    spread = (..., *(None,) * (image.ndim - 2))

    def corner(row: Array, column: Array, weight: Array) -> Array:
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        place = jnp.where(inside, row * width + column, 0)
        return jnp.where(inside, weight, 0)[spread] * pixels[place].astype(jnp.float32)

    above = corner(top, left, (1 - share_u) * (1 - share_v)) + corner(top, left + 1, share_u * (1 - share_v))
    below = corner(top + 1, left, (1 - share_u) * share_v) + corner(top + 1, left + 1, share_u * share_v)
    return above + below, seen
