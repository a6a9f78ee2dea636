"""Odometry on a camera that drives over a textured plane: the images are warps of one texture, the poses known."""

from functools import cache

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from odometry_scenes import CAMERA, HEIGHT_PX, WIDTH_PX, pair, pairs, poses
from scipy.spatial.transform import Rotation

from jaxmap.localisation.bundle import triangulate
from jaxmap.localisation.features import coarse_disparity_at, find_corners, follow, make_view, match_right
from jaxmap.localisation.odometry import StereoOdometry, Track

BLACK = (np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8),) * 2


def tracked(images, times_s=None) -> Track:
    odometry = StereoOdometry(CAMERA)
    for time_s, (left, right) in zip(range(len(images)) if times_s is None else times_s, images, strict=True):
        odometry.add(make_view(left, right), float(time_s))
    return odometry.track()


@cache
def drive(count: int = 8):
    return pairs(count)


def drift(track: Track, count: int = 8) -> tuple[float, float]:
    """Greatest error of position as a share of the path, and of attitude in degrees."""
    truth = poses(count)[track.frames]
    truth = np.linalg.inv(truth[0]) @ truth
    path_m = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    off = np.linalg.inv(truth) @ track.T_world_camera
    turned = Rotation.from_matrix(off[:, :3, :3]).magnitude()
    return np.linalg.norm(off[:, :3, 3], axis=1).max() / path_m, np.degrees(turned.max())


def test_a_drive_is_found_from_its_images():
    track = tracked(drive())
    assert track.frames.tolist() == list(range(8)) and not track.bridged
    share, turned_deg = drift(track)
    assert share < 0.01 and turned_deg < 0.3


def test_the_same_images_give_the_same_poses():
    np.testing.assert_array_equal(tracked(drive()).T_world_camera, tracked(drive()).T_world_camera)


def test_a_frame_that_shows_nothing_has_no_pose_and_the_next_ones_do():
    images = list(drive())
    images[3] = BLACK
    track = tracked(images)
    assert track.frames.tolist() == [0, 1, 2, 4, 5, 6, 7] and not track.bridged
    assert drift(track)[0] < 0.01


def test_the_first_frame_that_shows_something_begins():
    images = [BLACK, *drive()[1:]]
    track = tracked(images)
    assert track.frames.tolist() == list(range(1, 8))
    np.testing.assert_array_equal(track.T_world_camera[0], np.eye(4))


def test_other_exposures_change_nothing_much():
    images = [
        tuple(np.clip(image * (0.5 + index % 3 / 2), 0, 255).astype(np.uint8) for image in both)
        for index, both in enumerate(drive())
    ]
    track = tracked(images)
    assert len(track.frames) == 8 and drift(track)[0] < 0.01


def test_a_standing_camera_does_not_drift():
    track = tracked([drive()[0]] * 6)
    assert track.keyframes == 1 and track.moved_px < 0.5
    assert np.abs(track.T_world_camera - np.eye(4)).max() < 1e-3


LEAP = (0, 1, 2, 3, 26, 27, 28)


def leaping():
    T = poses(29)
    return [pair(T[index]) for index in LEAP]


def test_a_leap_that_no_frame_shows_is_bridged_at_the_speed_before_it():
    track = tracked(leaping())
    assert track.bridged == [4] and track.frames.tolist() == list(range(7))
    step_m = np.linalg.norm(np.diff(track.T_world_camera[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(step_m, 0.12, atol=0.02)


def test_over_too_long_a_time_nothing_is_made_up():
    track = tracked(leaping(), LEAP)
    assert track.frames.tolist() == [0, 1, 2, 3] and not track.bridged


def test_images_without_texture_are_no_views():
    assert make_view(*BLACK) is None
    assert make_view(np.full((HEIGHT_PX, WIDTH_PX), 255, np.uint8), drive()[0][1]) is None
    noise = np.random.default_rng(0).integers(0, 256, (8, 2, HEIGHT_PX, WIDTH_PX), np.uint8)
    assert len(tracked(noise).frames) <= 1


def test_points_are_found_in_the_right_image_to_a_tenth_of_a_pixel():
    view = make_view(*drive()[0])
    assert view is not None
    corners = find_corners(view, np.zeros((0, 2)), 200)
    right, seen = match_right(view, corners, coarse_disparity_at(view, corners))
    assert seen.mean() > 0.6
    T = poses(1)[0]
    points = triangulate(CAMERA, np.column_stack([corners, right])[seen])
    heights_m = points @ T[2, :3] + T[2, 3]
    sigma_m = 0.1 * points[:, 2] ** 2 / (CAMERA.fx_px * CAMERA.baseline_m)
    assert np.median(np.abs(heights_m) / sigma_m) < 1.0


def test_corners_spread_over_the_image_and_keep_away_from_known_ones():
    view = make_view(*drive()[0])
    assert view is not None
    first = find_corners(view, np.zeros((0, 2)), 100)
    more = find_corners(view, first[:30], 100)
    assert 60 <= len(first) <= 160
    assert len(np.unique((first // [80, 80]).astype(int), axis=0)) == 12
    assert np.linalg.norm(more[:, None] - first[None, :30], axis=-1).min() > 4


@given(shift=st.tuples(st.floats(-6, 6), st.floats(-6, 6)))
def test_a_shift_is_followed(shift):
    image = drive()[0][0]
    moved = cv2.warpAffine(image, np.array([[1, 0, shift[0]], [0, 1, shift[1]]]), (WIDTH_PX, HEIGHT_PX))
    pixels = np.array([[100.0, 120.0], [160.0, 100.0], [200.0, 140.0]])
    found, good = follow(image, moved, pixels, pixels, levels=2, window_px=21)
    assert good.all()
    np.testing.assert_allclose(found - pixels, np.tile(shift, (3, 1)), atol=0.1)


@pytest.mark.parametrize("missing", ["all", "next"])
def test_a_camera_that_sees_nothing_has_no_poses(missing):
    images = [BLACK] * 4 if missing == "all" else [drive()[0], BLACK, BLACK]
    assert len(tracked(images).frames) == (0 if missing == "all" else 1)
