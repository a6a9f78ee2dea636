"""What is nearer than the searched disparities reach is left out; where nothing is, nothing is left out."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from rigs import CAMERA as SCENE_CAMERA
from scenes import scene_frame

from jaxmap.errors import FrameError
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import StereoOptions
from jaxmap.types import make_stereo_camera

HEIGHT_PX, WIDTH_PX, NEAR_PX = 240, 320, 70
CAMERA = make_stereo_camera(
    fx_px=250.0, cx_px=159.5, cy_px=119.5, baseline_m=0.2, width_px=WIDTH_PX, height_px=HEIGHT_PX
)


def near_pair(rows: slice) -> tuple[np.ndarray, np.ndarray]:
    """A textured wall of 10 px of disparity, and one of 70 px before it in some rows; 48 px are searched."""
    rng = np.random.default_rng(3)
    far, near = (cv2.GaussianBlur(rng.normal(size=(HEIGHT_PX, 500)), (0, 0), 1.2) for _ in range(2))
    left, right = far[:, 10 : 10 + WIDTH_PX].copy(), far[:, 20 : 20 + WIDTH_PX].copy()
    left[rows], right[rows] = near[rows, 10 : 10 + WIDTH_PX], near[rows, 10 + NEAR_PX : 10 + NEAR_PX + WIDTH_PX]
    return tuple(cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8) for image in (left, right))


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_false_matches_on_what_is_too_near_are_left_out(share):
    rows = slice(int((1 - share) * HEIGHT_PX), HEIGHT_PX)
    pair = near_pair(rows)
    unguarded = StereoFrontEnd(CAMERA, StereoOptions(near_guard=False))(*pair)
    guarded = StereoFrontEnd(CAMERA, StereoOptions())(*pair)
    assert np.isfinite(unguarded.disparity_px[rows]).mean() > 0.1
    assert np.isfinite(guarded.disparity_px[rows]).mean() < 0.02
    assert guarded.too_near == pytest.approx(share, abs=0.1)
    assert guarded.nearest_px == pytest.approx(NEAR_PX, abs=2)
    # What can be seen is as it was.
    far = slice(0, rows.start - 24) if rows.start else slice(0, 0)
    np.testing.assert_array_equal(guarded.disparity_px[far], unguarded.disparity_px[far])
    seen = StereoFrontEnd(CAMERA, StereoOptions(num_disparities=80))(*pair)
    assert seen.too_near == 0
    assert np.nanmedian(seen.disparity_px[rows]) == pytest.approx(NEAR_PX, abs=0.5)


def test_a_near_wall_is_not_taken_for_swapped_images():
    front_end = StereoFrontEnd(CAMERA, StereoOptions())
    left, right = near_pair(slice(0, HEIGHT_PX))
    front_end.check_order(front_end(left, right))


def test_nothing_is_left_out_of_a_scene_within_reach():
    frame = scene_frame(0)
    pairs = [
        StereoFrontEnd(SCENE_CAMERA, StereoOptions(near_guard=guard))(frame.left, frame.right)
        for guard in (True, False)
    ]
    np.testing.assert_array_equal(pairs[0].disparity_px, pairs[1].disparity_px)
    assert pairs[0].too_near == 0


@pytest.mark.parametrize(("level", "word"), [(3, "black"), (254, "white"), (90, "of one grey")])
@pytest.mark.parametrize("side", ["left", "right"])
def test_an_image_that_shows_nothing_is_refused_by_name(side, level, word):
    images = dict(zip(("left", "right"), near_pair(slice(0, 0)), strict=True))
    images[side] = np.full_like(images[side], level)
    with pytest.raises(FrameError, match=f"the {side} image is {word}.* cannot be matched"):
        StereoFrontEnd(CAMERA, StereoOptions())(images["left"], images["right"])
