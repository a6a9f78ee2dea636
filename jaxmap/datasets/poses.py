"""Poses: reading and writing pose files, checking, interpolating, turning z-up, splitting off the site origin.

`T` maps points of the child frame (a camera or a body) into the world: `p_world = T @ p_child`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from jaxmap.datasets.options import PosesWorld
from jaxmap.datasets.text_files import data_lines
from jaxmap.errors import JaxmapError
from jaxmap.host.files import atomic_path

KNOT_TOLERANCE_S = 1e-3
"""A time this close to a pose takes it, even beyond the ends of a track and beside gaps."""

MAX_LOCAL_RANGE_M = 10_000.0
"""Smaller coordinates need no site origin: float32 resolves 1 mm there."""

T_Z_UP_CAMERA_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Turns a camera-like world (x right, y down, z forward) into a z-up one: x to x, z to y, -y to z."""

_TUM_COLUMNS, _KITTI_COLUMNS, _EUROC_MIN_COLUMNS = 8, 12, 8


@dataclass(frozen=True)
class PoseTrack:
    """Valid poses in the order of time; made by `make_pose_track`.

    Attributes:
        timestamps_s: float64 (N,), strictly increasing; None where the file carries no times (KITTI).
        T: float64 (N, 4, 4), rigid, T_world_camera or T_world_body.
        child: the frame that `T` takes into the world.
        where: the file, for error messages.
    """

    timestamps_s: np.ndarray | None
    T: np.ndarray
    child: Literal["camera", "body"] = "camera"
    where: str = "poses"


def make_pose_track(
    timestamps_s: np.ndarray | None,
    T: np.ndarray,
    *,
    child: Literal["camera", "body"] = "camera",
    where: object = "poses",
    lines: Sequence[int] | None = None,
) -> PoseTrack:
    """Checks and builds a `PoseTrack`; rotations are replaced by the nearest exact ones.

    Args:
        timestamps_s: (N,) or None.
        T: (N, 4, 4).
        child: the frame that `T` takes into the world.
        where: the file, for error messages.
        lines: the line of each pose in the file; without it errors count rows from 1.

    Raises:
        JaxmapError: no pose, a number that is not finite, a transform that is not rigid (within
            1e-3), or times that do not increase; with the line.
    """
    T = np.array(T, np.float64)
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        raise JaxmapError(f"poses have shape {T.shape}", where=where, fix="give 4x4 matrices")
    if not len(T):
        raise JaxmapError("no poses", where=where, fix="give at least one pose")

    def refuse(bad: np.ndarray, what: str, fix: str) -> None:
        if bad.any():
            row = int(np.argmax(bad))
            place = f"row {row + 1}" if lines is None else f"line {lines[row]}"
            raise JaxmapError(f"{what} at {place}", where=where, fix=fix)

    refuse(np.asarray(~np.isfinite(T).all(axis=(1, 2))), "a number that is not finite", "correct or remove the pose")
    R = T[:, :3, :3]
    with np.errstate(all="ignore"):
        error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        rigid = (error < 1e-3) & (np.linalg.det(R) > 0) & (np.abs(T[:, 3] - [0, 0, 0, 1]).max(axis=1) < 1e-9)
    refuse(~rigid, "the pose is not a rotation and a translation", "give rigid transforms")
    U, _, Vt = np.linalg.svd(R)
    T[:, :3, :3] = U @ Vt
    if timestamps_s is not None:
        timestamps_s = np.array(timestamps_s, np.float64)
        if timestamps_s.shape != (len(T),):
            raise JaxmapError(f"{len(T)} poses with {timestamps_s.size} timestamps", where=where)
        refuse(~np.isfinite(timestamps_s), "a timestamp that is not finite", "correct or remove the pose")
        backwards = np.diff(timestamps_s, prepend=-np.inf) <= 0
        refuse(backwards, "timestamps go back or repeat", "sort the poses by time and drop repeated ones")
    return PoseTrack(timestamps_s, T, child, str(where))


def read_poses(path: Path) -> PoseTrack:
    """Reads poses as TUM text, KITTI 3x4 text or EuRoC's ground-truth csv, recognised by content.

    TUM: `timestamp_s tx ty tz qx qy qz qw`. KITTI: twelve numbers, row-major 3x4, without times.
    EuRoC: comma-separated `timestamp_ns, px, py, pz, qw, qx, qy, qz, ...`, poses of the body.
    Empty lines and lines that start with `#` are ignored.

    Raises:
        JaxmapError: none of the three, a line of another length, a word that is not a number, a
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
    if by_comma and columns >= _EUROC_MIN_COLUMNS:
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
            raise JaxmapError(f"{value} is not a time", where=f"{path} line {line}", fix="correct the line")
    return values


def parse_ns(word: str, path: Path, line: int) -> int:
    """A timestamp in whole nanoseconds.

    Raises:
        JaxmapError: it is not one, with the line.
    """
    if not re.fullmatch(r"[0-9]{1,19}", word) or int(word) >= 2**63:
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


def with_timestamps(track: PoseTrack, timestamps_s: Float64[np.ndarray, "N"]) -> PoseTrack:
    """A track that carries no times, given those of the frames: one pose for each.

    Raises:
        JaxmapError: the counts differ.
    """
    if len(track.T) != len(timestamps_s):
        raise JaxmapError(
            f"{len(track.T)} poses for {len(timestamps_s)} frames",
            where=track.where,
            fix="poses without times need exactly one line per frame; TUM text carries times",
        )
    return replace(track, timestamps_s=np.array(timestamps_s, np.float64))


def poses_at(
    track: PoseTrack, timestamps_s: Float64[np.ndarray, "M"], max_gap_s: float
) -> tuple[Float64[np.ndarray, "M 4 4"], Bool[np.ndarray, "M"]]:
    """Poses at given times; translation is interpolated linearly, rotation along the shortest arc.

    Args:
        track: poses with timestamps.
        timestamps_s: the given times.
        max_gap_s: poses farther apart are not interpolated.

    Returns:
        T: (M, 4, 4), NaN where there is no pose. At the time of a pose it is that pose, exactly.
        has_pose: (M,), false outside the track and inside gaps, except within `KNOT_TOLERANCE_S` of a
            pose.

    Raises:
        JaxmapError: the track has no timestamps.
    """
    knots_s = track.timestamps_s
    if knots_s is None:
        raise JaxmapError("poses without times", where=track.where, fix="give poses with times (TUM text)")
    last = len(knots_s) - 1
    after = np.clip(np.searchsorted(knots_s, timestamps_s, side="right"), min(1, last), last)
    before = np.maximum(after - 1, 0)
    gap_s = knots_s[after] - knots_s[before]
    inside = (timestamps_s >= knots_s[before]) & (timestamps_s <= knots_s[after])
    inside &= gap_s <= max_gap_s + KNOT_TOLERANCE_S
    past_middle = np.abs(timestamps_s - knots_s[after]) < np.abs(timestamps_s - knots_s[before])
    nearest = np.where(past_middle, after, before)
    near = np.abs(timestamps_s - knots_s[nearest]) <= KNOT_TOLERANCE_S
    fraction = np.divide(timestamps_s - knots_s[before], gap_s, out=np.zeros(len(timestamps_s)), where=gap_s > 0)

    T = np.full((len(timestamps_s), 4, 4), np.nan)
    between = inside & (fraction > 0) & (fraction < 1)
    T[between] = _interpolate(track.T[before[between]], track.T[after[between]], fraction[between])
    on_knot = near & ~between
    T[on_knot] = track.T[nearest[on_knot]]
    return T, between | on_knot


def to_z_up(
    T: Float64[np.ndarray, "N 4 4"], world: PosesWorld
) -> tuple[Float64[np.ndarray, "N 4 4"], Float64[np.ndarray, "4 4"]]:
    """Camera poses in a z-up world, and the transform from their own world into it.

    A `camera` world (KITTI's) is x right, y down, z forward: x becomes x, z becomes y, -y becomes z.
    `auto` takes the world for a camera world if the mean of the cameras' up axes (-y) points clearly
    along its -y, else for z-up.
    """
    if world == "auto":
        up_world = -T[:, :3, 1].mean(axis=0)
        world = "camera" if -up_world[1] > 0.8 and -up_world[1] > abs(up_world[2]) else "z_up"
    T_world_source = T_Z_UP_CAMERA_WORLD.copy() if world == "camera" else np.eye(4)
    return T_world_source @ T, T_world_source


def split_site_origin(
    T: Float64[np.ndarray, "N 4 4"],
) -> tuple[Float64[np.ndarray, "N 4 4"], Float64[np.ndarray, "3"]]:
    """Poses relative to a site origin, so that UTM-sized numbers never enter float32.

    Returns:
        T: with positions relative to the origin, float64.
        site_origin: zero if all coordinates are within 10 km of zero, else the first position in
            whole metres.
    """
    positions = T[:, :3, 3]
    if (np.abs(positions) < MAX_LOCAL_RANGE_M).all():
        return T.copy(), np.zeros(3)
    site_origin = np.floor(positions[0])
    relative = T.copy()
    relative[:, :3, 3] -= site_origin
    return relative, site_origin


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


def _interpolate(T_before: np.ndarray, T_after: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    if not len(fraction):
        return T_before
    T = T_before.copy()
    R_before = T_before[:, :3, :3]
    turn = Rotation.from_matrix(R_before.transpose(0, 2, 1) @ T_after[:, :3, :3]).as_rotvec()
    T[:, :3, :3] = R_before @ Rotation.from_rotvec(fraction[:, None] * turn).as_matrix()
    T[:, :3, 3] += fraction[:, None] * (T_after[:, :3, 3] - T_before[:, :3, 3])
    return T
