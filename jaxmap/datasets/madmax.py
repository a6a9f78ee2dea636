"""MADMAX (DLR, Morocco): rectified pairs, CameraInfo as YAML, mountings and GNSS ground truth as csv.

Meyer et al. 2021, "The MADMAX data set for visual-inertial rover navigation on Mars", Journal of Field Robotics.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from jaxmap.datasets.base import FrameRef, Reader, StereoSequence, assemble, read_pose_track
from jaxmap.datasets.calibration import read_camera_yaml
from jaxmap.datasets.images import list_images
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.pairing import nearest_pairs
from jaxmap.datasets.poses import PoseTrack
from jaxmap.datasets.projections import camera_of_projections
from jaxmap.datasets.stamped_poses import StampedPose, make_track
from jaxmap.datasets.text_files import data_lines, image_size, load_yaml, number_list
from jaxmap.errors import JaxmapError
from jaxmap.types import StereoCamera

PAIR_TOLERANCE_NS = 5_000_000

_LEFT, _RIGHT = "img_rect_left", "img_rect_right"
_TRUTH = "gt_6DoF_gnss_and_imu.csv"
_TRUTH_COLUMNS = 11
_FRAMES = ("B", "camera_left")


def recognises(folder: Path) -> bool:
    """Whether the folder holds `img_rect_left` and `img_rect_right`."""
    return (folder / _LEFT).is_dir() and (folder / _RIGHT).is_dir()


def open_madmax(folder: Path, options: ReadOptions) -> StereoSequence:
    """Opens one run; `calibration` and `ground_truth` lie in its folder or beside it.

    The ground truth holds poses of the body frame B in east, north, up. `tf__imu_to_B.csv` and
    `tf__imu_to_camera_left.csv` take them to the left camera: a file `tf__a_to_b.csv` holds the pose of b in a.

    Raises:
        JaxmapError: a file is missing or malformed, or no images pair up.
    """
    frames, dropped = _paired_frames(folder)
    calibration = _beside(folder, "calibration")
    camera = read_camera_yaml(options.calibration) if options.calibration else _read_camera(calibration)
    notes = [f"{dropped} images have no partner within 5 ms and are left out"] * bool(dropped)
    T_body_camera = None
    if options.poses:
        track = read_pose_track(options, folder)
    else:
        track, bad = _read_truth(_beside(folder, "ground_truth") / _TRUTH)
        notes += [f"{bad} poses repeat a time or are not whole, and are left out"] * bool(bad)
        T_imu_body, T_imu_camera = (_read_mounting(calibration / f"tf__imu_to_{name}.csv") for name in _FRAMES)
        T_body_camera = np.linalg.inv(T_imu_body) @ T_imu_camera
        down = -(track.T[:, 2, :3] @ T_body_camera[:3, 1]).mean()
        if down < 0.3:
            notes.append(f"the camera's y axis does not point down in the poses ({down:.2f}): check the tf files")
    return assemble(
        name=f"madmax_{Path(os.path.abspath(folder)).name}",
        dataset="madmax",
        where=folder,
        frames=frames,
        track=track,
        camera=camera,
        options=options,
        T_child_camera=T_body_camera,
        notes=notes,
    )


def _beside(folder: Path, name: str) -> Path:
    """A folder of the run: within it, or beside it, there also with the run's name before it (`A-0_ground_truth`)."""
    absolute = Path(os.path.abspath(folder))
    places = [absolute / name, absolute / f"{absolute.name}_{name}", absolute.parent / f"{absolute.name}_{name}"]
    return next((place for place in [*places, absolute.parent / name] if place.is_dir()), absolute / name)


def _images(folder: Path) -> tuple[np.ndarray, list[Path]]:
    """Times in ns and files of one camera, in the order of time."""
    timed = {}
    for image in list_images(folder):
        found = re.fullmatch(rf"{folder.name}_([0-9]{{1,19}})", image.stem)
        if found is None:
            raise JaxmapError(f"{image.name} does not name a time", where=folder, fix=f"name it {folder.name}_<ns>.png")
        timed[int(found[1])] = image
    times_ns = sorted(timed)
    return np.array(times_ns, np.int64), [timed[time_ns] for time_ns in times_ns]


def _paired_frames(folder: Path) -> tuple[list[FrameRef], int]:
    left_ns, left_images = _images(folder / _LEFT)
    right_ns, right_images = _images(folder / _RIGHT)
    left, right, least_ns = nearest_pairs(left_ns, right_ns, PAIR_TOLERANCE_NS)
    if not len(left):
        raise JaxmapError(
            f"no left and right images lie within 5 ms of each other: the nearest are {least_ns / 1e6:.1f} ms apart",
            where=folder,
            fix="check the names of the images",
        )
    frames = [
        FrameRef(left_images[i].stem, int(left_ns[i]) / 1e9, left_images[i], right_images[j])
        for i, j in zip(left, right, strict=True)
    ]
    return frames, len(left_ns) + len(right_ns) - 2 * len(frames)


def _read_camera(calibration: Path) -> StereoCamera:
    matrices, sizes = [], []
    for side in ("left", "right"):
        path = calibration / f"camera_rect_{side}_info.txt"
        content = load_yaml(path)
        missing = [key for key in ("width", "height", "P") if key not in content]
        if missing:
            raise JaxmapError(f"keys are missing: {', '.join(missing)}", where=path, fix="restore the file")
        matrices.append(number_list(content["P"], "P", path, count=12).reshape(3, 4))
        sizes.append(image_size([content["width"], content["height"]], "width, height", path))
    if sizes[0] != sizes[1]:
        raise JaxmapError("the cameras differ in resolution", where=calibration, fix="give a --calibration of one size")
    return camera_of_projections(matrices[0], matrices[1], sizes[0], calibration)


def _rows(path: Path, columns: int) -> list[list[float]]:
    """The lines of numbers of a csv; those of its header start with anything else."""
    rows = []
    for line, text in data_lines(path):
        if not re.match(r"[-+.0-9]", text):
            continue
        try:
            rows.append([float(word) for word in re.split(r"[,\s]+", text.strip(", \t"))])
        except ValueError as fault:
            raise JaxmapError(f"{fault}"[:120], where=f"{path} line {line}", fix="restore the file") from fault
        if len(rows[-1]) < columns:
            what = f"{len(rows[-1])} columns, not {columns}"
            raise JaxmapError(what, where=f"{path} line {line}", fix="restore the file")
    return rows


def _read_mounting(path: Path) -> np.ndarray:
    """The 4x4 pose of the line `position x y z, orientation x y z w`."""
    track, _ = make_track((_pose(0, row[:3], row[3:7]) for row in _rows(path, 7)[:1]), str(path))
    return track.T[0]


def _read_truth(path: Path) -> tuple[PoseTrack, int]:
    """Poses of the body, by time in s, east, north, up, three deviations, quaternion with w first; how many are bad."""
    if not path.is_file():
        raise JaxmapError(
            f"the sequence has no poses: there is no file {path}",
            fix="put the ground truth there, or give --poses FILE (TUM text, T_world_camera of the left camera)",
        )
    rows = _rows(path, _TRUTH_COLUMNS)
    return make_track((_pose(row[0], row[1:4], [*row[8:11], row[7]]) for row in rows), str(path))


def _pose(time_s: float, position_m: list[float], quaternion_xyzw: list[float]) -> StampedPose:
    (x, y, z), (qx, qy, qz, qw) = position_m, quaternion_xyzw
    return StampedPose(round(time_s * 1e9), (x, y, z), (qx, qy, qz, qw))


READER = Reader("madmax", "a MADMAX run with img_rect_left and img_rect_right", recognises, open_madmax)
