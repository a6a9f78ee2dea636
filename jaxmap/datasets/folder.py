"""Plain folders: `left/NAME.png`, `right/NAME.png`, `camera.yaml`, `poses.tum`."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from jaxmap.datasets.base import UNPOSED, FrameRef, Reader, StereoSequence, assemble, read_pose_track
from jaxmap.datasets.calibration import read_camera_yaml
from jaxmap.datasets.images import list_images
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.poses import PoseTrack, read_timestamps
from jaxmap.errors import JaxmapError

_TIME_FILES = ("times.txt", "timestamps.txt")

_MIN_UNIX_TIME_S = 1e8


def recognises(folder: Path) -> bool:
    """Whether the folder holds `left` and `right`."""
    return (folder / "left").is_dir() and (folder / "right").is_dir()


def open_folder(folder: Path, options: ReadOptions) -> StereoSequence:
    """Opens a plain folder.

    Images are `left/NAME` and `right/NAME`, of the same names, in the natural order of the names
    (`f2` before `f10`). The calibration is `camera.yaml` (`calibration.read_camera_yaml` describes
    it) or the one given; the poses are `poses.tum` or those given.

    The times of the frames come from the first source that exists:

    1. `times.txt` or `timestamps.txt`, one number per line, one line for each left image;
    2. the file names, if all are times: numbers with a decimal point, or of 1e8 and more (that is, from
       1973 on); smaller whole numbers count the frames;
    3. the times of the poses, if there are as many poses as images (poses without times number the
       frames 0, 1, 2 ... s).

    Times are in seconds; where the largest reaches 1e11 they are in milliseconds, from 1e14 on in
    microseconds, and from 1e17 on in nanoseconds.

    Raises:
        JaxmapError: a file is missing or malformed, counts disagree, or there are no times.
    """
    images = list_images(folder / "left")
    calibration = options.calibration or folder / "camera.yaml"
    if not calibration.is_file():
        raise JaxmapError(
            f"no calibration: there is no file {calibration}", fix="write camera.yaml, or give --calibration FILE"
        )
    camera = read_camera_yaml(calibration)
    track = read_pose_track(options, folder / "poses.tum")
    images, times_s, note = _timed_images(folder, images, track)
    frames = [
        FrameRef(image.stem, float(time_s), image, folder / "right" / image.name)
        for image, time_s in zip(images, times_s, strict=True)
    ]
    return assemble(
        name=Path(os.path.abspath(folder)).name,
        dataset="folder",
        where=folder,
        frames=frames,
        track=track,
        camera=camera,
        options=options,
        notes=[note],
    )


def _timed_images(folder: Path, images: list[Path], track: PoseTrack) -> tuple[list[Path], np.ndarray, str]:
    """The images in order, their times in seconds, and a note on the source of the times."""
    for path in (folder / name for name in _TIME_FILES):
        if path.is_file():
            times = read_timestamps(path)
            if len(times) != len(images):
                raise JaxmapError(
                    f"{len(times)} times for {len(images)} left images", where=path, fix="write one line for each image"
                )
            return images, times / _per_second(times), f"times of the frames from {path.name}"
    if all(re.fullmatch(r"[0-9]+(\.[0-9]+)?", image.stem) and len(image.stem) < 40 for image in images):
        images = sorted(images, key=lambda image: float(image.stem))
        times = np.array([float(image.stem) for image in images])
        if any("." in image.stem for image in images) or times.max() >= _MIN_UNIX_TIME_S:
            return images, times / _per_second(times), "times of the frames from the file names"
    if track is UNPOSED or len(images) == len(track.T):
        if track is UNPOSED or track.timestamps_s is None:
            return images, np.arange(float(len(images))), "frames numbered 0, 1, 2 ... s, as no times are known"
        return images, track.timestamps_s, "times of the frames from the poses, one for each"
    raise JaxmapError(
        f"no times: no {' or '.join(_TIME_FILES)}, the file names are not times, and there are {len(track.T)} poses "
        f"for {len(images)} left images",
        where=folder,
        fix="write times.txt with one time in seconds per line",
    )


def _per_second(times: np.ndarray) -> float:
    largest = np.abs(times).max()
    return next((count for least, count in ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3)) if largest >= least), 1.0)


READER = Reader("folder", "a plain folder with left, right and camera.yaml", recognises, open_folder)
