"""KITTI odometry: `sequences/NN` with rectified pairs, `calib.txt`, `times.txt`, `../../poses/NN.txt`."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from jaxmap.datasets.base import FrameRef, Reader, StereoSequence, assemble, read_pose_track
from jaxmap.datasets.calibration import read_camera_yaml
from jaxmap.datasets.images import first_image_size_px, list_images
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.poses import read_timestamps, with_timestamps
from jaxmap.datasets.projections import camera_of_projections
from jaxmap.datasets.text_files import data_lines
from jaxmap.errors import JaxmapError

CAMERAS = {"grey": (0, 1), "color": (2, 3)}
"""Numbers of the left and the right camera by the names that `ReadOptions.camera` takes."""


def recognises(folder: Path) -> bool:
    """Whether the folder holds `calib.txt` and `image_0` or `image_2`."""
    return (folder / "calib.txt").is_file() and any((folder / f"image_{left}").is_dir() for left, _ in CAMERAS.values())


def open_kitti(folder: Path, options: ReadOptions) -> StereoSequence:
    """Opens one sequence: the pair asked for, else the grey one (cameras 0 and 1), else that of colour (2 and 3).

    An image's number is its line in `times.txt` and in the poses, so images may be missing. KITTI's own poses are
    those of camera 0; for the colour pair they are moved to camera 2, 6 cm to the left. Labels must be of the left
    camera of the pair.

    Raises:
        JaxmapError: a file is missing or malformed, or the counts of times and poses disagree.
    """
    there = [name for name, (left, _) in CAMERAS.items() if (folder / f"image_{left}").is_dir()]
    whole = [name for name in there if (folder / f"image_{CAMERAS[name][1]}").is_dir()]
    chosen = options.camera or next(iter(whole + there), "grey")
    left, right = CAMERAS[chosen]
    absolute = Path(os.path.abspath(folder))
    times_s = read_timestamps(folder / "times.txt")
    frames = _frames(folder, left, right, times_s)
    P_left, P_right = _projections(folder / "calib.txt", left, right)
    if options.calibration:
        camera = read_camera_yaml(options.calibration)
    else:
        camera = camera_of_projections(
            P_left, P_right, first_image_size_px((frame.left for frame in frames), folder), folder / "calib.txt"
        )

    track = read_pose_track(options, absolute.parent.parent / "poses" / f"{absolute.name}.txt")
    if track.timestamps_s is None:
        track = with_timestamps(track, times_s)
    T_camera0_left = np.eye(4)
    T_camera0_left[:3, 3] = -np.linalg.solve(P_left[:, :3], P_left[:, 3])
    notes = []
    if options.camera is None and len(whole) > 1:
        notes.append(
            f"the {chosen} pair is taken, image_{left} and image_{right}; labels and poses given must be of "
            f"image_{left}, or choose --camera color (image_2, image_3)"
        )
    if missing := len(times_s) - len(frames):
        notes.append(f"{missing} of {len(times_s)} frames have no left image")
    return assemble(
        name=f"kitti_{absolute.name}",
        dataset="kitti",
        where=folder,
        frames=frames,
        track=track,
        camera=camera,
        options=options,
        T_child_camera=None if options.poses else T_camera0_left,
        notes=notes,
    )


def _frames(folder: Path, left: int, right: int, times_s: np.ndarray) -> list[FrameRef]:
    frames = []
    images = list_images(folder / f"image_{left}")
    try:
        partners = {path.stem: path for path in list_images(folder / f"image_{right}")}
    except JaxmapError as fault:
        raise JaxmapError(
            f"the pair of image_{left} has no image_{right}", where=folder, fix="restore it, or choose another --camera"
        ) from fault
    for image in images:
        if not (image.stem.isascii() and image.stem.isdigit() and int(image.stem) < len(times_s)):
            raise JaxmapError(
                f"{image.name} is none of the {len(times_s)} frames of times.txt",
                where=image.parent,
                fix="name images 000000.png, 000001.png and so on, one for each line of times.txt",
            )
        time_s = float(times_s[int(image.stem)])
        partner = partners.get(image.stem, folder / f"image_{right}" / image.name)
        frames.append(FrameRef(image.stem, time_s, image, partner))
    return frames


def _projections(path: Path, left: int, right: int) -> tuple[np.ndarray, np.ndarray]:
    """The 3x4 projection matrices of two cameras."""
    matrices = {}
    for line, text in data_lines(path):
        key, _, values = text.partition(":")
        if key not in (f"P{left}", f"P{right}"):
            continue
        try:
            matrices[key] = np.array([float(value) for value in values.split()]).reshape(3, 4)
        except ValueError as fault:
            raise JaxmapError(
                f"{key} is not twelve numbers", where=f"{path} line {line}", fix="restore the file"
            ) from fault
        if not np.isfinite(matrices[key]).all() or min(matrices[key][0, 0], matrices[key][1, 1]) <= 0:
            raise JaxmapError(f"{key} is not a projection matrix", where=f"{path} line {line}", fix="restore the file")
        if not np.array_equal(matrices[key][[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1]):
            raise JaxmapError(
                f"{key} is not of a rectified camera", where=f"{path} line {line}", fix="restore the file"
            )
    absent = [key for key in (f"P{left}", f"P{right}") if key not in matrices]
    if absent:
        raise JaxmapError(f"no line {' or '.join(absent)}", where=path, fix="restore the file")
    return matrices[f"P{left}"], matrices[f"P{right}"]


READER = Reader(
    "kitti", "KITTI odometry, sequences/NN with image_0 and calib.txt", recognises, open_kitti, tuple(CAMERAS)
)
