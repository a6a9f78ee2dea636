"""The frames of a run: which were fused, and where the rectified left camera was at each."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int

from jaxmap.datasets.base import FrameRef
from jaxmap.datasets.poses import read_poses
from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import read_json, read_text
from jaxmap.host.files import atomic_path
from jaxmap.runs.folder import RunFolder
from jaxmap.types import Pinhole


class FrameRow(NamedTuple):
    """A row of `frames.csv`: index and name of a frame, its time, and why it was skipped (empty where it was fused)."""

    frame: int
    name: str
    timestamp_s: float
    skipped: str = ""


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


def rows_of(frames: Sequence[FrameRef], skipped: Mapping[str, str]) -> list[FrameRow]:
    """The table of a sequence, of which some frames were skipped: the reasons, by their names."""
    return [
        FrameRow(i, frame.name, float(frame.timestamp_s), skipped.get(frame.name, "")) for i, frame in enumerate(frames)
    ]


def write_frame_table(path: Path, rows: Iterable[FrameRow]) -> None:
    """Writes `frames.csv`, whose rows that are not skipped are those of `poses.tum`.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    buffer = io.StringIO()
    told = (row._replace(timestamp_s=repr(row.timestamp_s)) for row in rows)
    csv.writer(buffer, lineterminator="\n").writerows([FrameRow._fields, *told])
    with atomic_path(path) as temporary:
        temporary.write_text(buffer.getvalue(), encoding="utf-8")


def read_frame_table(folder: RunFolder, count: int) -> list[FrameRow]:
    """Reads `frames.csv`; none where it is lost, or does not fit so many poses."""
    try:
        rows = [
            FrameRow(int(row["frame"]), row["name"], float(row["timestamp_s"]), row["skipped"])
            for row in csv.DictReader(io.StringIO(read_text(folder.frames)))
        ]
    except (JaxmapError, ValueError, KeyError, TypeError, csv.Error):
        return []
    return rows if sum(not row.skipped for row in rows) == count else []


def read_run_frames(folder: RunFolder, site_origin: Float64[np.ndarray, "3"]) -> RunFrames:
    """Reads `poses.tum`, and beside it `frames.csv` and `metrics.json` as far as they are there and fit.

    Raises:
        JaxmapError: the poses are missing or cannot be read.
    """
    track, notes = read_poses(folder.poses), []
    count = len(track.T)
    index, names = np.arange(count), ()
    if fused := [row for row in read_frame_table(folder, count) if not row.skipped]:
        index, names = np.array([row.frame for row in fused]), tuple(row.name for row in fused)
    else:
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
