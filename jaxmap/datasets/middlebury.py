"""Middlebury stereo scenes (2014 and 2021): `calib.txt`, `im0.png`, `im1.png`, and true disparity in `disp0.pfm`.

Scharstein et al. 2014, "High-resolution stereo datasets with subpixel-accurate ground truth".
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from jaxmap.datasets.base import FrameRef, Reader, StereoSequence, assemble, read_pose_track
from jaxmap.datasets.calibration import read_camera_yaml
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.poses import make_pose_track
from jaxmap.datasets.projections import camera_of_projections
from jaxmap.datasets.text_files import data_lines
from jaxmap.errors import JaxmapError
from jaxmap.types import StereoCamera

TRUTH = "disp0.pfm"

_MOST_PX = 2**28


def recognises(folder: Path) -> bool:
    """Whether the folder holds `calib.txt`, `im0.png` and `im1.png`."""
    return all((folder / name).is_file() for name in ("calib.txt", "im0.png", "im1.png"))


def open_middlebury(folder: Path, options: ReadOptions) -> StereoSequence:
    """Opens one scene as a sequence of one frame, whose camera stands at the origin and looks along z.

    Raises:
        JaxmapError: a file is missing or malformed.
    """
    camera, disparities = read_calibration(folder / "calib.txt")
    return assemble(
        name=f"middlebury_{Path(os.path.abspath(folder)).name}",
        dataset="middlebury",
        where=folder,
        frames=[FrameRef("im0", 0.0, folder / "im0.png", folder / "im1.png")],
        track=read_pose_track(options, folder) if options.poses else make_pose_track(np.zeros(1), np.eye(4)[None]),
        camera=read_camera_yaml(options.calibration) if options.calibration else camera,
        options=options,
        notes=[f"disparities reach {disparities} px by calib.txt (--stereo.num-disparities)"] * bool(disparities),
        true_disparity=read_truth if (folder / TRUTH).is_file() else None,
    )


def read_truth(frame: FrameRef) -> Float32[np.ndarray, "H W"] | None:
    """The true disparity of the left image in pixels, NaN where unknown; None where there is none.

    Raises:
        JaxmapError: the file is damaged.
    """
    path = frame.left.parent / TRUTH
    return read_pfm(path) if path.is_file() else None


def read_calibration(path: Path) -> tuple[StereoCamera, int | None]:
    """The camera of `calib.txt`, and how many disparities it asks to search, where it says so.

    `cam0` and `cam1` are camera matrices `[f 0 cx; 0 f cy; 0 0 1]`, `baseline` is in mm; `doffs` is the difference of
    their principal points and need not be there.

    Raises:
        JaxmapError: a line is missing or malformed.
    """
    values: dict[str, np.ndarray] = {}
    for line, text in data_lines(path):
        key, _, value = text.partition("=")
        try:
            values[key.strip()] = np.array([float(word) for word in re.split(r"[\s;,]+", value.strip("[] \t"))])
        except ValueError as fault:
            raise JaxmapError(f"{key[:20]} is no number", where=f"{path} line {line}", fix="restore it") from fault
    counts = {"cam0": 9, "cam1": 9, "baseline": 1, "width": 1, "height": 1}
    wrong = [key for key, count in counts.items() if values.get(key, np.zeros(0)).size != count]
    if wrong:
        raise JaxmapError(
            f"{', '.join(wrong)} missing or of another count of numbers", where=path, fix="restore the file"
        )
    P_left, P_right = (np.column_stack([values[key].reshape(3, 3), np.zeros(3)]) for key in ("cam0", "cam1"))
    P_right[0, 3] = -P_left[0, 0] * float(values["baseline"][0]) / 1000
    width, height, disparities = (values.get(key, np.zeros(1))[0] for key in ("width", "height", "ndisp"))
    if not all(1 <= length < 2**20 and length % 1 == 0 for length in (width, height)):
        raise JaxmapError(f"width and height are {width:g} and {height:g}", where=path, fix="restore the file")
    return camera_of_projections(P_left, P_right, (int(width), int(height)), path), int(disparities) or None


def read_pfm(path: Path) -> Float32[np.ndarray, "H W"]:
    """Reads a portable float map of one channel, top row first; infinite values, Middlebury's unknown, become NaN.

    The header is `Pf`, width and height, and a scale whose sign gives the order of bytes (negative: little-endian);
    rows are stored from the bottom up.

    Raises:
        JaxmapError: the file is missing, damaged or has three channels.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(256)
            found = re.match(rb"Pf\s+([0-9]{1,7})\s+([0-9]{1,7})\s+([-+0-9.eE]{1,20})\s", head)
            if found is None:
                raise ValueError("it does not start with Pf, width, height and scale")
            width, height, scale = int(found[1]), int(found[2]), float(found[3])
            size = width * height
            if not 0 < size <= _MOST_PX or scale == 0 or os.fstat(file.fileno()).st_size < found.end() + 4 * size:
                raise ValueError(f"it does not hold {width}x{height} numbers")
            file.seek(found.end())
            values = np.frombuffer(file.read(4 * size), "<f4" if scale < 0 else ">f4")
    except (OSError, ValueError) as fault:
        raise JaxmapError(f"the float map cannot be read ({fault})", where=path, fix="restore the file") from fault
    disparity_px = values.reshape(height, width)[::-1].astype(np.float32)
    disparity_px[~np.isfinite(disparity_px)] = np.nan
    return disparity_px


READER = Reader("middlebury", "a Middlebury scene with calib.txt, im0.png and im1.png", recognises, open_middlebury)
