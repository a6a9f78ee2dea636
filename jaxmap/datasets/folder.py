"""Plain folders: `left/NAME.png`, `right/NAME.png` or the like, `camera.yaml`, `poses.tum`."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from jaxmap.datasets.base import UNPOSED, FrameRef, Reader, StereoSequence, assemble, read_pose_track
from jaxmap.datasets.calibration_files import read_calibration
from jaxmap.datasets.images import list_images
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.pair_files import is_number, is_time, pair_files, units_per_second
from jaxmap.datasets.poses import PoseTrack, read_timestamps, with_timestamps
from jaxmap.errors import JaxmapError

_TIME_FILES = ("times.txt", "timestamps.txt")

SIDES = (
    *(("left", "right"), ("Left", "Right"), ("left_images", "right_images")),
    *(("image_left", "image_right"), ("images_left", "images_right"), ("cam_left", "cam_right")),
    *(("image_0", "image_1"), ("image_00", "image_01"), ("cam0", "cam1"), ("cam_0", "cam_1")),
)
"""Names of the two folders of images, in order of preference."""
_OWN_FILES = ("camera.yaml", "poses.tum")


def recognises(folder: Path) -> bool:
    """Whether the folder holds `left` and `right`, or others of `SIDES` and `camera.yaml` or `poses.tum`."""
    sides = _sides(folder)
    if sides is None or sides == SIDES[0]:
        return sides is not None
    # TartanAir's folders of images have such names, too.
    return any((folder / name).is_file() for name in _OWN_FILES) and not (folder / "pose_left.txt").is_file()


def _sides(folder: Path) -> tuple[str, str] | None:
    return next((pair for pair in SIDES if all((folder / side).is_dir() for side in pair)), None)


def _images(folder: Path) -> list[Path]:
    """The images of one camera; those in `data`, as EuRoC's cameras have it, if there are none beside."""
    inner = folder / "data"
    return list_images(inner if inner.is_dir() else folder)


def open_folder(folder: Path, options: ReadOptions) -> StereoSequence:
    """Opens a plain folder.

    Images are `left/NAME` and `right/NAME`, in the natural order of the names (`f2` before `f10`). The folders may be
    others of `SIDES`, and where names differ, `pair_files` says what makes a pair. The calibration is `camera.yaml`
    (`calibration.read_camera_yaml` describes it) or the one given, of any kind; the poses are `poses.tum` or those
    given.

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
    left, right = _sides(folder) or SIDES[0]
    images = _images(folder / left)
    pairs = pair_files(images, _images(folder / right))
    partner, key = dict(zip(images, pairs.right, strict=True)), dict(zip(images, pairs.keys, strict=True))
    calibration = options.calibration or folder / "camera.yaml"
    if not calibration.exists():
        raise JaxmapError(
            f"no calibration: there is no file {calibration}", fix="write camera.yaml, or give --calibration FILE"
        )
    camera, camera_notes = read_calibration(calibration, images)
    track = read_pose_track(options, folder / "poses.tum")
    images, times_s, note = _timed_images(folder, images, key, track)
    if track.timestamps_s is None:
        # Before any image is left out: there is one pose for each.
        track = with_timestamps(track, times_s)
    frames = [
        FrameRef(image.stem, float(time_s), image, right_image)
        for image, time_s in zip(images, times_s, strict=True)
        if (right_image := partner[image]) is not None
    ]
    return assemble(
        name=Path(os.path.abspath(folder)).name,
        dataset="folder",
        where=folder,
        frames=frames,
        track=track,
        camera=camera,
        options=options,
        notes=[*pairs.notes, note, *camera_notes],
    )


def _timed_images(
    folder: Path, images: list[Path], key: dict[Path, str], track: PoseTrack
) -> tuple[list[Path], np.ndarray, str]:
    """The images in order, their times in seconds, and a note on the source of the times."""
    for path in (folder / name for name in _TIME_FILES):
        if path.is_file():
            times = read_timestamps(path)
            if len(times) != len(images):
                raise JaxmapError(
                    f"{len(times)} times for {len(images)} left images", where=path, fix="write one line for each image"
                )
            return images, times / units_per_second(times), f"times of the frames from {path.name}"
    if all(map(is_number, key.values())) and any(map(is_time, key.values())):
        images = sorted(images, key=lambda image: float(key[image]))
        times = np.array([float(key[image]) for image in images])
        return images, times / units_per_second(times), "times of the frames from the file names"
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


READER = Reader("folder", "a plain folder with left, right and camera.yaml", recognises, open_folder)
