from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import rngs

from jaxmap.errors import JaxmapError
from jaxmap.stereo.rectify import StereoRig, make_rectifier, make_stereo_rig, rectify_image, rectify_labels

SIZE_PX = (80, 60)
K = np.array([[70.0, 0, 40], [0, 71.0, 29], [0, 0, 1]])
RIG = dict(
    K_left=K,
    distortion_left=np.zeros(5),
    K_right=K,
    distortion_right=np.zeros(5),
    R_right_left=np.eye(3),
    t_right_left_m=np.array([-0.2, 0.0, 0.0]),
    size_px=SIZE_PX,
)


@st.composite
def rigs(draw: st.DrawFn) -> StereoRig:
    """Pairs that squint a little, with distorting lenses."""
    rng = draw(rngs())
    K_left, K_right = (K + np.diag([*rng.uniform(-2, 2, 2), 0]) for _ in range(2))
    return make_stereo_rig(
        **{
            **RIG,
            "K_left": K_left,
            "K_right": K_right,
            "distortion_left": np.array([*rng.uniform(-0.1, 0.1, 2), *rng.uniform(-2e-3, 2e-3, 2)]),
            "distortion_right": np.array([*rng.uniform(-0.1, 0.1, 2), *rng.uniform(-2e-3, 2e-3, 2), 0.0]),
            "R_right_left": cv2.Rodrigues(rng.uniform(-0.04, 0.04, 3))[0],
            "t_right_left_m": np.array([-draw(st.floats(0.05, 0.5)), *rng.uniform(-0.01, 0.01, 2)]),
        }
    )


def raw_place(maps: tuple[np.ndarray, np.ndarray], u: int, v: int) -> np.ndarray:
    """Where a rectified pixel lies in the raw image: fixed-point maps hold 32nds of a pixel."""
    whole, part = maps[0][v, u].astype(float), int(maps[1][v, u])
    return whole + np.array([part % 32, part // 32]) / 32


@given(rigs(), rngs())
def test_a_point_falls_on_one_row_with_the_disparity_of_its_depth(rig, rng):
    rectifier = make_rectifier(rig)
    camera = rectifier.camera
    for _ in range(8):
        u_px, v_px, disparity_px = int(rng.integers(30, 60)), int(rng.integers(15, 45)), int(rng.integers(2, 15))
        depth_m = float(camera.baseline_m) * float(camera.fx_px) / (disparity_px + float(camera.doffs_px))
        ray = [
            (u_px - float(camera.cx_px)) / float(camera.fx_px),
            (v_px - float(camera.cy_px)) / float(camera.fy_px),
            1,
        ]
        point_left = rectifier.R_rectified_left.T @ (depth_m * np.array(ray))
        point_right = rig.R_right_left @ point_left + rig.t_right_left_m
        at_rest = np.zeros(3)
        in_left, _ = cv2.projectPoints(point_left, at_rest, at_rest, rig.K_left, rig.distortion_left)
        in_right, _ = cv2.projectPoints(point_right, at_rest, at_rest, rig.K_right, rig.distortion_right)
        np.testing.assert_allclose(raw_place(rectifier.left_maps, u_px, v_px), in_left.ravel(), atol=0.03)
        right_place = raw_place(rectifier.right_maps, u_px - disparity_px, v_px)
        np.testing.assert_allclose(right_place, in_right.ravel(), atol=0.03)


@given(rigs())
def test_a_rectified_camera_keeps_its_baseline_and_size(rig):
    rectifier = make_rectifier(rig)
    np.testing.assert_allclose(rectifier.camera.baseline_m, np.linalg.norm(rig.t_right_left_m), rtol=1e-5)
    assert (rectifier.camera.width_px, rectifier.camera.height_px) == SIZE_PX
    R = rectifier.R_rectified_left
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert rectifier.seen.shape == (SIZE_PX[1], SIZE_PX[0])
    assert rectifier.seen.dtype == bool


def test_a_pair_that_is_rectified_already_is_left_alone():
    rectifier = make_rectifier(make_stereo_rig(**{**RIG, "K_left": np.diag([70.0, 70, 1]) + np.triu(K, 1)}))
    np.testing.assert_allclose(rectifier.R_rectified_left, np.eye(3), atol=1e-9)
    # Both scaled alike by OpenCV, if at all: the centre row stays a row.
    places = np.array([raw_place(rectifier.left_maps, u, 30) for u in range(0, 80, 10)])
    assert np.ptp(places[:, 1]) < 0.1


def test_labels_take_the_nearest_pixel_and_images_the_bilinear_mean():
    rig = make_stereo_rig(**RIG)
    shift = np.float32(np.meshgrid(np.arange(80) + 0.75, np.arange(60)))
    maps = cv2.convertMaps(shift[0], shift[1], cv2.CV_16SC2)
    columns = np.tile(np.arange(80, dtype=np.uint8), (60, 1))
    labels = rectify_labels(columns, maps, outside=255)
    np.testing.assert_array_equal(labels[:, :79], columns[:, 1:])
    assert np.all(labels[:, 79] == 255)
    image = rectify_image((columns * 2).astype(np.uint8), maps)
    np.testing.assert_allclose(image[30, :78].astype(int), 2 * np.arange(78) + 1.5, atol=0.5001)
    assert rig.width_px == 80


@given(rigs(), rngs())
def test_rectified_labels_are_labels_of_the_raw_image(rig, rng):
    raw = rng.choice(np.array([0, 1, 2], np.uint8), (60, 80))
    rectifier = make_rectifier(rig, alpha=1.0)
    labels = rectify_labels(raw, rectifier.left_maps, outside=255)
    assert set(np.unique(labels)) <= {0, 1, 2, 255}
    assert np.all(labels[rectifier.seen] != 255)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (dict(K_left=np.eye(4)), r"K_left has shape \(4, 4\), not \(3, 3\) in calibration"),
        (dict(K_right=K * [[-1], [1], [1]]), "K_right has a focal length that is not positive"),
        (dict(distortion_left=np.zeros(3)), "distortion_left has 3 coefficients in calibration; give k1 k2 p1 p2"),
        (dict(distortion_right=np.full(4, np.nan)), "distortion_right holds a number that is not finite"),
        (dict(R_right_left=2 * np.eye(3)), "R_right_left is not a rotation.*check the stereo extrinsics"),
        (dict(R_right_left=np.diag([1.0, 1, -1])), "R_right_left is not a rotation"),
        (dict(t_right_left_m=np.zeros(3)), "the stereo baseline is zero"),
        (dict(t_right_left_m=np.zeros(2)), r"t_right_left_m has shape \(2,\)"),
        (dict(size_px=(0, 60)), "size"),
    ],
)
def test_a_wrong_rig_is_refused_in_one_line(wrong, says):
    with pytest.raises(JaxmapError, match=says) as caught:
        make_stereo_rig(**{**RIG, **wrong})
    assert "\n" not in str(caught.value)


def test_cameras_that_are_swapped_or_stacked_are_refused():
    with pytest.raises(JaxmapError, match=r"baseline_m is -0.2.*left and right swapped"):
        make_rectifier(make_stereo_rig(**{**RIG, "t_right_left_m": np.array([0.2, 0.0, 0.0])}))
    with pytest.raises(JaxmapError, match=r"one above the other.*only horizontal pairs"):
        make_rectifier(make_stereo_rig(**{**RIG, "t_right_left_m": np.array([0.0, -0.2, 0.0])}))
