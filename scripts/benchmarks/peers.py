"""The programs that people would use instead, each prepared on the same data; optional ones are imported when used."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from harness import Peer, Run, usable_cores
from numpy.typing import ArrayLike
from scene import DISPARITIES, Scene

from jaxmap.stereo.rectify import StereoRig

SIGMA_M = 0.05
"""Inliers of a plane lie within this distance, for all."""


def sgbm(scene: Scene, calls: int = 1) -> Peer:
    """OpenCV's SGBM in its 3WAY mode with 128 disparities, on grey images, so many times in a row."""
    times = "" if calls == 1 else f", {calls} times"

    def make() -> Run:
        block = 5
        matcher = cv2.StereoSGBM.create(
            numDisparities=DISPARITIES,
            blockSize=block,
            P1=8 * block**2,
            P2=32 * block**2,
            disp12MaxDiff=1,
            preFilterCap=31,
            uniquenessRatio=10,
            speckleWindowSize=100,
            speckleRange=2,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )
        grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (scene.left, scene.right)]

        def run() -> None:
            for _ in range(calls):
                matcher.compute(*grey)

        return run

    return Peer(f"SGBM 3WAY, {DISPARITIES} disparities{times}", make)


def octomap_insertion(
    points_world: np.ndarray, origin_world: np.ndarray, resolution_m: float, *, discretize: bool, max_range_m: float
) -> Run:
    """OctoMap's `insertPointCloud`; each run fills the same tree further."""
    import octomap

    tree = octomap.OcTree(resolution_m)
    points, origin = points_world.astype(np.float64), origin_world.astype(np.float64)

    def run() -> None:
        tree.insertPointCloud(points, origin, maxrange=max_range_m, discretize=discretize)

    return run


def octomap_binding(count: int, resolution_m: float) -> Run:
    """What OctoMap's binding takes to turn so many points into a C++ cloud: all lie in the voxel of the origin."""
    origin = np.full(3, resolution_m / 2)
    return octomap_insertion(np.tile(origin, (count, 1)), origin, resolution_m, discretize=True, max_range_m=-1.0)


def open3d_cloud(points: np.ndarray) -> Any:
    """A cloud of Open3D."""
    import open3d

    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))


def open3d_voxels(points_world: np.ndarray, voxel_size_m: float) -> Run:
    """Open3D's voxel grid of a cloud: which voxels hold points."""
    import open3d

    cloud = open3d_cloud(points_world)
    return lambda: open3d.geometry.VoxelGrid.create_from_point_cloud(cloud, voxel_size_m)


@dataclass
class PlaneFit:
    """A fit of a plane, and the planes (4,) `normal . p + offset = 0` that it has found so far."""

    fit: Callable[[], ArrayLike]
    planes: list[np.ndarray] = field(default_factory=list)

    def __call__(self) -> None:
        """Fits once more."""
        self.planes.append(np.asarray(self.fit(), np.float64))


def open3d_plane(points: np.ndarray, iterations: int, probability: float) -> PlaneFit:
    """Open3D's `segment_plane`; with a probability of 1 it makes all iterations."""
    cloud = open3d_cloud(points)
    return PlaneFit(lambda: cloud.segment_plane(SIGMA_M, 3, iterations, probability)[0])


def float_maps(scene: Scene, rig: StereoRig) -> Run:
    """OpenCV's rectification of both images with maps of floats."""
    size = (rig.width_px, rig.height_px)
    R_left, R_right, P_left, P_right, *_ = cv2.stereoRectify(
        *(rig.K_left, rig.distortion_left, rig.K_right, rig.distortion_right),
        *(size, rig.R_right_left, rig.t_right_left_m.reshape(3, 1)),
        alpha=0,
    )
    left = cv2.initUndistortRectifyMap(rig.K_left, rig.distortion_left, R_left, P_left, size, cv2.CV_32FC1)
    right = cv2.initUndistortRectifyMap(rig.K_right, rig.distortion_right, R_right, P_right, size, cv2.CV_32FC1)
    sides = ((scene.left, left), (scene.right, right))
    return lambda: [cv2.remap(image, *maps, cv2.INTER_LINEAR) for image, maps in sides]


def opencv_points(scene: Scene) -> Run:
    """OpenCV's `reprojectImageTo3D` and `transform`: disparity to points in the world."""
    camera = scene.camera
    fx, fy, cx, cy = (float(getattr(camera, name)) for name in ("fx_px", "fy_px", "cx_px", "cy_px"))
    baseline_m, doffs_px = float(camera.baseline_m), float(camera.doffs_px)
    # (X, Y, Z, W) = Q (u, v, d, 1) with W = (d + doffs) / (b fx).
    Q = np.array(
        [
            [1, 0, 0, -cx],
            [0, fx / fy, 0, -cy * fx / fy],
            [0, 0, 0, fx],
            [0, 0, 1 / baseline_m, doffs_px / baseline_m],
        ]
    )
    disparity_px, T = scene.disparity_px, scene.T_world_camera[:3].astype(np.float32)
    return lambda: cv2.transform(cv2.reprojectImageTo3D(disparity_px, Q), T)


def memory_pass(read: Sequence[np.ndarray], updated_floats: int) -> Run:
    """Reads arrays, and reads and writes so many float32, once, on all threads: no program that does so is faster.

    Args:
        read: arrays of which the greatest number is computed, which takes no longer than reading.
        updated_floats: numbers that are read and written.

    Returns:
        The run.
    """
    threads = usable_cores()
    flat = [array.reshape(-1).view(np.int32 if array.itemsize == 4 else np.int8) for array in read]
    target = np.zeros(updated_floats, np.float32)
    shares = [[part[index] for part in (np.array_split(array, threads) for array in flat)] for index in range(threads)]
    updated = np.array_split(target, threads)
    pool = ThreadPoolExecutor(threads)

    def work(index: int) -> None:
        for part in shares[index]:
            part.max(initial=0)
        np.add(updated[index], 1.0, out=updated[index])

    return lambda: list(pool.map(work, range(threads)))
