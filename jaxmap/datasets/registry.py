"""The readers by name, and the choice among them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import get_args

from jaxmap.datasets.assemble import Reader, ReadOptions
from jaxmap.datasets.base import StereoSequence
from jaxmap.datasets.poses import PosesWorld
from jaxmap.datasets.samples import open_sample
from jaxmap.errors import JaxmapError, UsageError

SAMPLE_PREFIX = "sample:"

READERS: dict[str, Reader] = {}


def register(reader: Reader) -> None:
    """Adds a reader.

    Raises:
        ValueError: the name is taken.
    """
    if reader.name in READERS or reader.name in ("auto", "sample"):
        raise ValueError(f"a reader named {reader.name} is registered already")
    READERS[reader.name] = reader


def open_sequence(source: str | Path, options: ReadOptions | None = None) -> StereoSequence:
    """Opens the folder of one sequence, or `sample:NAME` for a bundled one.

    Raises:
        UsageError: an option has no meaning.
        JaxmapError: the source is missing, no reader or more than one fits, or the data are faulty.
    """
    options = options or ReadOptions()
    _check_options(options)
    if str(source).startswith(SAMPLE_PREFIX):
        return open_sample(str(source).removeprefix(SAMPLE_PREFIX), options)
    folder = Path(source)
    if not folder.is_dir():
        what = f"{source} is a file" if folder.exists() else f"there is no folder {source}"
        raise JaxmapError(what, fix="give the folder of one sequence, or sample:NAME")
    if options.dataset != "auto":
        return _open_with(READERS[options.dataset], folder, options)
    fitting = [reader for reader in READERS.values() if reader.recognises(folder)]
    if not fitting:
        known = "; ".join(f"{reader.name}: {reader.help}" for reader in READERS.values())
        raise JaxmapError(
            "no data set is recognised", where=source, fix=f"looked for {known}. Give the folder of one sequence"
        )
    if len(fitting) > 1:
        names = " and ".join(reader.name for reader in fitting)
        raise JaxmapError(f"{names} both fit", where=source, fix="choose one with --dataset")
    return _open_with(fitting[0], folder, options)


def _open_with(reader: Reader, folder: Path, options: ReadOptions) -> StereoSequence:
    if options.camera is not None and options.camera not in reader.cameras:
        fix = f"choose {' or '.join(reader.cameras)}" if reader.cameras else "leave the option out"
        raise UsageError(f"{reader.name} has no camera {options.camera!r}", where="--camera", fix=fix)
    return reader.open(folder, options)


def _check_options(options: ReadOptions) -> None:
    if options.dataset not in ("auto", *READERS):
        raise UsageError(
            f"there is no reader {options.dataset!r}", where="--dataset", fix=f"choose auto, {', '.join(READERS)}"
        )
    if options.poses_world not in get_args(PosesWorld):
        raise UsageError(
            f"poses_world is {options.poses_world!r}", where="options", fix=f"choose {', '.join(get_args(PosesWorld))}"
        )
    if options.antenna_m is not None and not all(map(math.isfinite, options.antenna_m)):
        raise UsageError(f"antenna_m is {options.antenna_m}", where="options", fix="give three lengths in metres")
    if options.crs is not None:
        _check_crs(options.crs)
    if options.stride < 1:
        raise UsageError(f"stride is {options.stride}", where="options", fix="give a whole number from 1 on")
    if not (math.isfinite(options.max_pose_gap_s) and options.max_pose_gap_s > 0):
        raise UsageError(f"max_pose_gap_s is {options.max_pose_gap_s}", where="options", fix="give seconds above 0")


def _check_crs(name: str) -> None:
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        CRS.from_user_input(name)
    except (CRSError, ValueError) as error:
        raise UsageError(
            f"{name!r} is no coordinate reference system", where="--crs", fix="give EPSG:NUMBER"
        ) from error
