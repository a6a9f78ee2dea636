"""What the cases work on: the Motorcycle pair enlarged to the LocCam's size, and grids to map it into."""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import cv2
import jax.numpy as jnp
import jaxlie
import numpy as np
from PIL import Image

from jaxmap.datasets import open_sequence
from jaxmap.datasets.pose_axes import T_Z_UP_SOURCE
from jaxmap.datasets.poses import write_tum
from jaxmap.runs.mapping_plan import DEFAULT_VOXEL_M
from jaxmap.stereo.match import Matcher, StereoOptions
from jaxmap.types import GridSpec, StereoCamera, make_grid, make_stereo_camera

IMAGE_PX = {"small": (512, 384), "medium": (1024, 768), "large": (2048, 1536)}
"""Width and height; the LocCam's in the middle."""
VOXEL_M = {"small": (0.4, 0.4, 0.4), "medium": (0.2, 0.2, 0.2), "large": DEFAULT_VOXEL_M}
"""The paper's voxels in the middle, the default ones last."""
DISPARITIES = 128
"""Searched where matching is timed, at all sizes."""
DEPTH_RANGE_M = (0.3, 12.0)


def grid_of(size: str) -> GridSpec:
    """40 x 40 x 4 m in voxels of that size."""
    return make_grid((0.0, 0.0, -2.0), (40.0, 40.0, 2.0), VOXEL_M[size])


@dataclass(frozen=True, eq=False)
class Scene:
    """One stereo frame; its camera stands 1.1 m above the ground in the middle of the map."""

    left: np.ndarray
    right: np.ndarray
    camera: StereoCamera
    T_world_camera: np.ndarray

    @property
    def pixels(self) -> int:
        """Number of pixels, and so of points."""
        return self.left.shape[0] * self.left.shape[1]

    @property
    def pose(self) -> jaxlie.SE3:
        """`T_world_camera` as the step takes it."""
        return jaxlie.SE3.from_matrix(jnp.asarray(self.T_world_camera, jnp.float32))

    @cached_property
    def disparity_px(self) -> np.ndarray:
        """Disparity by SGBM 3WAY, NaN where there is none; the search range grows with the size."""
        width_px = self.left.shape[1]
        return Matcher(StereoOptions(num_disparities=width_px // 8, pad_left=False), width_px)(self.left, self.right)


@cache
def make_scene(size: str = "medium") -> Scene:
    """The pair with images of that size."""
    return resized_scene(*IMAGE_PX[size])


def resized_scene(width_px: int, height_px: int) -> Scene:
    """The pair with images of any size."""
    sequence = open_sequence("sample:motorcycle")
    source = sequence.camera
    assert isinstance(source, StereoCamera)
    zoom_x, zoom_y = width_px / source.width_px, height_px / source.height_px
    way = cv2.INTER_AREA if zoom_x < 1 else cv2.INTER_CUBIC
    pair = sequence.read_pair(sequence.frames[0])
    left, right = (cv2.resize(image, (width_px, height_px), interpolation=way) for image in pair)
    camera = make_stereo_camera(
        fx_px=float(source.fx_px) * zoom_x,
        fy_px=float(source.fy_px) * zoom_y,
        cx_px=float(source.cx_px) * zoom_x,
        cy_px=float(source.cy_px) * zoom_y,
        baseline_m=float(source.baseline_m),
        doffs_px=float(source.doffs_px) * zoom_x,
        width_px=width_px,
        height_px=height_px,
    )
    T_world_camera = np.array(T_Z_UP_SOURCE["camera"], np.float64)
    T_world_camera[:3, 3] = (20.0, 12.0, 1.1)
    return Scene(left, right, camera, T_world_camera)


def moved_poses(scene: Scene, frames: int) -> np.ndarray:
    """Poses of a drive that stays in the map, (N, 4, 4): ahead by 0.2 m a frame, over 20 m again and again."""
    poses = np.repeat(scene.T_world_camera[None], frames, axis=0)
    poses[:, 1, 3] += 0.2 * (np.arange(frames) % 100)
    return poses


def write_sequence(scene: Scene, frames: int) -> tempfile.TemporaryDirectory[str]:
    """A plain folder of pairs: the scene, its rows rolled a little from frame to frame, along `moved_poses`."""
    owner = tempfile.TemporaryDirectory(prefix="jaxmap-bench-")
    folder = Path(owner.name)
    for side, image in (("left", scene.left), ("right", scene.right)):
        (folder / side).mkdir()
        for index in range(frames):
            Image.fromarray(np.roll(image, index, axis=0)).save(folder / side / f"{index:06d}.png", compress_level=3)
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m", "doffs_px")
    camera = {key: float(getattr(scene.camera, key)) for key in names}
    size_px = [scene.camera.width_px, scene.camera.height_px]
    (folder / "camera.yaml").write_text(json.dumps({"image_size_px": size_px, **camera}))
    times_s = 0.1 * np.arange(frames)
    (folder / "times.txt").write_text("\n".join(map(str, times_s)))
    write_tum(folder / "poses.tum", times_s, moved_poses(scene, frames))
    return owner
