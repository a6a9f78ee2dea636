"""Laws of linearisation: rows match, depth follows from disparity, and what a plane cannot hold is told."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxmap.errors import JaxmapError
from jaxmap.geometry.cahv import CahvModel, make_cahv_model
from jaxmap.stereo.linearise import linearise

SIZE_PX = (320, 240)
DOWN_TO_CAMERA = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""R_rover_camera of a camera that looks along the rover's x (forward, right, down)."""


def eye(side_m: float, turn=(0.0, 0.0, 0.0), focal_px=230.0, R=(0, 0.1, 0.02), E=(0, 0, 0), kind: int = 1) -> CahvModel:
    x, y, z = (DOWN_TO_CAMERA @ Rotation.from_rotvec(turn).as_matrix()).T
    H, V = focal_px * x + 160.2 * z, focal_px * y + 118.9 * z
    return make_cahv_model([[0.5, side_m, -1.4], z, H, V, z, R, E], kind)


angles = st.floats(-0.03, 0.03)


@settings(max_examples=30)
@given(st.tuples(angles, angles, angles), st.tuples(angles, angles, angles))
def test_rows_match_and_disparity_is_depth(turn_left, turn_right):
    pair = linearise(eye(-0.15, turn_left), eye(0.15, turn_right, focal_px=233), SIZE_PX)
    camera, (focal_px, cx_px, cy_px, *_) = pair.camera, pair.view
    assert camera.baseline_m == pytest.approx(0.3)
    pixels, depth_m = np.array([[40.0, 30.0], [160.0, 200.0], [300.0, 100.0]]), np.array([[1.0], [3.0], [20.0]])
    ahead = depth_m * np.column_stack([(pixels - [cx_px, cy_px]) / focal_px, np.ones(3)])
    points = ahead @ pair.T_frame_left[:3, :3].T + pair.T_frame_left[:3, 3]
    disparity_px = np.column_stack([0.3 * focal_px / depth_m, np.zeros(3)])
    np.testing.assert_allclose(pair.left.project(points), pair.raw_pixels(pair.left, pixels), atol=1e-6)
    np.testing.assert_allclose(
        pair.right.project(points), pair.raw_pixels(pair.right, pixels - disparity_px), atol=1e-6
    )
    assert pair.residual_px() < 1e-6


@pytest.mark.parametrize("kind", [1, 2])
def test_every_rectified_pixel_is_seen_by_both_eyes(kind):
    focal_px = 230 if kind == 1 else 140
    pair = linearise(
        eye(-0.15, (0, 0.01, 0), focal_px, kind=kind), eye(0.15, (0.01, -0.02, 0.01), focal_px, kind=kind), SIZE_PX
    )
    for model in (pair.left, pair.right):
        x, y = pair.maps(model)
        assert x.min() >= 0 and x.max() <= SIZE_PX[0] - 1
        assert y.min() >= 0 and y.max() <= SIZE_PX[1] - 1
    # No coarser than the raw image in its middle.
    assert pair.view.focal_px >= focal_px * 0.99


def test_a_pair_that_is_linear_and_aligned_stays_as_it_is():
    left, right = (eye(side_m, R=(0, 0, 0)) for side_m in (-0.1, 0.1))
    pair = linearise(left, right, SIZE_PX)
    assert pair.view.focal_px == pytest.approx(230, rel=0.01)
    # The margin of one px on each side.
    x, y = pair.maps(left)
    np.testing.assert_allclose(x[10], np.arange(320), atol=1.5)
    np.testing.assert_allclose(y[:, 10], np.arange(240), atol=1.5)
    np.testing.assert_allclose(pair.T_frame_left[:3, :3], DOWN_TO_CAMERA, atol=1e-12)


def test_a_moving_pupil_leaves_a_residual():
    E = (0.02, 0.02, 0.0)
    pair = linearise(eye(-0.1, E=E, kind=2, focal_px=140), eye(0.1, E=E, kind=2, focal_px=140), SIZE_PX)
    # At 45 degrees the pupil moves by (theta / sin - 1) (e0 + e1 theta^2) = 3.6 mm, at 1 m seen under 45 degrees.
    assert 0.1 < pair.residual_px() < 1


def test_a_part_of_the_detector_is_linearised_too():
    """A tile far off the axis, as of Mars 2020's Navcam."""
    left, right = (eye(side_m, focal_px=140, kind=2).cropped((200, 20)) for side_m in (-0.1, 0.1))
    pair = linearise(left, right, (100, 90))
    for model in (left, right):
        x, y = pair.maps(model)
        assert min(x.min(), y.min()) >= 0 and x.max() <= 99 and y.max() <= 89


@pytest.mark.parametrize(
    ("left", "right", "says"),
    [
        (eye(0.1), eye(-0.1), "left of the left"),
        (eye(0.1), eye(0.1), "baseline is zero"),
        (eye(0.0, turn=(0, 0, 1.6)), eye(0.1, turn=(0, 0, 1.6)), "side by side"),
        (eye(-0.1), eye(0.1, turn=(0, 1.5, 0)), "nothing in common"),
    ],
)
def test_what_makes_no_pair_is_refused(left, right, says):
    with pytest.raises(JaxmapError, match=says):
        linearise(left, right, SIZE_PX)
