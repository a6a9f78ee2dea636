"""Reading and writing pose files: TUM, KITTI and EuRoC text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from jaxmap.datasets.calibration import data_lines
from jaxmap.datasets.poses import PoseTrack, make_pose_track
from jaxmap.errors import JaxmapError
from jaxmap.host.files import atomic_path

_TUM_COLUMNS, _KITTI_COLUMNS, _EUROC_LEAST_COLUMNS = 8, 12, 8


def read_poses(path: Path) -> PoseTrack:
    """Reads poses as TUM text, KITTI 3x4 text or EuRoC's ground-truth csv, told apart by content.

    TUM: `timestamp_s tx ty tz qx qy qz qw`. KITTI: twelve numbers, row-major 3x4, without times.
    EuRoC: comma-separated `timestamp_ns, px, py, pz, qw, qx, qy, qz, ...`, poses of the body.
    Empty lines and lines that start with `#` are passed over.

    Raises:
        JaxmapError: none of the three, a line of another length, a word that is no number, a
            quaternion whose norm is not within 1e-2 of 1, or what `make_pose_track` refuses; with
            the line.
    """
    rows = data_lines(path)
    if not rows:
        raise JaxmapError("no poses", where=path, fix="give TUM text, KITTI 3x4 text or EuRoC csv")
    lines = [line for line, _ in rows]
    by_comma = "," in rows[0][1]
    fields = [[word.strip() for word in text.split(",")] if by_comma else text.split() for _, text in rows]
    columns = len(fields[0])
    if by_comma and columns >= _EUROC_LEAST_COLUMNS:
        timestamps_s = np.array(
            [parse_ns(words[0], path, line) / 1e9 for line, words in zip(lines, fields, strict=True)]
        )
        values = _numbers(fields, path, lines, columns)
        T = _from_quaternions(values[:, 1:4], values[:, [5, 6, 7, 4]], path, lines)
        return make_pose_track(timestamps_s, T, child="body", where=path, lines=lines)
    if not by_comma and columns == _TUM_COLUMNS:
        values = _numbers(fields, path, lines, columns)
        T = _from_quaternions(values[:, 1:4], values[:, 4:8], path, lines)
        return make_pose_track(values[:, 0], T, where=path, lines=lines)
    if not by_comma and columns == _KITTI_COLUMNS:
        T = np.tile(np.eye(4), (len(lines), 1, 1))
        T[:, :3] = _numbers(fields, path, lines, columns).reshape(-1, 3, 4)
        return make_pose_track(None, T, where=path, lines=lines)
    raise JaxmapError(
        f"{columns} {'comma-separated ' if by_comma else ''}columns do not make a pose",
        where=f"{path} line {lines[0]}",
        fix="give TUM text (8 columns), KITTI 3x4 text (12) or EuRoC csv (8 or more, commas)",
    )


def read_timestamps(path: Path) -> Float64[np.ndarray, "N"]:
    """Reads times, one number per line, in the file's own unit.

    Raises:
        JaxmapError: a line is not one finite number, with the line.
    """
    rows = data_lines(path)
    values = _numbers([text.split() for _, text in rows], path, [line for line, _ in rows], 1)[:, 0]
    for (line, _), value in zip(rows, values, strict=True):
        if not np.isfinite(value):
            raise JaxmapError(f"{value} is no time", where=f"{path} line {line}", fix="correct the line")
    return values


def parse_ns(word: str, path: Path, line: int) -> int:
    """A timestamp in whole nanoseconds.

    Raises:
        JaxmapError: it is none, with the line.
    """
    if not re.fullmatch(r"[0-9]{1,19}", word):
        raise JaxmapError(
            f"{word[:40]!r} is not a time in whole nanoseconds", where=f"{path} line {line}", fix="correct the line"
        )
    return int(word)


def write_tum(path: Path, timestamps_s: Float64[np.ndarray, "N"], T: Float64[np.ndarray, "N 4 4"]) -> None:
    """Writes TUM text, `timestamp tx ty tz qx qy qz qw`, with every digit of float64.

    Raises:
        JaxmapError: the file cannot be written.
    """
    quaternions_xyzw = Rotation.from_matrix(T[:, :3, :3]).as_quat(canonical=True).reshape(-1, 4)
    table = np.column_stack([timestamps_s, T[:, :3, 3], quaternions_xyzw])
    rows = (" ".join(repr(float(value)) for value in row) for row in table)
    text = "\n".join(["# timestamp_s tx ty tz qx qy qz qw", *rows]) + "\n"
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _numbers(fields: list[list[str]], path: Path, lines: Sequence[int], columns: int) -> np.ndarray:
    values = np.empty((len(fields), columns))
    for row, (line, words) in enumerate(zip(lines, fields, strict=True)):
        if len(words) != columns:
            raise JaxmapError(
                f"{len(words)} columns, not {columns}", where=f"{path} line {line}", fix="correct or restore the file"
            )
        try:
            values[row] = [float(word) for word in words]
        except ValueError as fault:
            raise JaxmapError(
                f"{fault}"[:120], where=f"{path} line {line}", fix="correct or restore the file"
            ) from fault
    return values


def _from_quaternions(
    positions: np.ndarray, quaternions_xyzw: np.ndarray, path: Path, lines: Sequence[int]
) -> np.ndarray:
    with np.errstate(all="ignore"):
        norms = np.linalg.norm(quaternions_xyzw, axis=1)
    bad = ~(np.abs(norms - 1) < 1e-2)
    if bad.any():
        row = int(np.argmax(bad))
        raise JaxmapError(
            f"the quaternion has norm {norms[row]:g}, not 1",
            where=f"{path} line {lines[row]}",
            fix="check the order of the columns",
        )
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(quaternions_xyzw).as_matrix()
    T[:, :3, 3] = positions
    return T
