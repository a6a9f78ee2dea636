"""The text files of a Katwijk part: GPS, IMU, odometry and pan-tilt unit.

Each line is a time and numbers, separated by spaces, without a header. Rovers crash and disks fill
up, so lines that are cut, garbled, out of order or repeated are left out or sorted, and counted; a
file of which most lines are bad is refused.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from jaxmap.datasets.geodesy import to_utm, utm_crs
from jaxmap.errors import JaxmapError
from jaxmap.localisation.sensors import GpsFixes, ImuLog, WheelLog

GPS_FILES = ("gps-latlong.txt", "gps-utm31.txt")

WHEEL_RADIUS_M = 0.12
"""A first guess (the estimate betters it): the IMU's height over the ground less the wheel axles' depth below it."""

STANDING_RATE = 0.015
"""Wheels that turn no faster, in rad/s, stand: 2 mm/s, and above the noise of the mean of some rates."""

STANDING_SAMPLES = 9
"""So many rates are averaged for that, 0.7 s."""

LEAST_GPS_SIGMA_M = 0.005
"""Receivers report less at times; the antenna's mast sways more."""

_TIME = re.compile(r"(\d{4}_\d{1,2}_\d{1,2}_\d{1,2}_\d{1,2}_\d{1,2})_(\d{1,4})", re.ASCII)

_WHEELS = 6
"""Drive joints come first in `odometry.txt`, three columns each: front left and right, centre, rear."""


class Gps(NamedTuple):
    """GPS fixes in UTM, and which UTM."""

    fixes: GpsFixes
    crs: str
    statuses: dict[str, int]


class Table(NamedTuple):
    """A text file as read: times in s, the columns of numbers, words, and what was left out."""

    timestamps_s: np.ndarray
    values: np.ndarray
    words: list[str]
    notes: list[str]


def parse_time(text: str) -> float | None:
    """Unix time in s of `YYYY_MM_DD_HH_MM_SS_ms` (UTC), or None.

    The milliseconds are a whole number without leading zeros: `_36_29` is 36.029 s, and `_36_1000` is 37 s.
    """
    match = _TIME.fullmatch(text)
    if match is None or int(match[2]) > 1000:
        return None
    second = _whole_second(match[1])
    return None if second is None else second + int(match[2]) / 1000


@lru_cache(maxsize=8)
def _whole_second(text: str) -> float | None:
    try:
        return datetime(*map(int, text.split("_")), tzinfo=UTC).timestamp()
    except ValueError:
        return None


def read_gps(folder: Path) -> tuple[Gps, list[str]]:
    """The fixes of a part: `time status lat lon alt sd_N sd_E sd_U`, from the first of `GPS_FILES` there is.

    Both files hold latitude and longitude in the parts seen; UTM is told by its magnitude.

    Raises:
        JaxmapError: there is no such file, or most of it is bad.
    """
    path = next((folder / name for name in GPS_FILES if (folder / name).is_file()), None)
    if path is None:
        raise _no_poses(f"no GPS: there is neither {' nor '.join(GPS_FILES)}", folder)
    table = _read_table(path, 6, _is_fix, word=True)
    first, second, altitude, sd_north, sd_east, sd_up = table.values.T
    if np.median(np.abs(first)) <= 90 and np.median(np.abs(second)) <= 360:
        crs = utm_crs(float(np.median(second)), float(np.median(first)))
        east, north = to_utm(crs, second, first)
    else:
        # An easting has six digits before the point, a northing of temperate latitudes seven.
        east, north = (second, first) if np.median(first) > np.median(second) else (first, second)
        crs = "EPSG:32631"
    sigma_m = np.maximum(np.stack([sd_east, sd_north, sd_up], axis=-1), LEAST_GPS_SIGMA_M)
    fixes = GpsFixes(table.timestamps_s, np.stack([east, north, altitude], axis=-1), sigma_m)
    statuses = {word: table.words.count(word) for word in sorted(set(table.words))}
    return Gps(fixes, crs, statuses), table.notes


def read_imu(folder: Path) -> tuple[ImuLog, list[str]]:
    """`time acc_xyz gyro_xyz inclinometer_xyz` in m/s2 and rad/s, turned from x backward, y right to x forward, y left.

    Raises:
        JaxmapError: there is no such file, or most of it is bad.
    """
    table = _read_table(folder / "imu.txt", 9, lambda row: max(map(abs, row)) < 200)
    forward_left_up = np.array([-1.0, -1.0, 1.0])
    rate, force = table.values[:, 3:6] * forward_left_up, table.values[:, 6:9] * forward_left_up
    return ImuLog(table.timestamps_s, rate, force), table.notes


def read_wheels(folder: Path) -> tuple[WheelLog | None, list[str]]:
    """The rover's speed from `odometry.txt`; None where the file is missing.

    A line holds angle, rate and an analogue value of six drive and four steering joints, and three
    angles of the chassis. The speed is the mean of the median wheel of either side, so that one
    wheel that slips or fails does not count, and turning on the spot gives none.

    Raises:
        JaxmapError: most of the file is bad.
    """
    path = folder / "odometry.txt"
    if not path.is_file():
        return None, [f"there is no {path.name}: between the fixes the rover is taken to go on as it went"]
    table = _read_table(path, 33, lambda row: max(map(abs, row[1 : 3 * _WHEELS : 3])) < 100)
    rates = table.values[:, 1 : 3 * _WHEELS : 3]
    sides = np.median(rates[:, 0::2], axis=1), np.median(rates[:, 1::2], axis=1)
    turning = np.abs(uniform_filter1d(rates, STANDING_SAMPLES, axis=0)).max(axis=1) > STANDING_RATE
    return WheelLog(table.timestamps_s, WHEEL_RADIUS_M * (sides[0] + sides[1]) / 2, turning), table.notes


def read_pan_tilt(folder: Path) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Times (N,) in s and pan and tilt (N, 2) in rad from `ptu.txt`.

    Raises:
        JaxmapError: there is no such file, or most of it is bad.
    """
    table = _read_table(folder / "ptu.txt", 2, lambda row: max(map(abs, row)) <= 2 * np.pi)
    return table.timestamps_s, table.values, table.notes


def _is_fix(row: list[float]) -> bool:
    first, second, altitude, *sigmas = row
    on_earth = max(abs(first), abs(second)) < 1e7 and abs(altitude) < 1e4
    return on_earth and min(sigmas) >= 0 and 0 < max(sigmas) < 1e3


def _read_table(path: Path, columns: int, plausible: Callable[[list[float]], bool], *, word: bool = False) -> Table:
    """The good lines of a file in the order of time; `word`: the second column is text."""
    try:
        lines = [line for line in path.read_bytes().split(b"\n") if line.strip()]
    except OSError as fault:
        raise _no_poses(f"no {path.name} ({fault.strerror})", path.parent) from fault
    times, rows, words = [], [], []
    for line in lines:
        fields = line.decode("utf-8", "replace").split()
        time_s = parse_time(fields[0]) if len(fields) == 1 + word + columns else None
        row = _numbers(fields[1 + word :])
        if time_s is None or row is None or not plausible(row):
            continue
        times.append(time_s)
        rows.append(row)
        words.append(fields[1] if word else "")
    if not rows or len(rows) < len(lines) / 2:
        raise _no_poses(f"{len(lines) - len(rows)} of {len(lines)} lines cannot be read", path)
    timestamps_s = np.array(times)
    order = np.argsort(timestamps_s, kind="stable")
    kept = order[np.diff(timestamps_s[order], prepend=-np.inf) > 0]
    faults = {
        "that cannot be read are left out": len(lines) - len(rows),
        "out of order are sorted": int((np.diff(timestamps_s) < 0).sum()),
        "of a time that was there before are left out": len(order) - len(kept),
    }
    notes = [f"{path.name}: {count} of {len(lines)} lines {what}" for what, count in faults.items() if count]
    return Table(timestamps_s[kept], np.array(rows)[kept], [words[index] for index in kept], notes)


def _numbers(fields: list[str]) -> list[float] | None:
    """Finite numbers, or None."""
    try:
        row = [float(field) for field in fields]
    except ValueError:
        return None
    return row if np.isfinite(row).all() else None


def _no_poses(what: str, where: object) -> JaxmapError:
    fix = "restore the file, or give --poses FILE (TUM text, T_world_camera of the left camera in UTM)"
    return JaxmapError(what, where=where, fix=fix)
