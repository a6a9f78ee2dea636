"""Crops of stereo frames for training: a scaled, mirrored crop of a frame is the frame of another camera."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt8

from jaxmap.labels import IGNORE
from jaxmap.training.augment import CropWindow as View
from jaxmap.training.augment import change_light_inside, cut, cut_nearest
from jaxmap.training.augment import draw_window as draw_view
from jaxmap.training.options import AugmentationOptions
from jaxmap.types import StereoCamera


class FrameBatch(NamedTuple):
    """Frames as they were prepared, and what is to be made of each.

    Attributes:
        images: rectified left images, RGB.
        disparity_px: of the same pixels, NaN where unknown.
        poses: T_world_camera as jaxlie's parameters (quaternion wxyz, then position in metres).
        anchors: of the same pixels, what the network is held to (`map_step.anchor_loss`).
        draws: what the randomness of each crop is drawn from: (epoch, example).
    """

    images: UInt8[Array, "B H W 3"]
    disparity_px: Float[Array, "B H W"]
    poses: Float[Array, "B 7"]
    anchors: UInt8[Array, "B H W"]
    draws: Int[Array, "B 2"]


class FrameCrop(NamedTuple):
    """A crop of a frame, and the camera that sees its disparity; what lies outside the image has none.

    The disparity is finer than the image by `points_per_pixel`: the network may run small, and the map still gets all
    the points.
    """

    image: Float[Array, "h w 3"]
    disparity_px: Float[Array, "fh fw"]
    anchors: UInt8[Array, "h w"]
    camera: StereoCamera
    T_world_camera: jaxlie.SE3


def crop_frame(
    key: PRNGKeyArray,
    frame: FrameBatch,
    camera: StereoCamera,
    options: AugmentationOptions,
    fill: tuple[float, ...],
) -> FrameCrop:
    """A random crop of a frame in random light.

    Args:
        key: of this crop.
        frame: one of a batch, without the leading axis.
        camera: of the frame.
        options: how crops are drawn; `copies` is of no account.
        fill: colour of what lies outside the image.
    """
    view_key, light_key = jax.random.split(key)
    size_px = jnp.array([camera.height_px, camera.width_px])
    view = draw_view(view_key, frame.anchors, size_px, options)
    image, anchors = cut(view, frame.images, frame.anchors, size_px, options.crop_px, fill)
    image = change_light_inside(light_key, view, image, size_px, options)
    density = points_per_pixel(options)
    fine = View(view.scale * density, view.offset_px * density, view.mirrored)
    fine_px = options.crop_px[0] * density, options.crop_px[1] * density
    disparity_px = cut_nearest(fine, frame.disparity_px, size_px, fine_px, np.nan) * fine.scale
    return FrameCrop(image, disparity_px, anchors, camera_of_view(camera, fine, fine_px), jaxlie.SE3(frame.poses))


def points_per_pixel(options: AugmentationOptions) -> int:
    """Points along each side of a pixel of a crop, so that crops of the middle scale have about all of the frame's."""
    return max(1, round(1 / float(np.sqrt(options.scale[0] * options.scale[1]))))


def camera_of_view(camera: StereoCamera, view: View, crop_px: tuple[int, int]) -> StereoCamera:
    """The rectified pair whose left image is a view of this one's; disparities scale with the view.

    Where the view is mirrored, focal length and baseline are negative along x: depths, `b f / d`, stay positive.
    """
    sign = jnp.where(view.mirrored, -1.0, 1.0)
    # From the middle of a pixel to its edge, as in `augment._positions`.
    cx_px = jnp.where(view.mirrored, camera.width_px - 1 - camera.cx_px, camera.cx_px)
    return StereoCamera(
        fx_px=camera.fx_px * view.scale * sign,
        fy_px=camera.fy_px * view.scale,
        cx_px=(cx_px + 0.5) * view.scale - 0.5 - view.offset_px[1],
        cy_px=(camera.cy_px + 0.5) * view.scale - 0.5 - view.offset_px[0],
        baseline_m=camera.baseline_m * sign,
        doffs_px=camera.doffs_px * view.scale,
        width_px=crop_px[1],
        height_px=crop_px[0],
    )


def widest_camera(camera: StereoCamera, options: AugmentationOptions) -> StereoCamera:
    """A camera that sees whatever a crop's camera may see: the image, and what a crop may reach beyond it."""
    beyond = [
        max(0, int(np.ceil(crop / options.scale[0])) + 1 - size)
        for crop, size in zip(options.crop_px, (camera.height_px, camera.width_px), strict=True)
    ]
    return replace(
        camera,
        cx_px=camera.cx_px + beyond[1],
        cy_px=camera.cy_px + beyond[0],
        width_px=camera.width_px + 2 * beyond[1],
        height_px=camera.height_px + 2 * beyond[0],
    )


def blank_anchors(camera: StereoCamera) -> UInt8[np.ndarray, "H W"]:
    """Anchors of a frame that hold nothing."""
    return np.full((camera.height_px, camera.width_px), IGNORE, np.uint8)
