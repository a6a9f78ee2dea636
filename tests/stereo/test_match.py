"""The matcher on the small scene: true disparities, options that do what they say, faults by name."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scenes import BACKGROUND, HEIGHT_PX, WIDTH_PX, scene_frame

from jaxmap.errors import FrameError, JaxmapError, UsageError
from jaxmap.stereo.match import Matcher, StereoOptions

MODES = ("3way", "sgbm", "hh", "hh4")


SMALL = dict(block_size=5, p1=200, p2=800, edge_step_px=0.0)
"""Blocks and penalties for an image of a few thousand pixels, edges and all."""


def matched(index: int = 0, **options: object) -> np.ndarray:
    frame = scene_frame(index)
    return Matcher(StereoOptions(**SMALL | options), WIDTH_PX)(frame.left, frame.right)


def valid(disparity_px: np.ndarray) -> float:
    return float(np.isfinite(disparity_px).mean())


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("index", [0, 5])
def test_every_mode_finds_the_true_disparity(mode, index):
    frame = scene_frame(index)
    disparity_px = matched(index, mode=mode)
    assert disparity_px.dtype == np.float32
    assert disparity_px.shape == (HEIGHT_PX, WIDTH_PX)
    error_px = np.abs(disparity_px - frame.disparity_px)[frame.labels != BACKGROUND]
    assert np.nanmedian(error_px) < 0.3
    assert np.nanmean(error_px > 2) < 0.05
    assert valid(disparity_px) > 0.9


def test_disparities_are_sixteenths_and_none_is_below_the_smallest():
    disparity_px = matched(min_disparity_px=3)
    known = disparity_px[np.isfinite(disparity_px)]
    np.testing.assert_array_equal(known * 16, np.rint(known * 16))
    assert known.min() >= 3
    assert valid(disparity_px) < valid(matched())


def test_the_sky_has_no_disparity_to_speak_of():
    frame = scene_frame(0)
    assert np.nanmedian(np.abs(matched()[frame.labels == BACKGROUND])) < 0.3


@pytest.mark.parametrize("mode", MODES)
def test_the_left_right_check_drops_what_only_one_camera_sees(mode):
    frame = scene_frame(5)
    checked = matched(5, mode=mode, left_right_max_diff_px=1, speckle_window=0)
    loose = matched(5, mode=mode, left_right_max_diff_px=30, speckle_window=0)
    assert valid(checked) < valid(loose)
    solid = frame.labels != BACKGROUND
    wrong = [np.nanmean(np.abs(d - frame.disparity_px)[solid] > 2) for d in (checked, loose)]
    assert wrong[0] < wrong[1]


def test_the_left_right_check_can_be_turned_off():
    """OpenCV takes every number below 1 for 1."""
    off = matched(5, left_right_max_diff_px=-1, speckle_window=0)
    assert valid(off) >= valid(matched(5, left_right_max_diff_px=30, speckle_window=0))


@pytest.mark.parametrize(("name", "value", "taken"), [("left_right_max_diff_px", 0, 1), ("pre_filter_cap", 4, 15)])
def test_no_option_is_changed_silently(name, value, taken):
    try:
        given = matched(5, **{name: value})
    except JaxmapError as error:
        assert name in str(error)
    else:
        assert not np.array_equal(given, matched(5, **{name: taken}), equal_nan=True)


def test_more_uniqueness_is_asked_fewer_matches_are_left():
    shares = [valid(matched(uniqueness_ratio=ratio, speckle_window=0)) for ratio in (0, 10, 40, 80)]
    assert shares == sorted(shares, reverse=True)
    assert shares[-1] < shares[0] - 0.1


def test_small_blobs_are_speckles():
    frame = scene_frame(5)
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT_PX, WIDTH_PX), dtype=np.uint8)
    options = SMALL | dict(uniqueness_ratio=0, left_right_max_diff_px=-1)
    without, with_filter = (
        Matcher(StereoOptions(**options, speckle_window=window), WIDTH_PX)(frame.left, noise) for window in (0, 200)
    )
    assert valid(with_filter) < 0.7 * valid(without)


@pytest.mark.parametrize(("size", "window"), [((300, 400), 150), ((60, 80), 100)])
def test_speckles_are_by_default_an_800th_of_the_image(size, window):
    pair = np.random.default_rng(0).integers(0, 256, (2, *size), dtype=np.uint8)
    options = SMALL | dict(num_disparities=32, uniqueness_ratio=0, left_right_max_diff_px=-1)
    by_default, same, smaller = (
        Matcher(StereoOptions(**options, speckle_window=chosen), size[1])(*pair) for chosen in (None, window, 20)
    )
    np.testing.assert_array_equal(by_default, same)
    assert valid(by_default) < valid(smaller)


def test_padding_matches_the_leftmost_columns_too():
    padded, plain = matched(pad_left=True), matched(pad_left=False)
    assert padded.shape == plain.shape == (HEIGHT_PX, WIDTH_PX)
    count = Matcher(StereoOptions(), WIDTH_PX).num_disparities
    assert np.isnan(plain[:, :count]).all()
    # The right camera does not see what the first few columns show.
    assert valid(padded[:, 16:count]) > 0.9
    frame = scene_frame(0)
    error_px = np.abs(padded - frame.disparity_px)[:, 16:count][frame.labels[:, 16:count] != BACKGROUND]
    assert np.nanmedian(error_px) < 0.3
    both = np.isfinite(padded) & np.isfinite(plain)
    assert (np.abs(padded - plain)[both] < 0.5).mean() > 0.98


@pytest.mark.parametrize("least_px", [0, -16])
def test_pixels_near_a_step_of_disparity_are_dropped_and_no_others(least_px):
    every = matched(5, min_disparity_px=least_px)
    size, step_px = 5, 2.0
    left = matched(5, min_disparity_px=least_px, edge_window_px=size, edge_step_px=step_px)
    padded = np.pad(every, size // 2, constant_values=np.nan)
    near = np.lib.stride_tricks.sliding_window_view(padded, (size, size)).reshape(*every.shape, -1)
    known = np.isfinite(near).any(axis=-1)
    spread_px = np.zeros(every.shape)
    spread_px[known] = np.nanmax(near[known], axis=-1) - np.nanmin(near[known], axis=-1)
    np.testing.assert_array_equal(left, np.where(spread_px > step_px, np.nan, every))
    assert 0.5 < valid(left) / valid(every) < 1


def test_the_number_of_disparities_bounds_them():
    assert Matcher(StereoOptions(), 160).num_disparities == 32
    assert Matcher(StereoOptions(), 1226).num_disparities == 160
    few = matched(5, num_disparities=16)
    assert np.nanmax(few) < 16
    frame = scene_frame(5)
    near = frame.disparity_px > 17
    error_px = np.abs(matched(5) - frame.disparity_px)[near]
    assert near.sum() > 100
    assert np.nanmedian(error_px) < 0.5


def test_colour_is_matched_by_its_luma():
    frame = scene_frame(0)
    matcher = Matcher(StereoOptions(), WIDTH_PX)
    colour = matcher(*(np.repeat(image[..., None], 3, axis=2) for image in (frame.left, frame.right)))
    np.testing.assert_array_equal(colour, matcher(frame.left, frame.right))


def test_threads_do_not_disturb_each_other():
    matcher = Matcher(StereoOptions(), WIDTH_PX)
    frames = [scene_frame(index % 6) for index in range(12)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda frame: matcher(frame.left, frame.right), frames))
    for frame, disparity_px in zip(frames, together, strict=True):
        np.testing.assert_array_equal(disparity_px, matcher(frame.left, frame.right))


def test_the_images_are_left_as_they_are():
    frame = scene_frame(0)
    left, right = frame.left.copy(), frame.right.copy()
    Matcher(StereoOptions(), WIDTH_PX)(left, right)
    np.testing.assert_array_equal(left, frame.left)
    np.testing.assert_array_equal(right, frame.right)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (dict(num_disparities=20), "num_disparities is 20"),
        (dict(block_size=4), "block_size is 4"),
        (dict(num_disparities=160, pad_left=False), "160 disparities in images 160 px wide"),
        (dict(num_disparities=144, min_disparity_px=16, pad_left=False), "144 disparities"),
        (dict(p1=500, p2=500), "p1 is 500 and p2 is 500"),
        (dict(p1=4000), "p1 is 4000 and p2 is 3136"),
    ],
)
def test_options_that_cannot_be_are_refused_by_name(options, named):
    with pytest.raises(JaxmapError, match=named) as caught:
        Matcher(StereoOptions(**options), WIDTH_PX)
    assert "; " in str(caught.value)


@pytest.mark.parametrize("options", [dict(num_disparities=-16), dict(block_size=0), dict(p1=0), dict(mode="best")])
def test_options_out_of_bounds_are_refused_by_name(options):
    with pytest.raises(UsageError, match=f"stereo.{next(iter(options))} is"):
        StereoOptions(**options)


def test_images_of_two_sizes_are_refused():
    frame = scene_frame(0)
    with pytest.raises(FrameError, match="160x120 and the right one 160x100"):
        Matcher(StereoOptions(), WIDTH_PX)(frame.left, frame.right[:100])


@pytest.mark.parametrize("index", [0, 5])
def test_swapped_images_are_noticed(index):
    frame = scene_frame(index)
    matcher = Matcher(StereoOptions(), WIDTH_PX)
    assert not matcher.looks_swapped(frame.left, frame.right, matcher(frame.left, frame.right))
    assert matcher.looks_swapped(frame.right, frame.left, matcher(frame.right, frame.left))


def test_a_pair_without_texture_is_not_taken_for_swapped():
    flat = np.full((HEIGHT_PX, WIDTH_PX), 90, np.uint8)
    matcher = Matcher(StereoOptions(), WIDTH_PX)
    assert not matcher.looks_swapped(flat, flat, matcher(flat, flat))
