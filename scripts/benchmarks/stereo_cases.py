"""Rectification, matching and projection: what comes before the map, growing with the pixels."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import reference

from benchmarks import ours, peers
from benchmarks.groups import Group
from benchmarks.harness import Amount, Case, Peer, Run
from benchmarks.scene import DISPARITIES, Scene, make_scene
from jaxmap.datasets.calibration import read_camera_yaml
from jaxmap.host.files import config_folder
from jaxmap.stereo.match import Matcher, StereoOptions
from jaxmap.stereo.rectify import StereoRig, make_rectifier, make_stereo_rig, rectify_image


def rectify(size: str) -> Case:
    """Both images by the LocCam's calibration, against OpenCV with maps of floats."""
    scene = make_scene(size)
    rig = _scaled_rig(scene)
    rectifier = make_rectifier(rig)
    sides = ((scene.left, rectifier.left_maps), (scene.right, rectifier.right_maps))
    return Case(
        lambda: [rectify_image(image, maps) for image, maps in sides],
        *_pixels(scene),
        peers=[Peer("OpenCV alone, float maps", lambda: _float_maps(scene, rig), limit=1.1, gated=size == "medium")],
    )


def _scaled_rig(scene: Scene) -> StereoRig:
    """The LocCam's calibration for images of the scene's size."""
    rig = read_camera_yaml(config_folder() / "cameras" / "katwijk_loccam.yaml")
    assert isinstance(rig, StereoRig)
    height_px, width_px = scene.left.shape[:2]
    zoom = np.diag([width_px / rig.width_px, height_px / rig.height_px, 1.0])
    return make_stereo_rig(
        K_left=zoom @ rig.K_left,
        distortion_left=rig.distortion_left,
        K_right=zoom @ rig.K_right,
        distortion_right=rig.distortion_right,
        R_right_left=rig.R_right_left,
        t_right_left_m=rig.t_right_left_m,
        size_px=(width_px, height_px),
    )


def _float_maps(scene: Scene, rig: StereoRig) -> Run:
    size = (rig.width_px, rig.height_px)
    R_left, R_right, P_left, P_right, *_ = cv2.stereoRectify(
        *(rig.K_left, rig.distortion_left, rig.K_right, rig.distortion_right),
        *(size, rig.R_right_left, rig.t_right_left_m.reshape(3, 1)),
        alpha=0,
    )
    left = cv2.initUndistortRectifyMap(rig.K_left, rig.distortion_left, R_left, P_left, size, cv2.CV_32FC1)
    right = cv2.initUndistortRectifyMap(rig.K_right, rig.distortion_right, R_right, P_right, size, cv2.CV_32FC1)
    return lambda: [
        cv2.remap(scene.left, *left, cv2.INTER_LINEAR),
        cv2.remap(scene.right, *right, cv2.INTER_LINEAR),
    ]


def match(size: str) -> Case:
    """From an RGB pair to disparity with NaN, the leftmost columns too, against SGBM alone on grey images."""
    scene = make_scene(size)
    matcher = Matcher(StereoOptions(num_disparities=DISPARITIES), scene.left.shape[1])
    return Case(
        lambda: matcher(scene.left, scene.right),
        *_pixels(scene),
        peers=[peers.sgbm(scene)._replace(limit=1.5, gated=size == "medium")],
    )


def project(size: str) -> Case:
    """Disparity to points in the world."""
    scene = make_scene(size)
    prepared = ours.project(scene)
    beside = [
        Peer("OpenCV, reprojectImageTo3D and transform", lambda: peers.opencv_points(scene), 1.0, size == "medium")
    ]
    if size == "small":
        beside.append(Peer("NumPy twin", lambda: _twin(scene)))
    return Case(prepared.run, *_pixels(scene), beside, prepared.compile_s, prepared.temporary_bytes)


def _twin(scene: Scene) -> Run:
    camera = plain_camera(scene)
    pose = SimpleNamespace(wxyz_xyz=np.asarray(scene.pose.wxyz_xyz))

    def run() -> np.ndarray:
        points_camera, _ = reference.disparity_to_points(camera, scene.disparity_px)
        return reference.transform_points(pose, points_camera)

    return run


def plain_camera(scene: Scene) -> SimpleNamespace:
    """The camera with Python's numbers, which the twins read many times faster than JAX's."""
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m", "doffs_px")
    return SimpleNamespace(**{name: float(getattr(scene.camera, name)) for name in names})


def _pixels(scene: Scene) -> tuple[Amount, Amount]:
    return Amount(scene.pixels, "pixels"), Amount(scene.pixels, "pixels")


GROUPS = (
    Group("rectify", "both images of a pair, by the LocCam's calibration", rectify),
    Group("match", "disparity of a pair, 128 disparities", match),
    Group("project", "disparity to points in the world", project),
)
