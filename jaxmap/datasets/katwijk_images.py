"""The stereo images of a Katwijk part, paired by the time in their names."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from jaxmap.datasets.base import FrameRef
from jaxmap.datasets.images import list_images
from jaxmap.datasets.katwijk_files import parse_time
from jaxmap.errors import JaxmapError

_NAME = re.compile(r"(?:[A-Za-z]+_)?(\d{4}(?:_\d{1,2}){5}_\d{1,4})_([01])", re.ASCII)


class Pairs(NamedTuple):
    """The frames in the order of time, and what was left out."""

    frames: list[FrameRef]
    notes: list[str]


def pair_images(folder: Path) -> Pairs:
    """Pairs `CAMERA_YYYY_MM_DD_HH_MM_SS_ms_0.png` (left) and `..._1.png` (right) of one time.

    Raises:
        JaxmapError: the folder is missing or empty, no name is of this form, or no images pair up.
    """
    sides: tuple[dict[float, Path], dict[float, Path]] = ({}, {})
    unnamed = repeated = 0
    for path in list_images(folder):
        match = _NAME.fullmatch(path.stem)
        time_s = parse_time(match[1]) if match else None
        if match is None or time_s is None:
            unnamed += 1
        elif time_s in sides[int(match[2])]:
            repeated += 1
        else:
            sides[int(match[2])][time_s] = path
    left, right = sides
    times_s = sorted(left.keys() & right.keys())
    if not times_s:
        raise JaxmapError(
            f"no pair among {len(left)} left and {len(right)} right images and {unnamed} of other names",
            where=folder,
            fix=f"name them {folder.name}_YYYY_MM_DD_HH_MM_SS_ms_0.png (left) and _1.png (right)",
        )
    frames = [FrameRef(left[time_s].stem, time_s, left[time_s], right[time_s]) for time_s in times_s]
    faults = {
        "have no partner of their time and are left out": len(left) + len(right) - 2 * len(times_s),
        "are of a time that was there before and are left out": repeated,
        "are not named by a time and a side and are left out": unnamed,
    }
    return Pairs(frames, [f"{folder.name}: {count} images {what}" for what, count in faults.items() if count])
