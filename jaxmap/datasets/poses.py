"""Poses: reading and writing pose files, checking, interpolating, splitting off the site origin.

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

from jaxmap.datasets.options import QuaternionOrder, TimeUnit
from jaxmap.datasets.pose_axes import MAX_LOCAL_RANGE_M
from jaxmap.datasets.pose_faults import find_wild_poses
from jaxmap.datasets.pose_text import left_out, read_pose_text
from jaxmap.datasets.text_files import data_lines
from jaxmap.datasets.units import PER_SECOND, UNIT_NAMES
from jaxmap.errors import JaxmapError
from jaxmap.host.files import atomic_path

KNOT_TOLERANCE_S = 1e-3
"""A time this close to a pose takes it, even beyond the ends of a track and beside gaps."""

FEW_FRAMES, MOST_FRAMES = 0.5, 0.9
"""Times are in another unit where at most the first share of the frames has a pose, and then more than the second."""


@dataclass(frozen=True)
class PoseTrack:
    """Poses in the order of time; made by `make_pose_track`.

    Attributes:
        timestamps_s: float64 (N,), strictly increasing; None where the file carries no times (KITTI).
        T: float64 (N, 4, 4), rigid, T_world_camera or T_world_body; NaN throughout where the pose of that time is
            unusable.
        child: the frame that `T` takes into the world.
        where: the file, for error messages.
        lines: the line of each pose in the file; without it messages count rows from 1.
        quaternion: the order that quaternions were read in.
        time_unit: the unit that times were read in.
        notes: what was assumed in reading.
        faults: what of the file is left out.
    """

    timestamps_s: np.ndarray | None
    T: np.ndarray
    child: Literal["camera", "body"] = "camera"
    where: str = "poses"
    lines: tuple[int, ...] | None = None
    quaternion: Literal["xyzw", "wxyz"] = "xyzw"
    time_unit: TimeUnit = "s"
    notes: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()

    @property
    def usable(self) -> Bool[np.ndarray, "N"]:
        """Which times have a pose."""
        return np.asarray(np.isfinite(self.T).all(axis=(1, 2)))


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
        T: (N, 4, 4), NaN throughout where there is no pose.
        child: the frame that `T` takes into the world.
        where: the file, for error messages.
        lines: the line of each pose in the file; without it errors count rows from 1.

    Raises:
        JaxmapError: no pose, a number that is not finite among others that are, a transform that is not rigid
            (within 1e-3), or times that do not increase; with the line.
    """
    T = np.array(T, np.float64)
    if T.ndim != 3 or T.shape[1:] != (4, 4):
        raise JaxmapError(f"poses have shape {T.shape}", where=where, fix="give 4x4 matrices")
    absent = np.isnan(T).all(axis=(1, 2))
    if absent.all():
        raise JaxmapError("no poses", where=where, fix="give at least one pose")

    def refuse(bad: np.ndarray, what: str, fix: str) -> None:
        if bad.any():
            row = int(np.argmax(bad))
            place = f"row {row + 1}" if lines is None else f"line {lines[row]}"
            raise JaxmapError(f"{what} at {place}", where=where, fix=fix)

    broken = ~absent & ~np.isfinite(T).all(axis=(1, 2))
    refuse(np.asarray(broken), "a number that is not finite", "correct or remove the pose")
    R = T[:, :3, :3]
    with np.errstate(all="ignore"):
        error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        rigid = (error < 1e-3) & (np.linalg.det(R) > 0) & (np.abs(T[:, 3] - [0, 0, 0, 1]).max(axis=1) < 1e-9)
    refuse(~rigid & ~absent, "the pose is not a rotation and a translation", "give rigid transforms")
    U, _, Vt = np.linalg.svd(R[~absent])
    T[~absent, :3, :3] = U @ Vt
    if timestamps_s is not None:
        timestamps_s = np.array(timestamps_s, np.float64)
        if timestamps_s.shape != (len(T),):
            raise JaxmapError(f"{len(T)} poses with {timestamps_s.size} timestamps", where=where)
        refuse(~np.isfinite(timestamps_s), "a timestamp that is not finite", "correct or remove the pose")
        backwards = np.diff(timestamps_s, prepend=-np.inf) <= 0
        refuse(backwards, "timestamps go back or repeat", "sort the poses by time and drop repeated ones")
    return PoseTrack(timestamps_s, T, child, str(where), None if lines is None else tuple(lines))


def read_poses(path: Path, quaternion: QuaternionOrder = "auto", time_unit: TimeUnit = "auto") -> PoseTrack:
    """Reads a text of poses, one a line, its form recognised by content.

    - TUM: `timestamp tx ty tz qx qy qz qw`, separated by spaces, commas or semicolons.
    - KITTI: twelve or sixteen numbers, row-major 3x4 or 4x4, without times.
    - EuRoC and VINS: comma-separated `timestamp_ns, px, py, pz, qw, qx, qy, qz, ...`, poses of the body.
    - Any order of columns that a header names (`time`, `x y z`, `qx qy qz qw`, as TUM, EuRoC and ROS spell them).

    Empty lines, lines that start with `#`, `%` or `//`, a header and a separator at the end of a line are passed over.
    Times are in the unit that `time_unit` or the header says; else from 1e17 on in nanoseconds, from 1e14 on in
    microseconds, from 1e11 on in milliseconds, below in seconds, or in nanoseconds in EuRoC's form.

    Lines whose pose is not finite, or whose rotation is all zeros (tracking was lost), leave a time without a pose.
    Lines that repeat a time are left out, lines out of order are sorted; `faults` counts all of them.

    Args:
        path: the file.
        quaternion: the order of the four columns of the quaternion, where the form or the header does not say it.
        time_unit: the unit of the times, likewise.

    Raises:
        JaxmapError: none of these forms, a line of another length, a word that is not a number, a quaternion whose
            norm is not within 1e-2 of 1, or what `make_pose_track` refuses; with the line.
    """
    rows = read_pose_text(path, quaternion, time_unit)
    lines, times_s, T, faults = np.array(rows.lines, int), rows.times_s, rows.T, [*rows.faults]
    if times_s is not None and len(times_s):
        backwards = np.diff(times_s, prepend=times_s[0]) < 0
        if backwards.any():
            faults.append(f"times of the poses go back {backwards.sum()} times (line {lines[backwards][0]}): sorted")
        order = np.argsort(times_s, kind="stable")
        repeated = np.diff(times_s[order], prepend=-np.inf) == 0
        faults += left_out(repeated, lines[order].tolist(), "of a time that is there already")
        order = order[~repeated]
        lines, times_s, T = lines[order], times_s[order], T[order]
    track = make_pose_track(times_s, T, child=rows.child, where=path, lines=lines.tolist())
    return replace(
        track,
        quaternion=rows.quaternion,
        time_unit=rows.time_unit,
        notes=tuple(rows.notes),
        faults=tuple(f"{path.name}: {fault}" for fault in faults),
    )


def without_wild_poses(track: PoseTrack) -> PoseTrack:
    """A track with times, less the poses that a path cannot hold (`pose_faults.find_wild_poses`); `faults` tells.

    Raises:
        JaxmapError: the track has no timestamps.
    """
    knots_s = _knots_s(track)
    rows = np.flatnonzero(track.usable)
    found = find_wild_poses(knots_s[rows], track.T[rows])
    wild = np.zeros(len(track.T), bool)
    wild[rows[found.wild]] = True
    lines = track.lines or range(1, len(track.T) + 1)
    off = f"off the path by up to {found.away_m:.5g} m and {found.away_deg:.0f} deg"
    faults = [f"{Path(track.where).name}: {fault}" for fault in left_out(wild, lines, off)]
    notes = [*track.notes]
    if found.kept_jump_m:
        notes.append(f"the path of the poses jumps by {found.kept_jump_m:.3g} m: the map may show things twice")
    T = track.T.copy()
    T[wild] = np.nan
    return replace(track, T=T, notes=tuple(notes), faults=(*track.faults, *faults))


def read_timestamps(path: Path) -> Float64[np.ndarray, "N"]:
    """Reads times, one number per line, in the file's own unit.

    Raises:
        JaxmapError: a line is not one finite number, with the line.
    """
    values = []
    for line, text in data_lines(path):
        place = f"{path} line {line}"
        if len(text.split()) != 1:
            raise JaxmapError(f"{len(text.split())} columns, not 1", where=place, fix="correct or restore the file")
        try:
            values.append(float(text))
        except ValueError as fault:
            raise JaxmapError(f"{fault}"[:120], where=place, fix="correct or restore the file") from fault
        if not np.isfinite(values[-1]):
            raise JaxmapError(f"{values[-1]} is not a time", where=place, fix="correct the line")
    return np.array(values, np.float64)


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
            pose; false within that of a time whose pose is unusable.

    Raises:
        JaxmapError: the track has no timestamps.
    """
    all_knots_s, usable = _knots_s(track), track.usable
    knots_s, T_knots = all_knots_s[usable], track.T[usable]
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
    T[between] = _interpolate(T_knots[before[between]], T_knots[after[between]], fraction[between])
    on_knot = near & ~between
    T[on_knot] = T_knots[nearest[on_knot]]
    has_pose = between | on_knot
    if not usable.all():
        # A frame taken when tracking was lost is no place to trust a pose between others.
        lost_s = all_knots_s[~usable]
        after = np.searchsorted(lost_s, timestamps_s).clip(0, len(lost_s) - 1)
        from_lost_s = np.minimum(*(np.abs(timestamps_s - lost_s[row]) for row in (np.maximum(after - 1, 0), after)))
        has_pose &= on_knot | (from_lost_s > KNOT_TOLERANCE_S)
        T[~has_pose] = np.nan
    return T, has_pose


def in_unit_of_frames(track: PoseTrack, timestamps_s: Float64[np.ndarray, "M"], max_gap_s: float) -> PoseTrack:
    """A track with times; in another unit, which a note tells, where only so the times of the frames lie within it.

    Times that do not count from 1970 are too small to tell their unit.

    Args:
        track: as read from a file, in the unit that was assumed.
        timestamps_s: of the frames.
        max_gap_s: poses farther apart are not interpolated.
    """
    knots_s = _knots_s(track)
    if len(timestamps_s) < 2 or poses_at(track, timestamps_s, max_gap_s)[1].mean() > FEW_FRAMES:
        return track
    for unit, per_second in PER_SECOND.items():
        other = replace(track, timestamps_s=knots_s * (PER_SECOND[track.time_unit] / per_second), time_unit=unit)
        if unit != track.time_unit and poses_at(other, timestamps_s, max_gap_s)[1].mean() > MOST_FRAMES:
            note = f"times of the poses are taken for {UNIT_NAMES[unit]}, as those of the frames lie among them so"
            return replace(other, notes=(*track.notes, note))
    return track


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


def _knots_s(track: PoseTrack) -> np.ndarray:
    if track.timestamps_s is None:
        raise JaxmapError("poses without times", where=track.where, fix="give poses with times (TUM text)")
    return track.timestamps_s


def _interpolate(T_before: np.ndarray, T_after: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    if not len(fraction):
        return T_before
    T = T_before.copy()
    R_before = T_before[:, :3, :3]
    turn = Rotation.from_matrix(R_before.transpose(0, 2, 1) @ T_after[:, :3, :3]).as_rotvec()
    T[:, :3, :3] = R_before @ Rotation.from_rotvec(fraction[:, None] * turn).as_matrix()
    T[:, :3, 3] += fraction[:, None] * (T_after[:, :3, 3] - T_before[:, :3, 3])
    return T
