"""The rotation of the right camera is found from matches, whatever the outliers, and makes rows agree."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rigs import RIG
from scenes import raw_frame, scene_frame
from scipy.spatial.transform import Rotation

from jaxmap.stereo.align import alignment_homography, estimate_alignment, match_features, rotate_right
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import StereoOptions
from jaxmap.stereo.rectify import make_stereo_rig
from jaxmap.types import make_stereo_camera

CAMERA = make_stereo_camera(fx_px=600.0, cx_px=500.0, cy_px=380.0, baseline_m=0.15, width_px=1000, height_px=760)
ANGLES = st.floats(-0.02, 0.02)


def matches_of(rotation_rad: np.ndarray, seed: int, outliers: float = 0.3, farthest_m: float = 60.0) -> np.ndarray:
    """Matches of points before a pair whose right camera needs that rotation to be as it is said to be."""
    rng = np.random.default_rng(seed)
    left = rng.uniform((0, 0), (1000, 760), (400, 2))
    depth_m = 1 / rng.uniform(1 / farthest_m, 1 / 1.5, 400)
    right = left - np.column_stack([600 * 0.15 / depth_m, np.zeros(400)])
    right = rotate_right(CAMERA, -rotation_rad, right) + rng.normal(0, 0.2, (400, 2))
    wrong = rng.random(400) < outliers
    right[wrong] = rng.uniform((0, 0), (1000, 760), (int(wrong.sum()), 2))
    return np.concatenate([left, right], axis=1)


@given(about_x=ANGLES, about_z=ANGLES, seed=st.integers(0, 2**16))
def test_rotations_about_the_baseline_and_the_optical_axis_are_found(about_x, about_z, seed):
    rotation = np.array([about_x, 0.0, about_z])
    found = estimate_alignment(CAMERA, matches_of(rotation, seed))
    assert found is not None
    np.testing.assert_allclose(found.rotation_rad, rotation, atol=4e-4)
    assert 0.6 < found.inliers.mean() < 0.9
    assert np.median(np.abs(found.row_residual_px[found.inliers])) < 0.3


def test_points_behind_infinity_turn_the_right_camera_about_the_vertical():
    rotation = np.array([0.003, -0.01, -0.004])
    found = estimate_alignment(CAMERA, matches_of(rotation, 0, farthest_m=1e4))
    assert found is not None
    np.testing.assert_allclose(found.rotation_rad, rotation, atol=2.5e-3)
    # A camera that diverges puts far points too near, which nothing in a pair tells.
    found = estimate_alignment(CAMERA, matches_of(-rotation, 0, farthest_m=1e4))
    assert found is not None and found.rotation_rad[1] == 0


def test_few_matches_tell_nothing():
    assert estimate_alignment(CAMERA, matches_of(np.zeros(3), 0)[:10]) is None
    assert estimate_alignment(CAMERA, np.random.default_rng(0).uniform(0, 700, (25, 4))) is None


def test_the_homography_is_that_of_a_rotation():
    H = alignment_homography(CAMERA, np.array([0.0, 0.0, np.pi / 2]))
    np.testing.assert_allclose(H @ [600.0, 380.0, 1.0], [500.0, 480.0, 1.0], atol=1e-9)


@pytest.mark.parametrize("shrink", [1, 2])
def test_features_of_a_rectified_pair_lie_on_one_row(shrink):
    frame = scene_frame(0)
    matches = match_features(frame.left, frame.right, shrink)
    assert len(matches) > 30
    assert np.median(np.abs(matches[:, 3] - matches[:, 1])) < 0.2 * shrink
    columns, rows = np.rint(matches[:, :2]).astype(int).T
    error_px = matches[:, 0] - matches[:, 2] - frame.disparity_px[rows, columns]
    assert np.median(np.abs(error_px)) < 0.3 * shrink


def test_images_without_features_match_nothing():
    flat = np.full((60, 80), 90, np.uint8)
    assert match_features(flat, flat).shape == (0, 4)
    assert match_features(flat, np.stack([flat] * 3, axis=-1)).shape == (0, 4)


def test_a_raw_rig_whose_calibration_is_off_is_aligned():
    turned = np.array([0.006, 0.0, -0.008])
    R = Rotation.from_rotvec(turned).as_matrix() @ RIG.R_right_left
    numbers = {name: getattr(RIG, name) for name in ("K_left", "distortion_left", "K_right", "distortion_right")}
    off = make_stereo_rig(
        **numbers, R_right_left=R, t_right_left_m=RIG.t_right_left_m, size_px=(RIG.width_px, RIG.height_px)
    )
    raw = raw_frame(RIG, 2)
    front_end = StereoFrontEnd(off, StereoOptions())
    before = match_features(*front_end.rectify(raw.left, raw.right))
    found = estimate_alignment(front_end.camera, before)
    assert found is not None
    aligned = StereoFrontEnd(off, StereoOptions(), found.rotation_rad)
    after = match_features(*aligned.rectify(raw.left, raw.right))
    errors = [float(np.median(np.abs(rows[:, 3] - rows[:, 1]))) for rows in (before, after)]
    assert errors[0] > 0.6 and errors[1] < 0.2
