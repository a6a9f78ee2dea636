"""The front end on raw pairs: rows in line, true depth, points on the ground, labels by the nearest pixel."""

from __future__ import annotations

from functools import cache

import cv2
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from rigs import CAMERA, RIG
from scenes import (
    BACKGROUND,
    HEIGHT_PX,
    SAND,
    WIDTH_PX,
    SceneFrame,
    raw_frame,
    scene_frame,
)

from jaxmap.errors import FrameError, JaxmapError
from jaxmap.geometry.camera import disparity_to_points, transform_points
from jaxmap.labels import IGNORE
from jaxmap.stereo.front_end import RectifiedFrame, StereoFrontEnd
from jaxmap.stereo.match import StereoOptions


@cache
def rectified() -> tuple[StereoFrontEnd, SceneFrame, RectifiedFrame]:
    front_end, raw = StereoFrontEnd(RIG, StereoOptions(mode="hh")), raw_frame(RIG, 2)
    return front_end, raw, front_end(raw.left, raw.right)


def row_error_px(left: np.ndarray, right: np.ndarray) -> float:
    """Median vertical offset between the corners of the left image and where they are in the right one."""
    corners = cv2.goodFeaturesToTrack(left, 80, 0.02, 6)
    found, status, _ = cv2.calcOpticalFlowPyrLK(left, right, corners, None, winSize=(15, 15), maxLevel=3)
    offsets = (found - corners).reshape(-1, 2)[status.ravel() == 1]
    offsets = offsets[(offsets[:, 0] < 1) & (offsets[:, 0] > -25)]
    assert len(offsets) > 20
    return float(np.median(np.abs(offsets[:, 1])))


def world_points(front_end: StereoFrontEnd, raw: SceneFrame, disparity_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    points_camera, valid = disparity_to_points(front_end.camera, jnp.asarray(disparity_px))
    pose = jaxlie.SE3.from_matrix(jnp.asarray(raw.T_world_camera @ front_end.T_raw_rectified, jnp.float32))
    near = np.asarray(valid) & (np.asarray(points_camera)[..., 2] < 3.0)
    return np.asarray(transform_points(pose, points_camera)), near


def test_rectified_images_are_row_aligned():
    _, raw, frame = rectified()
    assert row_error_px(raw.left, raw.right) > 1.0
    assert row_error_px(frame.left, frame.right) < 0.2


def test_a_raw_pair_gives_points_on_the_ground():
    front_end, raw, frame = rectified()
    labels = front_end.rectify_labels(raw.labels)
    points, near = world_points(front_end, raw, frame.disparity_px)
    ground = near & (labels == SAND)
    assert ground.sum() > 3000
    assert np.median(np.abs(points[ground][:, 2])) < 0.015
    assert abs(np.median(points[ground][:, 2])) < 0.01
    # Without the turn from rectified to raw the ground would lie askew.
    wrong = raw.T_world_camera @ np.linalg.inv(front_end.T_raw_rectified)
    assert np.abs(wrong - raw.T_world_camera @ front_end.T_raw_rectified).max() > 0.02


def test_a_raw_pair_gives_the_true_depth():
    """The depth of the rectified camera, from the raw truth: along each rectified ray the ground is met at z = 0."""
    front_end, raw, frame = rectified()
    T = raw.T_world_camera @ front_end.T_raw_rectified
    v_px, u_px = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    camera = front_end.camera
    rays = np.stack(
        [
            (u_px - float(camera.cx_px)) / float(camera.fx_px),
            (v_px - float(camera.cy_px)) / float(camera.fy_px),
            np.ones_like(u_px),
        ],
        axis=-1,
    )
    down = (rays @ T[:3, :3].T)[..., 2]
    with np.errstate(divide="ignore"):
        depth_m = np.where(down < 0, -T[2, 3] / down, np.inf)
    disparity_px = float(camera.baseline_m) * float(camera.fx_px) / depth_m - float(camera.doffs_px)
    ground = (front_end.rectify_labels(raw.labels) == SAND) & np.isfinite(frame.disparity_px) & (depth_m < 4)
    error_px = np.abs(frame.disparity_px - disparity_px)[ground]
    assert np.median(error_px) < 0.3


def test_outside_the_raw_image_nothing_is_known():
    raw = raw_frame(RIG, 0)
    front_end = StereoFrontEnd(RIG, StereoOptions(alpha=1.0))
    assert front_end.rectifier is not None
    outside = ~front_end.rectifier.seen
    assert outside.mean() > 0.01
    frame = front_end(raw.left, raw.right)
    assert np.isnan(frame.disparity_px[outside]).all()
    labels = front_end.rectify_labels(np.full((HEIGHT_PX, WIDTH_PX), SAND, np.uint8))
    assert set(np.unique(labels)) == {SAND, IGNORE}
    assert (labels[front_end.rectifier.seen] == SAND).all()
    ones = front_end.rectify_labels(np.ones((HEIGHT_PX, WIDTH_PX, 3), np.float32))
    assert ones.shape == (HEIGHT_PX, WIDTH_PX, 3)
    np.testing.assert_allclose(ones[front_end.rectifier.seen], 1, atol=1e-5)
    assert ones[labels == IGNORE].max() < 0.51


def test_labels_take_the_nearest_pixel():
    front_end, raw, _ = rectified()
    labels = front_end.rectify_labels(raw.labels)
    # No class is invented between two others.
    assert set(np.unique(labels)) <= {*np.unique(raw.labels), IGNORE}
    soft = front_end.rectify_labels(np.eye(3, dtype=np.float32)[raw.labels])
    inside = (labels != IGNORE) & (soft.max(axis=2) > 0.6)
    assert (soft.argmax(axis=2) == labels)[inside].mean() > 0.995


def test_rectified_images_and_labels_pass_untouched():
    frame = scene_frame(0)
    front_end = StereoFrontEnd(CAMERA, StereoOptions())
    result = front_end(frame.left, frame.right)
    np.testing.assert_array_equal(result.left, frame.left)
    np.testing.assert_array_equal(result.right, frame.right)
    np.testing.assert_array_equal(front_end.T_raw_rectified, np.eye(4))
    np.testing.assert_array_equal(front_end.rectify_labels(frame.labels), frame.labels)
    solid = frame.labels != BACKGROUND
    assert np.nanmedian(np.abs(result.disparity_px - frame.disparity_px)[solid]) < 0.3


def test_the_order_of_the_cameras_is_checked():
    frame = scene_frame(0)
    front_end = StereoFrontEnd(CAMERA, StereoOptions())
    front_end.check_order(front_end(frame.left, frame.right))
    with pytest.raises(JaxmapError, match="left and right look swapped") as caught:
        front_end.check_order(front_end(frame.right, frame.left))
    # One bad frame is passed over; swapped cameras must stop the run.
    assert not isinstance(caught.value, FrameError)


@pytest.mark.parametrize("side", ["left", "right"])
def test_an_image_of_another_size_is_refused(side):
    frame = scene_frame(0)
    images = {"left": frame.left, "right": frame.right}
    images[side] = images[side][:100]
    with pytest.raises(FrameError, match=f"the {side} image is 160x100 px, the calibration says 160x120 px"):
        StereoFrontEnd(CAMERA, StereoOptions())(images["left"], images["right"])
