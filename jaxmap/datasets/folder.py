"""Plain folders: `left/NAME.png`, `right/NAME.png`, `camera.yaml`, `poses.tum`."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from jaxmap.datasets.assemble import Reader, ReadOptions, assemble, read_pose_track
from jaxmap.datasets.base import FrameRef, StereoSequence
from jaxmap.datasets.calibration import read_camera_yaml
from jaxmap.datasets.images import list_images
from jaxmap.datasets.pose_files import read_timestamps
from jaxmap.datasets.poses import PoseTrack
from jaxmap.errors import JaxmapError

_TIME_FILES = ("times.txt", "timestamps.txt")

_LEAST_UNIX_TIME_S = 1e8


def recognises(folder: Path) -> bool:
    """Whether the folder holds `left` and `right`."""
    return (folder / "left").is_dir() and (folder / "right").is_dir()


def open_folder(folder: Path, options: ReadOptions) -> StereoSequence:
    """Opens a plain folder.

    Images are `left/NAME` and `right/NAME`, of the same names, in the natural order of the names
    (`f2` before `f10`). The calibration is `camera.yaml` (`calibration.read_camera_yaml` describes
    it) or the one given; the poses are `poses.tum` or those given.

    The times of the frames are the first of these that there is:

    1. `times.txt` or `timestamps.txt`, one number per line, one line for each left image;
    2. the file names, where all are times: numbers with a decimal point, or from 1e8 on (which
       reaches back to 1973); smaller whole numbers are taken for counters;
    3. the times of the poses, where there are as many poses as images (with poses that carry no
       times, the frames are numbered 0, 1, 2 ... s).

    Times are in seconds; from 1e11 on they are milliseconds, from 1e14 on microseconds, and from
    1e17 on nanoseconds, by the largest of them.

    Raises:
        JaxmapError: a file is missing or malformed, counts disagree, or there are no times.
    """
    images = list_images(folder / "left")
    calibration = options.calibration or folder / "camera.yaml"
    if not Path(calibration).is_file():
        raise JaxmapError(
            f"no calibration: there is no file {calibration}", fix="write camera.yaml, or give --calibration FILE"
        )
    camera = read_camera_yaml(Path(calibration))
    own = folder / "poses.tum"
    track = read_pose_track(options, own if own.is_file() else None, own)
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
    """The images in order, their times in seconds, and where the times are from."""
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
        if any("." in image.stem for image in images) or times.max() >= _LEAST_UNIX_TIME_S:
            return images, times / _per_second(times), "times of the frames from the file names"
    if len(images) == len(track.T):
        if track.timestamps_s is None:
            return images, np.arange(float(len(images))), "frames numbered: no times are known"
        return images, track.timestamps_s, "times of the frames from the poses, one for each"
    raise JaxmapError(
        f"no times: no {' or '.join(_TIME_FILES)}, the file names are no times, and {len(track.T)} poses are not one "
        f"for each of {len(images)} left images",
        where=folder,
        fix="write times.txt with one time in seconds per line",
    )


def _per_second(times: np.ndarray) -> float:
    largest = np.abs(times).max()
    return next((count for least, count in ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3)) if largest >= least), 1.0)


READER = Reader("folder", "a plain folder with left, right and camera.yaml", recognises, open_folder)
