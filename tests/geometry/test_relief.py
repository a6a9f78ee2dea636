"""Relief and the local ground: their twin, and the laws that they keep."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import reference_relief
from hypothesis import given
from hypothesis import strategies as st
from relief_scenes import CAMERA, HEIGHT_PX, WIDTH_PX, Box, View, rotation, view_of
from scipy import ndimage
from strategies import rngs

from jaxmap.geometry.options import GroundOptions
from jaxmap.geometry.relief import RELIEF_STRIDE, Relief, relief_channels, relief_of

OPTIONS = GroundOptions(range_m=8.0, cell_m=0.16)
PRECISE_PX, NOISY_PX = 0.02, 0.5
BLOCKS = HEIGHT_PX // RELIEF_STRIDE, WIDTH_PX // RELIEF_STRIDE


@jax.jit
def measured(camera, up_camera, disparity_px, sigma_px) -> Relief:
    """One program for all tests."""
    return relief_of(camera, up_camera, disparity_px, sigma_px, OPTIONS)


def relief_in(view: View, *, disparity_px=None, up_camera=None, sigma_px: float = PRECISE_PX) -> Relief:
    disparity_px = view.disparity_px if disparity_px is None else disparity_px
    up_camera = np.asarray(view.up_camera if up_camera is None else up_camera, np.float32)
    return jax.tree.map(np.asarray, measured(CAMERA, up_camera, disparity_px, np.float32(sigma_px)))


def blocks(image: np.ndarray) -> np.ndarray:
    """The pixels of each block, (h, w, 16)."""
    cut = image.reshape(BLOCKS[0], RELIEF_STRIDE, BLOCKS[1], RELIEF_STRIDE)
    return np.moveaxis(cut, 1, 2).reshape(*BLOCKS, -1)


def noisy(view: View, rng: np.random.Generator, sigma_px: float, holes: float = 0.0) -> np.ndarray:
    disparity_px = view.disparity_px + rng.normal(0, sigma_px, view.disparity_px.shape).astype(np.float32)
    return np.where(rng.random(disparity_px.shape) < holes, np.float32(np.nan), disparity_px)


ROCKS = (Box(3.0, -0.4, 0.7, 0.3), Box(4.2, 0.8, 0.9, 0.5), Box(2.2, 0.7, 0.4, 0.15), Box(5.5, -1.8, 1.0, 1.0))


@cache
def rocky() -> View:
    return view_of(boxes=ROCKS)


@cache
def bare() -> View:
    return view_of()


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_relief_is_that_of_the_twin(seed):
    rng = np.random.default_rng(seed)
    view = view_of(tuple(rng.uniform(-0.2, 0.2, 2)), ROCKS, pitch_deg=20.0, roll_deg=rng.uniform(-10, 10))
    disparity_px = noisy(view, rng, 0.3, holes=0.2)
    for _ in range(4):
        row, column = rng.integers(0, (HEIGHT_PX - 20, WIDTH_PX - 20))
        disparity_px[row : row + 20, column : column + 20] = rng.choice([np.nan, 40.0, 15.0])
    ours = relief_in(view, disparity_px=disparity_px, sigma_px=0.3)
    twin = reference_relief.relief(CAMERA, view.up_camera, disparity_px, 0.3, OPTIONS)
    assert ours.found and twin.found
    np.testing.assert_array_equal(ours.known, twin.known)
    np.testing.assert_array_equal(ours.floating, twin.floating)
    # Of the second draw, no patch lies in the sky.
    assert ours.floating.any() == (seed == 0) and 0.3 < ours.known.mean() < 1
    for name, within in dict(height_m=2e-3, sigma_m=2e-3, roughness_m=1e-3, step_m=1e-4, depth_m=1e-4).items():
        np.testing.assert_allclose(getattr(ours, name), getattr(twin, name), atol=within, err_msg=name)
    # Of a wall the tangent is large, and so is what rounding does to it.
    np.testing.assert_allclose(np.arctan(ours.slope), np.arctan(twin.slope), atol=2e-3)


@given(st.floats(0, 30), st.floats(0, 360), st.floats(-15, 15))
def test_planes_of_any_slope_rise_nowhere(steep_deg, azimuth_deg, roll_deg):
    azimuth, slope = np.radians(azimuth_deg), np.tan(np.radians(steep_deg))
    view = view_of((slope * np.cos(azimuth), slope * np.sin(azimuth)), roll_deg=roll_deg)
    relief = relief_in(view)
    assert relief.found and relief.known.any() and not relief.floating.any()
    assert np.abs(relief.height_m).max() < 1e-4
    assert max(relief.roughness_m.max(), relief.step_m.max()) < 1e-4
    # Of pixels around which all is known.
    there = ndimage.minimum_filter(np.isfinite(blocks(view.disparity_px)).all(axis=-1), 7, mode="nearest")
    # The boxes in the corners of the image are too small.
    there[np.ix_(*[[0, 1, 2, -3, -2, -1]] * 2)] = False
    np.testing.assert_allclose(relief.slope[relief.known & there], slope, atol=2e-3)


def test_tops_of_boxes_have_their_heights():
    relief = relief_in(rocky())
    truth_m = blocks(rocky().height_m)
    flat = relief.known & (np.ptp(truth_m, axis=-1) < 1e-6)
    off_m = np.abs(relief.height_m - truth_m[..., 0])
    tops = flat & (truth_m[..., 0] > 0.01)
    assert tops.sum() > 20
    assert off_m[tops].max() < 0.02
    assert np.median(off_m[flat & ~tops]) < 1e-3


def test_noise_does_not_bend_the_ground():
    rng, view, heights_m = np.random.default_rng(5), bare(), []
    for _ in range(12):
        relief = relief_in(view, disparity_px=noisy(view, rng, NOISY_PX), sigma_px=NOISY_PX)
        heights_m.append(np.where(relief.known, relief.height_m, np.nan))
    mean_m = np.nanmean(heights_m, axis=0)
    depth_m = blocks(view.depth_m).mean(axis=-1)
    for nearest_m, farthest_m, within_m in ((1, 3, 2e-3), (3, 5, 4e-3), (5, 7, 8e-3)):
        band = (depth_m > nearest_m) & (depth_m < farthest_m)
        assert abs(np.nanmean(mean_m[band])) < within_m, (nearest_m, np.nanmean(mean_m[band]))


@given(st.floats(-3.1, 3.1), rngs())
def test_turning_about_the_vertical_and_moving_change_nothing(yaw, rng):
    R_world_level = jaxlie.SO3.from_z_radians(yaw).as_matrix()
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.asarray(R_world_level) @ rocky().R_level_camera
    T_world_camera[:3, 3] = rng.uniform(-50, 50, 3)
    pose = jaxlie.SE3.from_matrix(jnp.asarray(T_world_camera, jnp.float32))
    turned, level = relief_in(rocky(), up_camera=pose.rotation().as_matrix()[2]), relief_in(rocky())
    # Up to points at the edge of a cell, which may fall into the next.
    same = turned.known & level.known
    assert same.sum() > 0.99 * level.known.sum()
    off_m = np.abs(turned.height_m - level.height_m)[same]
    assert np.median(off_m) < 1e-4 and np.quantile(off_m, 0.95) < 5e-3


def test_false_matches_in_the_sky_float_and_boulders_do_not():
    behind = (Box(3.0, -0.6, 1.0, 0.5), Box(5.0, -0.8, 1.2, 1.0), Box(4.0, 1.0, 1.0, 1.0))
    view = view_of(boxes=behind)
    assert not relief_in(view).floating.any()
    disparity_px = view.disparity_px.copy()
    sky = slice(4, 24), slice(100, 140)
    disparity_px[sky] = 40.0
    floating = relief_in(view, disparity_px=disparity_px).floating
    marked = np.zeros(BLOCKS, bool)
    marked[1:6, 25:35] = True
    np.testing.assert_array_equal(floating, marked)


UP = rotation(18.0, 0.0)
FALSE_UPS = {
    "optical axis": [0, 0, 1],
    "against the optical axis": [0, 0, -1],
    "down": -UP[2],
    "left": UP[1],
    "right": -UP[1],
    "forward": UP[0],
    "backward": -UP[0],
}


@pytest.mark.parametrize("up_camera", FALSE_UPS.values(), ids=FALSE_UPS.keys())
def test_no_ground_is_found_in_a_world_that_is_not_z_up(up_camera):
    assert_nothing_known(relief_in(rocky(), up_camera=up_camera))


def test_no_ground_is_found_where_none_is_in_view():
    view = view_of(pitch_deg=-40.0)
    assert_nothing_known(relief_in(view, disparity_px=np.full_like(view.disparity_px, 20.0)))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0, -3.0, 1e30, -1e30, 1e-30])
def test_a_frame_of_one_number_has_no_ground(value):
    assert_nothing_known(relief_in(bare(), disparity_px=np.full((HEIGHT_PX, WIDTH_PX), value, np.float32)))


def assert_nothing_known(relief: Relief) -> None:
    assert not relief.found and not relief.known.any() and not relief.floating.any()
    assert not np.asarray(relief_channels(relief)).any()


HOLES = {"none": [], "few": [np.nan], "of all kinds": [np.nan, np.inf, -np.inf, -3.0, 0.0, 1e30]}


@jax.jit
@jax.value_and_grad
def bent(inputs, weights) -> jax.Array:
    """Something smooth of all that relief is."""
    relief = relief_of(*inputs, OPTIONS)
    return (relief_channels(relief) * weights).sum() + relief.roughness_m.sum() + relief.depth_m.sum()


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [*HOLES.values(), None], ids=[*HOLES.keys(), "nothing else"])
def test_gradients_are_finite(kinds):
    rng = np.random.default_rng(8)
    disparity_px = noisy(rocky(), rng, 0.2)
    if kinds is None:
        disparity_px[:] = np.nan
    elif kinds:
        holes = rng.random(disparity_px.shape) < 0.3
        disparity_px[holes] = rng.choice(np.array(kinds, np.float32), holes.sum())
    inputs = (CAMERA, jnp.asarray(rocky().up_camera), jnp.asarray(disparity_px), jnp.float32(0.2))
    weights = rng.normal(size=(*BLOCKS, 6)).astype(np.float32)
    value, gradient = bent(inputs, weights)
    assert np.isfinite(value)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    if kinds is not None:
        assert np.asarray(gradient[2]).any() and np.asarray(gradient[1]).any()


def test_channels_are_bounded_and_last_comes_what_is_known():
    relief = relief_in(rocky())
    channels = np.asarray(relief_channels(relief))
    assert np.abs(channels).max() < 3
    np.testing.assert_array_equal(channels[..., -1], relief.known)
    assert not channels[~relief.known].any()
