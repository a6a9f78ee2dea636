"""Bands of rows: together they are the image, and each searches what small images show there and little else."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmap.stereo.bands import MARGIN_PX, search_bands
from jaxmap.stereo.coarse import Coarse
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import Matcher, StereoOptions
from jaxmap.types import make_stereo_camera

HEIGHT_PX, WIDTH_PX, DISPARITIES = 384, 448, 96
CAMERA = make_stereo_camera(
    fx_px=350.0, cx_px=223.5, cy_px=191.5, baseline_m=0.2, width_px=WIDTH_PX, height_px=HEIGHT_PX
)


def slope_pair() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A textured slope, nearer in each row than in the one above, and its disparity."""
    texture = cv2.GaussianBlur(np.random.default_rng(5).normal(size=(HEIGHT_PX, 700)), (0, 0), 1.2)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    disparity_px = 4 + np.arange(HEIGHT_PX) // 6
    left = texture[:, 100 : 100 + WIDTH_PX]
    right = np.stack(
        [row[100 + shift : 100 + shift + WIDTH_PX] for row, shift in zip(texture, disparity_px, strict=True)]
    )
    return left, right, np.repeat(disparity_px[:, None], WIDTH_PX, axis=1)


@given(st.integers(0, 2**32 - 1), st.sampled_from([-32, 0, 8]), st.sampled_from([16, 48, 96]), st.integers(7, 400))
@settings(max_examples=60)
def test_bands_are_the_image_and_hold_what_was_seen(seed, least_px, count, height_px):
    rng = np.random.default_rng(seed)
    matcher = Matcher(StereoOptions(min_disparity_px=least_px, num_disparities=count), 640)
    shrink = int(rng.integers(2, 5))
    levels_px = rng.uniform(least_px, least_px + count, size=(max(height_px // shrink, 1), 1))
    disparity_px = np.where(rng.random((len(levels_px), 20)) < rng.uniform(0.2, 1), levels_px, np.nan)
    bands = search_bands(Coarse(disparity_px, shrink), matcher, height_px)
    assert [band.first for band in bands] == [0, *(band.end for band in bands[:-1])]
    assert bands[-1].end == height_px
    for band in bands:
        assert band.disparities % 16 == 0
        assert least_px <= band.least_px
        assert 16 <= band.disparities <= least_px + count - band.least_px
        there = disparity_px[-(-band.first // shrink) : band.end // shrink]
        margin_px = MARGIN_PX * shrink
        if np.isfinite(there).any():
            assert band.least_px <= max(np.nanmin(there) - margin_px, least_px)
            assert band.least_px + band.disparities >= min(np.nanmax(there) + margin_px, least_px + count)
        if np.isfinite(there).mean() < 0.3:
            assert (band.least_px, band.disparities) == (least_px, count)


def test_the_same_is_found_with_a_fraction_of_the_disparities():
    left, right, truth_px = slope_pair()
    options = {"num_disparities": DISPARITIES}
    narrow, whole = (
        StereoFrontEnd(CAMERA, StereoOptions(**options, narrow=narrow))(left, right) for narrow in (True, False)
    )
    assert not whole.bands
    assert narrow.disparity_px is not None and whole.disparity_px is not None
    searched = sum((band.end - band.first) * band.disparities for band in narrow.bands)
    assert searched < 0.7 * HEIGHT_PX * DISPARITIES
    found = [np.isfinite(one.disparity_px) for one in (narrow, whole)]
    assert found[0].mean() > max(found[1].mean() - 0.01, 0.8)
    for one, known in zip((narrow, whole), found, strict=True):
        assert (np.abs(one.disparity_px - truth_px)[known] < 1).mean() > 0.99
    both = found[0] & found[1]
    assert (np.abs(narrow.disparity_px - whole.disparity_px)[both] < 0.25).mean() > 0.99


def test_a_thin_pole_on_the_ground_is_seen_as_ever():
    ground, pole = slice(240, HEIGHT_PX), slice(60, 240)
    rng, width, near_px = np.random.default_rng(2), 12, 50
    textures = [cv2.GaussianBlur(rng.normal(size=(HEIGHT_PX, 700)), (0, 0), 1.2) for _ in range(2)]
    back, front = (cv2.normalize(one, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8) for one in textures)
    left, right = back[:, 100 : 100 + WIDTH_PX].copy(), back[:, 110 : 110 + WIDTH_PX].copy()
    left[ground] = front[ground, 100 : 100 + WIDTH_PX]
    right[ground] = front[ground, 100 + near_px : 100 + near_px + WIDTH_PX]
    left[pole, 200 : 200 + width] = right[pole, 200 - near_px : 200 - near_px + width] = front[pole, :width]
    options = {"num_disparities": DISPARITIES}
    narrow, whole = (
        StereoFrontEnd(CAMERA, StereoOptions(**options, narrow=narrow))(left, right) for narrow in (True, False)
    )
    assert sum((band.end - band.first) * band.disparities for band in narrow.bands) < 0.7 * HEIGHT_PX * DISPARITIES
    there, as_ever = (one.disparity_px[80:220, 200 : 200 + width] for one in (narrow, whole))
    assert (np.abs(there - near_px) < 1.5).mean() > (np.abs(as_ever - near_px) < 1.5).mean() - 0.02 > 0.2


def test_where_small_images_show_nothing_everything_is_searched():
    matcher = Matcher(StereoOptions(num_disparities=DISPARITIES), WIDTH_PX)
    unknown = Coarse(np.full((HEIGHT_PX // 2, WIDTH_PX // 2), np.nan), 2)
    assert search_bands(unknown, matcher, HEIGHT_PX) == (matcher.band(0, HEIGHT_PX),)
    left, right, _ = slope_pair()
    np.testing.assert_array_equal(matcher(left, right, [matcher.band(0, HEIGHT_PX)]), matcher(left, right))


@pytest.mark.parametrize("options", [{"mode": "hh", "narrow": True}, {}, {"matcher": "sgm"}])
def test_only_the_mode_whose_paths_are_short_is_matched_in_bands(options):
    left, right, _ = slope_pair()
    assert StereoFrontEnd(CAMERA, StereoOptions(**options)).ready(left, right).bands == ()


def test_what_small_images_cannot_reach_is_searched_everywhere():
    left, right, _ = slope_pair()
    assert StereoFrontEnd(CAMERA, StereoOptions(num_disparities=400, narrow=True)).ready(left, right).bands == ()
