"""The texts that hold poses, recognised by content: TUM, KITTI, EuRoC and their many kin."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxmap.datasets.options import QuaternionOrder, TimeUnit
from jaxmap.datasets.text_files import read_text
from jaxmap.datasets.units import PER_SECOND, UNIT_NAMES, unit_by_size
from jaxmap.errors import JaxmapError

FORMS = "TUM text (8 columns), KITTI 3x4 text (12), EuRoC csv (8 or more, commas), or columns named in a header"

_TUM_COLUMNS, _EUROC_MIN_COLUMNS = 8, 8
_MATRIX_COLUMNS = (12, 16)
_WHOLE = re.compile(r"[0-9]{1,19}")
_UNIT_WORDS: dict[TimeUnit, str] = {
    "ns": r"ns|nsecs?|nano\w*",
    "us": r"us|usecs?|micro\w*",
    "ms": r"ms|msecs?|milli\w*",
    "s": r"s|secs?|seconds?",
}
_COMMENTS = ("#", "%", "//")
_NO_NUMBER = frozenset(("", "-nan", "nan(ind)", "-nan(ind)", "1.#qnan", "-1.#ind", "null", "none", "na", "n/a", "lost"))
_ROLES = ("x", "y", "z", "qx", "qy", "qz", "qw")
_LEAST_NORM = 1e-6
"""A quaternion or matrix of a smaller norm stands for "no pose"."""


class PoseRows(NamedTuple):
    """The poses of a file as they stand there.

    Attributes:
        lines: the line of each, from 1.
        times_s: (N,) finite, in the order of the file; None where it carries no times.
        T: (N, 4, 4), NaN where the line holds no pose.
        child: "body" where the form says that the poses are of a body.
        quaternion: the order that quaternions were read in.
        time_unit: the unit that times were read in.
        notes: what was assumed.
        faults: what was left out.
    """

    lines: list[int]
    times_s: np.ndarray | None
    T: np.ndarray
    child: Literal["camera", "body"]
    quaternion: Literal["xyzw", "wxyz"]
    time_unit: TimeUnit
    notes: list[str]
    faults: list[str]


class _Table(NamedTuple):
    """The words of a text, line by line, and those of its header."""

    path: Path
    header: list[str]
    separator: str | None
    lines: list[int]
    fields: list[list[str]]


class _Columns(NamedTuple):
    """Where a line has its position and its quaternion (x, y, z, w), and in which unit its time."""

    time: int
    position: tuple[int, ...]
    quaternion_xyzw: tuple[int, ...]
    unit: TimeUnit | None
    default_unit: TimeUnit = "s"
    child: Literal["camera", "body"] = "camera"


_TUM = _Columns(0, (1, 2, 3), (4, 5, 6, 7), None)
_EUROC = _Columns(0, (1, 2, 3), (5, 6, 7, 4), None, default_unit="ns", child="body")


def read_pose_text(path: Path, quaternion: QuaternionOrder = "auto", time_unit: TimeUnit = "auto") -> PoseRows:
    """Reads a text of poses, one a line; `poses.read_poses` describes the forms.

    Raises:
        JaxmapError: no form fits, a line of another length, a word that is not a number, or a quaternion whose norm
            is not within 1e-2 of 1; with the line.
    """
    table = _read_table(path)
    columns = _named_columns(table)
    if columns is None and len(table.fields[0]) in _MATRIX_COLUMNS:
        T, faults = _from_matrices(_numbers(table, range(len(table.fields[0]))), table)
        return PoseRows(table.lines, None, T, "camera", "xyzw", "s", [], faults)
    notes: list[str] = []
    if columns is None:
        columns = _columns_by_form(table, notes, told=quaternion != "auto" and time_unit != "auto")
    if quaternion != "auto":
        a, b, c, d = sorted(columns.quaternion_xyzw)
        columns = columns._replace(quaternion_xyzw=(a, b, c, d) if quaternion == "xyzw" else (b, c, d, a))
    order = "wxyz" if columns.quaternion_xyzw[3] == min(columns.quaternion_xyzw) else "xyzw"
    times_s, time_unit = _times(table, columns, time_unit, notes)
    timed = np.isfinite(times_s)
    faults = left_out(~timed, table.lines, "without a time")
    kept = [row for row, is_timed in enumerate(timed) if is_timed]
    table = table._replace(lines=[table.lines[row] for row in kept], fields=[table.fields[row] for row in kept])
    T, lost = _from_quaternions(_numbers(table, (*columns.position, *columns.quaternion_xyzw)), table)
    return PoseRows(table.lines, times_s[timed], T, columns.child, order, time_unit, notes, faults + lost)


def left_out(rows: np.ndarray, lines: Sequence[int], what: str) -> list[str]:
    """One line on poses that are left out, or nothing.

    Args:
        rows: (N,), which they are.
        lines: the line of each of the N poses.
        what: what is the matter with them.
    """
    count = int(rows.sum())
    if not count:
        return []
    named = [str(line) for line, bad in zip(lines, rows, strict=True) if bad]
    place = f"line{'s' * (count > 1)} {', '.join(named[:3])}{', ...' * (count > 3)}"
    return [f"{count} of {len(rows)} poses {what} ({place}) {'are' if count > 1 else 'is'} left out"]


def _read_table(path: Path) -> _Table:
    header, separator = "", None
    lines: list[int] = []
    fields: list[list[str]] = []
    for number, text in enumerate(read_text(path).split("\n"), start=1):
        text = text.strip()
        if not text or (lines and text.startswith(_COMMENTS)):
            continue
        if not lines and (text.startswith(_COMMENTS) or _is_header(text)):
            header = text.lstrip("#%/ ")
            continue
        if not lines:
            separator = _separator(text)
        lines.append(number)
        # Where semicolons separate, commas are decimal marks.
        fields.append(_words(text.replace(",", ".") if separator == ";" else text, separator))
    if not lines:
        raise JaxmapError("no poses", where=path, fix=f"give {FORMS}")
    header = re.sub(r"\s*([\[(][^\])]*[\])])", r"\1", header)
    return _Table(path, _words(header, _separator(header)), separator, lines, fields)


def _separator(text: str) -> str | None:
    return next((mark for mark in ";," if mark in text), None)


def _words(text: str, separator: str | None) -> list[str]:
    words = [word.strip().strip('"') for word in text.split(separator)]
    # VINS and others end each line with a comma.
    return words[:-1] if len(words) > 1 and not words[-1] else words


def _is_header(text: str) -> bool:
    """Whether a line has words, and no number at all."""
    words = [word for word in re.split(r"[\s,;]+", text) if word]
    return not any(_is_number(word) or word.lower() in _NO_NUMBER for word in words)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _named_columns(table: _Table) -> _Columns | None:
    """The columns by their names, as EuRoC, ROS and spreadsheets write them; None where a name is missing."""
    found: dict[str, int] = {}
    unit: TimeUnit | None = None
    for column, name in enumerate(table.header):
        bare = re.sub(r"[\[(].*", "", name.lower()).strip()
        role = _role(bare)
        if role is None or role in found:
            continue
        found[role] = column
        if role == "time":
            unit = next((unit for unit, words in _UNIT_WORDS.items() if _ends_in(name.lower(), words)), None)
    if not {"time", *_ROLES} <= found.keys():
        return None
    time, x, y, z, *quaternion_xyzw = (found[role] for role in ("time", *_ROLES))
    columns = _Columns(time, (x, y, z), tuple(quaternion_xyzw), unit)
    euroc = columns[:3] == _EUROC[:3] and _row_without_whole_time(table) is None
    return _EUROC._replace(unit=unit) if euroc else columns


def _row_without_whole_time(table: _Table) -> int | None:
    """The first row whose first word is no whole number; 0 where commas separate nothing."""
    if table.separator is None:
        return 0
    return next((row for row, words in enumerate(table.fields) if not _WHOLE.fullmatch(words[0])), None)


def _ends_in(name: str, unit_words: str) -> bool:
    return re.search(rf"[\[(_ ](?:{unit_words})[\])]?$", name) is not None


def _role(name: str) -> str | None:
    if re.match(r"time|stamp|t$|secs?$|seconds?$", name) or name.endswith("stamp"):
        return "time"
    stem, axis = name[:-1], name[-1:]
    if re.search(r"(^|[^a-z])q($|[^a-z])|quat|ori|rot", stem):
        return "q" + axis
    bare = re.sub(r"[^a-z]", "", stem)
    return axis if bare in ("", "t", "p", "pos") or re.search(r"position|translation|^p_", stem) else None


def _columns_by_form(table: _Table, notes: list[str], told: bool) -> _Columns:
    """The columns of TUM text, or of EuRoC's csv: by commas, with times in whole nanoseconds and w first.

    Args:
        table: the text.
        notes: takes what is assumed.
        told: whether the options say what would have to be assumed.
    """
    width, by_comma = len(table.fields[0]), table.separator is not None
    if by_comma and width >= _EUROC_MIN_COLUMNS:
        broken = _row_without_whole_time(table)
        if broken is None:
            return _EUROC
        if width > _TUM_COLUMNS and not told:
            raise JaxmapError(
                f"{table.fields[broken][0][:40]!r} is not a time in whole nanoseconds, as EuRoC's csv has",
                where=f"{table.path} line {table.lines[broken]}",
                fix="correct the line, or give both --quaternion and --poses-time-unit",
            )
        if not told:
            notes.append("poses with commas and times that are not whole are taken for TUM's columns, w last")
        return _TUM
    if width != _TUM_COLUMNS:
        raise JaxmapError(
            f"{width} {'comma-separated ' if by_comma else ''}columns do not make a pose",
            where=f"{table.path} line {table.lines[0]}",
            fix=f"give {FORMS}",
        )
    return _TUM


def _times(table: _Table, columns: _Columns, unit: TimeUnit, notes: list[str]) -> tuple[np.ndarray, TimeUnit]:
    """Times in s, (N,), not finite where a line has none, and the unit of the file.

    Whole numbers keep all digits that float64 holds.
    """
    numbers = _numbers(table, [columns.time])[:, 0]
    known = numbers[np.isfinite(numbers)]
    chosen = unit if unit != "auto" else columns.unit
    if chosen is None:
        chosen = unit_by_size(float(np.abs(known).max(initial=0.0))) or columns.default_unit
        if chosen != columns.default_unit:
            notes.append(f"times of the poses are taken for {UNIT_NAMES[chosen]}, by their size")
    divisor = PER_SECOND[chosen]
    words = (line[columns.time] for line in table.fields)
    exact = [
        int(word) / divisor if _WHOLE.fullmatch(word) else number / divisor
        for word, number in zip(words, numbers.tolist(), strict=True)
    ]
    return np.array(exact, np.float64), chosen


def _numbers(table: _Table, columns: Sequence[int]) -> np.ndarray:
    """(N, columns) float64, NaN where a word stands for no number."""
    width = len(table.fields[0]) if table.fields else 0
    values = np.empty((len(table.fields), len(columns)))
    for row, (line, words) in enumerate(zip(table.lines, table.fields, strict=True)):
        place, fix = f"{table.path} line {line}", "correct or restore the file"
        if len(words) != width:
            raise JaxmapError(f"{len(words)} columns, not {width}", where=place, fix=fix)
        try:
            for column, source in enumerate(columns):
                word = words[source]
                values[row, column] = np.nan if word.lower() in _NO_NUMBER else float(word)
        except (ValueError, IndexError) as fault:
            raise JaxmapError(f"{fault}"[:120], where=place, fix=fix) from fault
    return values


def _from_matrices(values: np.ndarray, table: _Table) -> tuple[np.ndarray, list[str]]:
    T = np.tile(np.eye(4), (len(values), 1, 1))
    T.reshape(-1, 16)[:, : values.shape[1]] = values
    return _without_lost(T, np.abs(values[:, [0, 1, 2, 4, 5, 6, 8, 9, 10]]).max(axis=1), table)


def _from_quaternions(values: np.ndarray, table: _Table) -> tuple[np.ndarray, list[str]]:
    with np.errstate(all="ignore"):
        norms = np.linalg.norm(values[:, 3:], axis=1)
    usable = norms >= _LEAST_NORM
    bad = usable & (np.abs(norms - 1) >= 1e-2) & np.isfinite(values).all(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise JaxmapError(
            f"the quaternion has norm {norms[row]:g}, not 1",
            where=f"{table.path} line {table.lines[row]}",
            fix="check the order of the columns, position before quaternion, or name them in a header",
        )
    T = np.tile(np.eye(4), (len(values), 1, 1))
    readable = usable & np.isfinite(values).all(axis=1)
    T[readable, :3, :3] = Rotation.from_quat(values[readable, 3:]).as_matrix().reshape(-1, 3, 3)
    T[:, :3, 3] = values[:, :3]
    T[~np.isfinite(norms)] = np.nan
    return _without_lost(T, norms, table)


def _without_lost(T: np.ndarray, norms: np.ndarray, table: _Table) -> tuple[np.ndarray, list[str]]:
    """Poses with NaN throughout where one number is not finite, or where the rotation is nothing but zeros."""
    broken = np.asarray(~np.isfinite(T).all(axis=(1, 2)))
    null = ~broken & (norms < _LEAST_NORM)
    T[broken | null] = np.nan
    return T, [
        *left_out(broken, table.lines, "with a number that is not finite"),
        *left_out(null, table.lines, "with a rotation of zeros"),
    ]
