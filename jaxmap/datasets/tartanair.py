"""TartanAir: `image_left`, `image_right`, `pose_left.txt`; and version 2's `image_lcam_front` and so on.

Poses are those of the left camera in a north, east, down world, with a camera frame of x forward, y right, z down.
Wang et al. 2020, "TartanAir: A Dataset to Push the Limits of Visual SLAM".
"""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxmap.datasets.base import FrameRef, Reader, StereoSequence, assemble, read_pose_track
from jaxmap.datasets.calibration import read_camera_yaml
from jaxmap.datasets.images import first_image_size_px, list_images
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.poses import PoseTrack
from jaxmap.datasets.stamped_poses import StampedPose, make_track
from jaxmap.datasets.text_files import data_lines
from jaxmap.errors import JaxmapError
from jaxmap.types import StereoCamera, make_stereo_camera

F_PX, BASELINE_M = 320.0, 0.25
CENTRES_PX = {(640, 480): (320.0, 240.0), (640, 640): (320.0, 320.0)}
"""Principal points of both versions, by the size of their images."""

T_ENU_NED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
T_FRD_OPTICAL = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


class Layout(NamedTuple):
    """The names of one version: image folders and what their names end with, and the poses."""

    left: str
    right: str
    poses: str


_LAYOUTS = (
    Layout("left", "right", "pose_left.txt"),
    Layout("lcam_front", "rcam_front", "pose_lcam_front.txt"),
)


def recognises(folder: Path) -> bool:
    """Whether the folder holds the two image folders of a version."""
    return _layout(folder) is not None


def open_tartanair(folder: Path, options: ReadOptions) -> StereoSequence:
    """Opens one trajectory, such as `P001`.

    An image's number is its line in the poses. There are no times: frames are numbered 0, 1, 2 ... s. The
    camera is the simulator's, the same in all of TartanAir; recordings in this layout with another camera
    (TartanDrive) need a calibration.

    Raises:
        JaxmapError: a file is missing or malformed, or the images are not of TartanAir's sizes.
    """
    layout = _layout(folder)
    assert layout is not None
    frames = _frames(folder, layout)
    if options.calibration:
        camera = read_camera_yaml(options.calibration)
    else:
        camera = _simulators_camera(first_image_size_px((frame.left for frame in frames), folder), folder)
    track, bad = (read_pose_track(options, folder), 0) if options.poses else _read_poses(folder / layout.poses, frames)
    sequence = assemble(
        name=f"tartanair_{Path(os.path.abspath(folder)).name}",
        dataset="tartanair",
        where=folder,
        frames=frames,
        track=track,
        camera=camera,
        options=options if options.poses else replace(options, poses_world="z_up"),
        T_child_camera=None if options.poses else T_FRD_OPTICAL,
        notes=["frames numbered 0, 1, 2 ... s, as no times are known", *[f"{bad} poses are not whole"] * bool(bad)],
    )
    return sequence if options.poses else replace(sequence, T_world_source=T_ENU_NED)


def _layout(folder: Path) -> Layout | None:
    found = (layout for layout in _LAYOUTS if all((folder / f"image_{side}").is_dir() for side in layout[:2]))
    return next(found, None)


def _frames(folder: Path, layout: Layout) -> list[FrameRef]:
    frames = []
    for image in list_images(folder / f"image_{layout.left}"):
        number = re.fullmatch(rf"([0-9]{{1,9}})(_{layout.left})?", image.stem)
        if number is None:
            raise JaxmapError(
                f"{image.name} does not name a frame", where=image.parent, fix=f"name it 000000_{layout.left}.png"
            )
        name = image.name.replace(f"_{layout.left}", f"_{layout.right}")
        frames.append(FrameRef(image.stem, float(number[1]), image, folder / f"image_{layout.right}" / name))
    return frames


def _simulators_camera(size_px: tuple[int, int], folder: Path) -> StereoCamera:
    if size_px not in CENTRES_PX:
        sizes = " or ".join(f"{width}x{height}" for width, height in CENTRES_PX)
        raise JaxmapError(
            f"images of {size_px[0]}x{size_px[1]} px are not TartanAir's ({sizes})",
            where=folder,
            fix="give the calibration of these images with --calibration FILE",
        )
    cx_px, cy_px = CENTRES_PX[size_px]
    return make_stereo_camera(
        fx_px=F_PX, cx_px=cx_px, cy_px=cy_px, baseline_m=BASELINE_M, width_px=size_px[0], height_px=size_px[1]
    )


def _read_poses(path: Path, frames: list[FrameRef]) -> tuple[PoseTrack, int]:
    """Poses of `tx ty tz qx qy qz qw` lines, one for each number of a frame, turned z-up; and how many are bad."""
    if not path.is_file():
        raise JaxmapError(
            f"the sequence has no poses: there is no file {path}",
            fix="give them with --poses FILE (TUM text, T_world_camera of the left camera)",
        )
    rows = data_lines(path)
    if frames[-1].timestamp_s >= len(rows):
        raise JaxmapError(
            f"{len(rows)} poses, but an image {frames[-1].name}", where=path, fix="restore the line of each image"
        )
    poses = []
    for number, (line, text) in enumerate(rows):
        try:
            x, y, z, qx, qy, qz, qw = (float(word) for word in text.split())
        except ValueError as fault:
            raise JaxmapError("not tx ty tz qx qy qz qw", where=f"{path} line {line}", fix="restore it") from fault
        poses.append(StampedPose(number * 10**9, (x, y, z), (qx, qy, qz, qw)))
    track, bad = make_track(poses, str(path))
    return replace(track, T=T_ENU_NED @ track.T), bad


READER = Reader("tartanair", "TartanAir, a trajectory with image_left and image_right", recognises, open_tartanair)
