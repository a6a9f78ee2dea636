"""The readers by name, and the choice among them."""

from __future__ import annotations

from pathlib import Path

from jaxmap.datasets import (
    asp,
    euroc,
    folder,
    katwijk,
    kitti,
    madmax,
    middlebury,
    planetary,
    rosbag,
    tartanair,
)
from jaxmap.datasets.base import OnFrame, Reader, StereoSequence, from_images
from jaxmap.datasets.crs import check_crs, check_metres
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.samples import open_sample
from jaxmap.datasets.visual_odometry import with_odometry
from jaxmap.errors import JaxmapError, UsageError

SAMPLE_PREFIX = "sample:"

READERS: dict[str, Reader] = {
    module.READER.name: module.READER
    for module in (
        kitti,
        euroc,
        folder,
        katwijk,
        planetary,
        asp,
        rosbag,
        madmax,
        tartanair,
        middlebury,
    )
}


def register(reader: Reader) -> None:
    """Adds a reader.

    Raises:
        ValueError: the name is taken.
    """
    if reader.name in READERS or reader.name in ("auto", "sample"):
        raise ValueError(f"a reader named {reader.name} is registered already")
    READERS[reader.name] = reader


def open_sequence(
    source: str | Path, options: ReadOptions | None = None, on_frame: OnFrame = lambda done, total: None
) -> StereoSequence:
    """Opens the folder of one sequence, a file that holds one (a bag), or `sample:NAME` for a bundled one.

    Args:
        source: the folder or sample.
        options: how it is read.
        on_frame: is told of the progress of odometry, the one thing that takes long.

    Raises:
        UsageError: an option names no reader, no camera or no coordinate reference system.
        JaxmapError: the source is missing, no reader or more than one fits, or the data are faulty.
    """
    options = options or ReadOptions()
    if options.dataset not in ("auto", *READERS):
        raise UsageError(
            f"there is no reader {options.dataset!r}", where="--dataset", fix=f"choose auto, {', '.join(READERS)}"
        )
    if options.crs is not None:
        check_crs(options.crs)
    if str(source).startswith(SAMPLE_PREFIX):
        return _posed(open_sample(str(source).removeprefix(SAMPLE_PREFIX), options), options, on_frame)
    path = Path(source)
    if not path.is_dir() and not (path.is_file() and any(reader.recognises(path) for reader in READERS.values())):
        what = f"{source} is a file, but no bag" if path.exists() else f"there is no folder {source}"
        raise JaxmapError(what, fix="give the folder of one sequence, a bag, or sample:NAME")
    reader = READERS[options.dataset] if options.dataset != "auto" else _recognise(path)
    if options.camera is not None and options.camera not in reader.cameras:
        fix = f"choose {' or '.join(reader.cameras)}" if reader.cameras else "leave the option out"
        raise UsageError(f"{reader.name} has no camera {options.camera!r}", where="--camera", fix=fix)
    return _posed(reader.open(path, options), options, on_frame)


def _posed(sequence: StereoSequence, options: ReadOptions, on_frame: OnFrame) -> StereoSequence:
    """The sequence in metres, with the poses that its images give where these are asked for."""
    if sequence.crs is not None:
        check_metres(sequence.crs, sequence.T_world_camera[:, :3, 3] + sequence.site_origin)
    return with_odometry(sequence, options, katwijk.up_in_camera, on_frame) if from_images(options) else sequence


def _recognise(path: Path) -> Reader:
    """The one reader that recognises a folder."""
    fitting = [reader for reader in READERS.values() if reader.recognises(path)]
    if not fitting:
        raise JaxmapError(
            f"no data set is recognised: looked for what marks {', '.join(READERS)}",
            where=path,
            fix="give the folder of one sequence; jaxmap info says what each must hold",
        )
    if len(fitting) > 1:
        names = " and ".join(reader.name for reader in fitting)
        raise JaxmapError(f"{names} both fit", where=path, fix="choose one with --dataset")
    return fitting[0]
