"""Crops of frames: their points are those of the frame, whatever is cut, scaled and mirrored."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import HEIGHT_PX, WIDTH_PX, disparities, rngs

from jaxmap.geometry.camera import disparity_to_points, frustum_corners
from jaxmap.labels import IGNORE
from jaxmap.training.augment import CropWindow as View
from jaxmap.training.options import AugmentationOptions
from jaxmap.tuning.frame_crops import FrameBatch, camera_of_view, crop_frame, points_per_pixel, widest_camera
from jaxmap.types import make_stereo_camera

CAMERA = make_stereo_camera(
    fx_px=30, fy_px=28, cx_px=15.2, cy_px=11.7, baseline_m=0.3, doffs_px=0.4, width_px=WIDTH_PX, height_px=HEIGHT_PX
)
CROP_PX = (16, 20)
OPTIONS = AugmentationOptions(crop_px=CROP_PX, scale=(0.5, 2.0))
POSE = np.array([1, 0, 0, 0, 0, 0, 0], np.float32)

views = st.builds(
    lambda scale, row, column, mirrored: View(
        jnp.float32(scale), jnp.array([row, column], jnp.int32), jnp.array(mirrored)
    ),
    st.floats(0.5, 2.0),
    st.integers(-4, 20),
    st.integers(-4, 30),
    st.booleans(),
)


@given(view=views)
@settings(max_examples=30, deadline=None)
def test_the_camera_of_a_view_sees_each_pixel_where_it_lies_in_the_image(view):
    """The twin: a pixel of the crop lies at `(u + offset + 0.5) / scale - 0.5` of the image, or of its mirror image."""
    depth_m = 2.5
    camera = camera_of_view(CAMERA, view, CROP_PX)
    u, v = np.meshgrid(np.arange(CROP_PX[1]), np.arange(CROP_PX[0]))
    scale, (row, column) = float(view.scale), np.asarray(view.offset_px)
    u_image, v_image = (u + column + 0.5) / scale - 0.5, (v + row + 0.5) / scale - 0.5
    if view.mirrored:
        u_image = WIDTH_PX - 1 - u_image
    expected = np.stack(
        [
            (u_image - float(CAMERA.cx_px)) / float(CAMERA.fx_px) * depth_m,
            (v_image - float(CAMERA.cy_px)) / float(CAMERA.fy_px) * depth_m,
            np.full(u.shape, depth_m),
        ],
        axis=-1,
    )
    disparity_px = float(CAMERA.baseline_m) * float(CAMERA.fx_px) / depth_m - float(CAMERA.doffs_px)
    points, valid = disparity_to_points(camera, jnp.full(CROP_PX, disparity_px * scale, jnp.float32))
    assert np.asarray(valid).all()
    np.testing.assert_allclose(points, expected, rtol=1e-4, atol=1e-4)


@partial(jax.jit, static_argnums=2)
def cropped(key: jax.Array, frame: FrameBatch, options: AugmentationOptions):
    return crop_frame(key, frame, CAMERA, options, (1.0, 2.0, 3.0))


def a_frame(rng: np.random.Generator) -> FrameBatch:
    disparity_px = disparities(rng)
    # The colour tells the pixel, so that what was cut can be found again.
    rows, columns = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    image = np.stack([rows, columns, np.zeros_like(rows)], axis=-1).astype(np.uint8)
    return FrameBatch(image, disparity_px, POSE, (rows % 3).astype(np.uint8), np.zeros(2, np.int32))  # type: ignore[arg-type]


@given(rng=rngs(), seed=st.integers(0, 2**31 - 1))
@settings(max_examples=30, deadline=None)
def test_a_crop_at_full_scale_holds_points_of_the_frame_and_no_others(rng, seed):
    frame = a_frame(rng)
    options = AugmentationOptions(crop_px=CROP_PX, scale=(1.0, 1.0))
    crop = cropped(jax.random.key(seed), frame, options)
    points, valid = (np.asarray(one) for one in disparity_to_points(crop.camera, crop.disparity_px))
    all_points, all_valid = (np.asarray(one) for one in disparity_to_points(CAMERA, jnp.asarray(frame.disparity_px)))
    rows, columns = np.asarray(crop.image[..., 0]).astype(int), np.asarray(crop.image[..., 1]).astype(int)
    assert (valid == all_valid[rows, columns]).all()
    np.testing.assert_allclose(points[valid], all_points[rows, columns][valid], rtol=1e-4, atol=1e-4)
    assert (np.asarray(crop.anchors) == rows % 3).all()


def test_small_crops_keep_all_the_points():
    """Seen at half the scale, a frame has as many points as before, and they are the same."""
    frame = a_frame(np.random.default_rng(2))
    options = AugmentationOptions(scale=(0.5, 0.5), mirror=False)
    # Smaller than options may be.
    object.__setattr__(options, "crop_px", (HEIGHT_PX // 2, WIDTH_PX // 2))
    assert points_per_pixel(options) == 2
    crop = cropped(jax.random.key(0), frame, options)
    assert crop.image.shape[:2] == (HEIGHT_PX // 2, WIDTH_PX // 2)
    np.testing.assert_array_equal(crop.disparity_px, frame.disparity_px)
    for ours, expected in zip(jax.tree.leaves(crop.camera), jax.tree.leaves(CAMERA), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-6)


def test_what_lies_outside_the_image_is_nothing():
    frame = a_frame(np.random.default_rng(0))
    options = AugmentationOptions(crop_px=(80, 90), scale=(1.0, 1.0), brightness=0.5)
    crop = cropped(jax.random.key(1), frame, options)
    outside = np.asarray(crop.anchors) == IGNORE
    assert outside.sum() == 80 * 90 - HEIGHT_PX * WIDTH_PX
    assert np.isnan(np.asarray(crop.disparity_px)[outside]).all()
    assert (np.asarray(crop.image)[outside] == [1, 2, 3]).all()


@pytest.mark.slow
@pytest.mark.parametrize("crop_px", [CROP_PX, (80, 40)])
@given(seed=st.integers(0, 2**31 - 1))
@settings(max_examples=20, deadline=None)
def test_the_widest_camera_sees_what_any_crop_sees(crop_px, seed):
    options = AugmentationOptions(crop_px=crop_px, scale=(0.5, 2.0))
    crop = cropped(jax.random.key(seed), a_frame(np.random.default_rng(0)), options)
    wide = np.asarray(frustum_corners(widest_camera(CAMERA, options), 4.0))
    own = np.asarray(frustum_corners(crop.camera, 4.0))
    for axis in range(3):
        assert wide[:, axis].min() <= own[:, axis].min() + 1e-3
        assert wide[:, axis].max() >= own[:, axis].max() - 1e-3
