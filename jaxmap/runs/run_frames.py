"""The frames of a run: which were fused, and where the rectified left camera was at each."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int

from jaxmap.datasets.base import FrameRef
from jaxmap.datasets.poses import read_poses
from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import read_json, read_text
from jaxmap.host.files import atomic_path
from jaxmap.runs.folder import RunFolder
from jaxmap.types import Pinhole

_COLUMNS = ("frame", "name", "timestamp_s", "skipped")


@dataclass(frozen=True, eq=False)
class RunFrames:
    """The fused frames of a run.

    Attributes:
        index: of each in its sequence.
        names: of the left images, without suffix; none where the run does not know them.
        timestamps_s: float64 (N,).
        T_world_camera: (N, 4, 4), rectified left camera, relative to the site origin.
        camera: the rectified camera, or None where the run does not know it.
        size_px: width and height of its image.
        max_range_m: greatest depth that was mapped.
        notes: what the run does not know, as it was made before it was kept or has lost it.
    """

    index: Int[np.ndarray, "N"]
    names: tuple[str, ...]
    timestamps_s: Float64[np.ndarray, "N"]
    T_world_camera: Float64[np.ndarray, "N 4 4"]
    camera: Pinhole | None
    size_px: tuple[int, int]
    max_range_m: float
    notes: tuple[str, ...]


def write_frame_table(path: Path, frames: Sequence[FrameRef], skipped: Mapping[str, str]) -> None:
    """Writes `frames.csv`: index, name and time of each frame, and why it was skipped (empty where it was fused).

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    rows = [
        (i, frame.name, repr(float(frame.timestamp_s)), skipped.get(frame.name, "")) for i, frame in enumerate(frames)
    ]
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows([_COLUMNS, *rows])
    with atomic_path(path) as temporary:
        temporary.write_text(buffer.getvalue(), encoding="utf-8")


def read_run_frames(folder: RunFolder, site_origin: Float64[np.ndarray, "3"]) -> RunFrames:
    """Reads `poses.tum`, and beside it `frames.csv` and `metrics.json` as far as they are there and fit.

    Raises:
        JaxmapError: the poses are missing or cannot be read.
    """
    track, notes = read_poses(folder.poses), []
    count = len(track.T)
    index, names = np.arange(count), ()
    try:
        rows = [row for row in csv.DictReader(io.StringIO(read_text(folder.frames))) if not row["skipped"]]
        if len(rows) != count:
            raise ValueError
        index, names = np.array([int(row["frame"]) for row in rows]), tuple(row["name"] for row in rows)
    except (JaxmapError, ValueError, KeyError, TypeError, csv.Error):
        notes.append(f"no {folder.frames.name} that fits the poses: frames have no names, and count as they were fused")
    T, camera, size_px, max_range_m = track.T.copy(), None, (0, 0), 10.0
    T[:, :3, 3] -= site_origin
    try:
        metrics = read_json(folder.metrics)
        numbers: dict[str, Any] = metrics["camera"]
        camera = Pinhole(*(float(numbers[name]) for name in Pinhole._fields))
        size_px = (int(numbers["width_px"]), int(numbers["height_px"]))
        max_range_m = float(metrics["grid"]["depth_range_m"][1])
        T = T @ np.array(numbers["T_raw_rectified"], np.float64).reshape(4, 4)
    except (JaxmapError, ValueError, KeyError, TypeError, IndexError) as error:
        lost = "how images were rectified" if error.args == ("T_raw_rectified",) else "the camera"
        notes.append(f"{folder.metrics.name} does not tell {lost}")
    times_s = np.arange(count, dtype=np.float64) if track.timestamps_s is None else track.timestamps_s
    return RunFrames(index, names, times_s, T, camera, size_px, max_range_m, tuple(notes))
