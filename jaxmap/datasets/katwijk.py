"""ESA's Katwijk Beach rover: raw LocCam or PanCam pairs, GPS, IMU, inclinometer and wheels.

The numbers of the rover are those of the data set's documents (Hewitt et al. 2018, "The Katwijk beach planetary rover
dataset", International Journal of Robotics Research 37(1)). Its IMU frame is x backward, y right, z up; camera frames
are x right, y down, z forward; the body frame of `localisation` is x forward, y left, z up.

In the text files each line is a time and numbers, separated by spaces, without a header. Rovers crash and disks fill
up, so lines that are cut, garbled, out of order or repeated are left out or sorted, and counted; a file of which most
lines are unreadable is refused.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from jaxmap.datasets.base import UNPOSED, FrameRef, Reader, StereoSequence, assemble, read_pose_track
from jaxmap.datasets.calibration_files import read_calibration
from jaxmap.datasets.crs import to_utm, utm_crs
from jaxmap.datasets.images import list_images
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.poses import PoseTrack, make_pose_track
from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import MOST_TEXT_BYTES
from jaxmap.host.files import config_folder, read_bytes
from jaxmap.localisation.estimate import estimate_poses, estimate_up
from jaxmap.localisation.sensors import GpsFixes, ImuLog, RoverGeometry, WheelLog, time_to_nearest

Log = TypeVar("Log", GpsFixes, ImuLog, WheelLog)

CRS = "EPSG:32631"
"""UTM zone 31 north, the coordinates of Katwijk and of poses given for a part."""

GPS_FILES = ("gps-latlong.txt", "gps-utm31.txt")

MAX_TIME_FROM_FRAMES_S = 3600.0
"""Records farther from all frames are ignored; a garbled line can name any year."""

MAX_TIME_FROM_FIX_S = 5.0
"""Frames farther from any GPS fix are counted; fixes come every 3 s."""

MAX_TIME_FROM_PAN_TILT_S = 1.0
"""Frames farther from any reading of the pan-tilt unit are counted."""

ANTENNA_IMU_M = (0.221, -0.052, 1.5785)
"""The GPS antenna in the IMU frame. Sources differ on its height (1.503 m): `ReadOptions.antenna_m` sets it."""

IMU_HEIGHT_M = 0.543
"""Height of the IMU above the ground: LocCam is 1.10 m above the ground and 0.557 m above the IMU."""

TURNING_CENTRE_M = -0.05
"""First guess, between the IMU and the axle of the centre wheels, 0.11 m behind it."""

R_BODY_IMU = np.diag([-1.0, -1.0, 1.0])

WHEEL_RADIUS_M = 0.12
"""First guess, refined by the estimate: the height of the IMU above the ground minus that above the wheel axles."""

STANDING_RATE_RAD_S = 0.015
"""Wheels that turn no faster stand: 2 mm/s on the ground, above the noise of the averaged rates."""

STANDING_SAMPLES = 9
"""Rates averaged for that, 0.7 s."""

MIN_GPS_SIGMA_M = 0.005
"""Receivers sometimes report less, but the antenna's mast sways more."""

_WHEELS = 6
"""Drive joints come first in `odometry.txt`, three columns each: front left and right, centre, rear."""

_TIME = re.compile(r"(\d{4}_\d{1,2}_\d{1,2}_\d{1,2}_\d{1,2}_\d{1,2})_(\d{1,4})", re.ASCII)
_IMAGE_NAME = re.compile(r"(?:[A-Za-z]+_)?(\d{4}(?:_\d{1,2}){5}_\d{1,4})_([01])", re.ASCII)


def _transform(translation_m: Sequence[float], quaternion_xyzw: Sequence[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quaternion_xyzw).as_matrix()
    T[:3, 3] = translation_m
    return T


@dataclass(frozen=True)
class RoverCamera:
    """One stereo camera of the rover.

    Attributes:
        folder: the folder of its images in a part.
        T_mount_camera: (4, 4), the left optical frame in the frame of its mount.
        T_imu_mount: (4, 4), the mount in the IMU frame, at zero pan and tilt.
        on_pan_tilt: whether the mount is the pan-tilt unit of `ptu.txt`.
    """

    folder: str
    T_mount_camera: np.ndarray
    T_imu_mount: np.ndarray
    on_pan_tilt: bool = False


CAMERAS = {
    "loccam": RoverCamera(
        folder="LocCam",
        T_mount_camera=_transform((-0.382, -0.078, 0.557), (0.572, 0.572, -0.416, -0.416)),
        T_imu_mount=np.eye(4),
    ),
    "pancam": RoverCamera(
        folder="PanCam",
        T_mount_camera=_transform((0.010, 0.250, 0.054), (0.5, -0.5, 0.5, -0.5)),
        T_imu_mount=_transform((-0.138, -0.005, 1.286), (0.0, 0.0, 1.0, 0.0)),
        on_pan_tilt=True,
    ),
}
"""The cameras by the names that `ReadOptions.camera` takes; the first is the default."""


class GpsLog(NamedTuple):
    """GPS fixes in UTM, the UTM zone, and how many fixes have each status."""

    fixes: GpsFixes
    crs: str
    statuses: dict[str, int]


class LogTable(NamedTuple):
    """A text file as read: times in s, the columns of numbers, the words of the second column, and notes."""

    timestamps_s: np.ndarray
    values: np.ndarray
    words: list[str]
    notes: list[str]


def recognises(folder: Path) -> bool:
    """Whether the folder is a part (it holds `LocCam` or `PanCam`), or holds parts, which `open_katwijk` then lists."""
    return _is_part(folder) or bool(find_parts(folder))


def find_parts(folder: Path) -> list[Path]:
    """The parts in a folder: flat (`PartN`) or by traverses (`TraverseM/PartN`), in their order."""
    inside = _subfolders(folder)
    found = [path for path in inside if _is_part(path)]
    return found + [path for outer in inside if outer not in found for path in _subfolders(outer) if _is_part(path)]


def open_katwijk(folder: Path, options: ReadOptions) -> StereoSequence:
    """Opens one part, the folder that holds `LocCam`; its images are raw, so its camera is a `StereoRig`.

    Without `options.poses`, poses are estimated from GPS, IMU and odometry by `estimate_poses`. Given poses are
    those of the left camera in UTM. The calibration is a YAML (`calibration.read_camera_yaml`), MATLAB's
    `stereoParameters`, or by default that of the data set.

    Raises:
        JaxmapError: the folder holds parts instead, files are missing or mostly damaged, the images
            are of another size than the calibration, or no poses can be estimated.
    """
    if not _is_part(folder):
        parts = [str(path.relative_to(folder)) for path in find_parts(folder)]
        if not parts:
            raise JaxmapError("there is no LocCam", where=folder, fix="give the folder of a part, which holds LocCam")
        raise JaxmapError(f"the folder holds parts ({', '.join(parts)})", where=folder, fix="give one of them")
    camera = CAMERAS[options.camera or next(iter(CAMERAS))]
    if not (folder / camera.folder).is_dir():
        others = [name for name, other in CAMERAS.items() if (folder / other.folder).is_dir()]
        raise JaxmapError(f"there is no {camera.folder}", where=folder, fix=f"choose --camera {' or '.join(others)}")
    frames, image_notes = pair_images(folder / camera.folder)
    if options.poses:
        track, T_child_camera = read_pose_track(options, options.poses), None
        east, north, _ = np.nanmedian(track.T[:, :3, 3], axis=0)
        crs = CRS if 1e5 < east < 9e5 and 1e4 < north < 1e7 else None
        pose_notes = [] if crs or track is UNPOSED else ["the poses given are not UTM: name their system with --crs"]
    else:
        frame_times_s = np.array([frame.timestamp_s for frame in frames])
        track, crs, pose_notes = _estimate_track(folder, options, frame_times_s)
        T_child_camera, mount_notes = body_to_camera(folder, camera, frame_times_s)
        pose_notes += mount_notes
    path = options.calibration or config_folder() / "cameras" / f"katwijk_{camera.folder.lower()}.yaml"
    calibration, camera_notes = read_calibration(path, [frame.left for frame in frames])
    absolute = Path(os.path.abspath(folder))
    by_traverse = re.fullmatch(r"(?i)traverse.*", absolute.parent.name)
    return assemble(
        name=f"{absolute.parent.name}_{absolute.name}" if by_traverse else absolute.name,
        dataset="katwijk",
        where=folder,
        frames=frames,
        track=track,
        camera=calibration,
        options=replace(options, poses_world="z_up" if options.poses_world == "auto" else options.poses_world),
        T_child_camera=T_child_camera,
        crs=crs,
        notes=[*image_notes, *pose_notes, *camera_notes],
    )


def _estimate_track(folder: Path, options: ReadOptions, frame_times_s: np.ndarray) -> tuple[PoseTrack, str, list[str]]:
    """Poses of the body in UTM, the UTM zone, and notes on sources and accuracy."""
    (gps, gps_notes), (imu, imu_notes), (wheels, wheel_notes) = read_gps(folder), read_imu(folder), read_wheels(folder)
    fixes, imu = _near_frames(gps.fixes, frame_times_s), _near_frames(imu, frame_times_s)
    wheels = _near_frames(wheels, frame_times_s) if wheels else None
    antenna_body_m = R_BODY_IMU @ np.array(options.antenna_m or ANTENNA_IMU_M)
    geometry = RoverGeometry(antenna_body_m, IMU_HEIGHT_M, TURNING_CENTRE_M)
    poses = estimate_poses(fixes, imu, wheels, geometry, where=folder)
    track = make_pose_track(poses.timestamps_s, poses.T_world_body, child="body", where=folder)

    statuses = ", ".join(f"{count} {status}" for status, count in gps.statuses.items())
    notes = [
        f"position from {poses.fixes} GPS fixes ({statuses}), heading from motion and gyro "
        f"(to {np.degrees(poses.heading_sigma_rad):.1f} deg), roll and pitch from the inclinometer"
    ]
    if np.isfinite(poses.wheel_scale):
        radius_m = poses.wheel_scale * WHEEL_RADIUS_M
        notes.append(f"between fixes the poses follow the wheels, with a radius of {radius_m:.4f} m")
    from_fix_s = time_to_nearest(fixes.timestamps_s, frame_times_s)
    if far := int((from_fix_s > MAX_TIME_FROM_FIX_S).sum()):
        notes.append(
            f"{far} of {len(from_fix_s)} frames have no GPS fix within {MAX_TIME_FROM_FIX_S:g} s "
            f"(at most {from_fix_s.max():.0f} s)"
        )
    if poses.outliers:
        notes.append(f"{poses.outliers} of {poses.fixes} GPS fixes are outliers and weigh less")
    return track, gps.crs, [*notes, *gps_notes, *imu_notes, *wheel_notes]


def _near_frames(log: Log, frame_times_s: np.ndarray) -> Log:
    """The part of a recording near the times of the frames."""
    first_s, last_s = frame_times_s[0] - MAX_TIME_FROM_FRAMES_S, frame_times_s[-1] + MAX_TIME_FROM_FRAMES_S
    near = (log.timestamps_s > first_s) & (log.timestamps_s < last_s)
    return type(log)(*(values[near] for values in log))


def _is_part(folder: Path) -> bool:
    # Unlike Path.is_dir, this does not raise where permission is denied.
    return any(os.path.isdir(folder / camera.folder) for camera in CAMERAS.values())


def _subfolders(folder: Path) -> list[Path]:
    try:
        found = [path for path in folder.iterdir() if os.path.isdir(path)]
    except OSError:
        return []
    return sorted(found, key=lambda path: [word.zfill(9) for word in re.findall(r"[0-9]+|[^0-9]+", path.name)])


def body_to_camera(
    folder: Path, camera: RoverCamera, timestamps_s: Float64[np.ndarray, "N"]
) -> tuple[np.ndarray, list[str]]:
    """T_body_camera of the left camera, (4, 4) or, on the pan-tilt unit, (N, 4, 4); and notes.

    Pan and tilt are read from `ptu.txt` in radians; pan is positive to the left, tilt positive down, and the tilt
    axis turns with the pan.

    Raises:
        JaxmapError: the camera needs `ptu.txt`, and it is missing or mostly damaged.
    """
    T_body_imu = np.eye(4)
    T_body_imu[:3, :3] = R_BODY_IMU
    if not camera.on_pan_tilt:
        return T_body_imu @ camera.T_imu_mount @ camera.T_mount_camera, []
    table = _read_table(folder / "ptu.txt", 2, lambda row: max(map(abs, row)) <= 2 * np.pi)
    pan, tilt = (np.interp(timestamps_s, table.timestamps_s, np.unwrap(column)) for column in table.values.T)
    T_mount_turned = np.tile(np.eye(4), (len(timestamps_s), 1, 1))
    T_mount_turned[:, :3, :3] = Rotation.from_euler("ZY", np.stack([pan, tilt], axis=-1)).as_matrix()
    notes = [*table.notes, "pan and tilt of ptu.txt are taken for radians, positive to the left and down"]
    away_s = time_to_nearest(table.timestamps_s, timestamps_s)
    if far := int((away_s > MAX_TIME_FROM_PAN_TILT_S).sum()):
        notes.append(f"{far} of {len(timestamps_s)} frames have no pan and tilt within {MAX_TIME_FROM_PAN_TILT_S:g} s")
    return T_body_imu @ camera.T_imu_mount @ T_mount_turned @ camera.T_mount_camera, notes


def up_in_camera(sequence: StereoSequence) -> Float64[np.ndarray, "N 3"] | None:
    """The direction up in the left camera's frame, for each frame of a part, by its inclinometer and gyros.

    NaN where a frame lies outside their times; None for a sequence of another kind, or without them.
    """
    images = sequence.frames[0].left.parent
    camera = next((camera for camera in CAMERAS.values() if camera.folder == images.name), None)
    if sequence.dataset != READER.name or camera is None:
        return None
    timestamps_s = np.array([frame.timestamp_s for frame in sequence.frames])
    try:
        (imu, _), (wheels, _) = read_imu(images.parent), read_wheels(images.parent)
        imu, wheels = _near_frames(imu, timestamps_s), _near_frames(wheels, timestamps_s) if wheels else None
        up_body = estimate_up(imu, wheels if wheels and len(wheels.timestamps_s) > 1 else None, timestamps_s)
        T_body_camera, _ = body_to_camera(images.parent, camera, timestamps_s)
    except JaxmapError:
        return None
    return np.einsum("...ji,...j->...i", T_body_camera[..., :3, :3], up_body)


def pair_images(folder: Path) -> tuple[list[FrameRef], list[str]]:
    """Pairs `CAMERA_YYYY_MM_DD_HH_MM_SS_ms_0.png` (left) and `..._1.png` (right) of one time.

    Returns:
        The frames in the order of time, and notes on images left out.

    Raises:
        JaxmapError: the folder is missing or empty, no name is of this form, or no images pair up.
    """
    sides: tuple[dict[float, Path], dict[float, Path]] = ({}, {})
    unnamed = repeated = 0
    for path in list_images(folder):
        match = _IMAGE_NAME.fullmatch(path.stem)
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
            f"no pair among {len(left)} left and {len(right)} right images and {unnamed} with other names",
            where=folder,
            fix=f"name them {folder.name}_YYYY_MM_DD_HH_MM_SS_ms_0.png (left) and _1.png (right)",
        )
    frames = [FrameRef(left[time_s].stem, time_s, left[time_s], right[time_s]) for time_s in times_s]
    faults = {
        "without partner": len(left) + len(right) - 2 * len(times_s),
        "with a repeated time": repeated,
        "with other names": unnamed,
    }
    return frames, [f"{folder.name}: {count} images {what} left out" for what, count in faults.items() if count]


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


def read_gps(folder: Path) -> tuple[GpsLog, list[str]]:
    """The fixes of a part: `time status lat lon alt sd_N sd_E sd_U`, from the first existing file of `GPS_FILES`.

    Both files hold latitude and longitude in the parts seen; UTM is recognised by its magnitude.

    Raises:
        JaxmapError: there is no such file, or most of it is unreadable.
    """
    path = next((folder / name for name in GPS_FILES if (folder / name).is_file()), None)
    if path is None:
        raise _no_poses(f"no GPS: there is neither {' nor '.join(GPS_FILES)}", folder)
    table = _read_table(path, 6, _is_fix, has_word=True)
    first, second, altitude, sd_north, sd_east, sd_up = table.values.T
    if np.median(np.abs(first)) <= 90 and np.median(np.abs(second)) <= 360:
        crs = utm_crs(float(np.median(second)), float(np.median(first)))
        east, north = to_utm(crs, second, first)
    else:
        # An easting has six digits before the point, a northing of temperate latitudes seven.
        east, north = (second, first) if np.median(first) > np.median(second) else (first, second)
        crs = "EPSG:32631"
    sigma_m = np.maximum(np.stack([sd_east, sd_north, sd_up], axis=-1), MIN_GPS_SIGMA_M)
    fixes = GpsFixes(table.timestamps_s, np.stack([east, north, altitude], axis=-1), sigma_m)
    statuses = {word: table.words.count(word) for word in sorted(set(table.words))}
    return GpsLog(fixes, crs, statuses), table.notes


def read_imu(folder: Path) -> tuple[ImuLog, list[str]]:
    """`time acc_xyz gyro_xyz inclinometer_xyz` in m/s2 and rad/s, rotated from the IMU frame into the body frame.

    Raises:
        JaxmapError: there is no such file, or most of it is unreadable.
    """
    table = _read_table(folder / "imu.txt", 9, lambda row: max(map(abs, row)) < 200)
    axes = np.diag(R_BODY_IMU)
    return ImuLog(table.timestamps_s, table.values[:, 3:6] * axes, table.values[:, 6:9] * axes), table.notes


def read_wheels(folder: Path) -> tuple[WheelLog | None, list[str]]:
    """The rover's speed from `odometry.txt`; None where the file is missing.

    A line holds angle, rate and an analogue value of six drive and four steering joints, and three
    angles of the chassis. The speed is the mean over both sides of the median wheel, so that one wheel
    that slips or fails does not count, and turning on the spot gives none.

    Raises:
        JaxmapError: most of the file is unreadable.
    """
    path = folder / "odometry.txt"
    if not path.is_file():
        return None, [f"there is no {path.name}: between the fixes the rover is assumed to keep its speed"]
    table = _read_table(path, 33, lambda row: max(map(abs, row[1 : 3 * _WHEELS : 3])) < 100)
    rates = table.values[:, 1 : 3 * _WHEELS : 3]
    sides = np.median(rates[:, 0::2], axis=1), np.median(rates[:, 1::2], axis=1)
    turning = np.abs(uniform_filter1d(rates, STANDING_SAMPLES, axis=0)).max(axis=1) > STANDING_RATE_RAD_S
    return WheelLog(table.timestamps_s, WHEEL_RADIUS_M * (sides[0] + sides[1]) / 2, turning), table.notes


def _is_fix(row: list[float]) -> bool:
    first, second, altitude, *sigmas = row
    on_earth = max(abs(first), abs(second)) < 1e7 and abs(altitude) < 1e4
    return on_earth and min(sigmas) >= 0 and 0 < max(sigmas) < 1e3


def _read_table(
    path: Path, columns: int, plausible: Callable[[list[float]], bool], *, has_word: bool = False
) -> LogTable:
    """The readable lines of a text file in the order of time; `has_word`: the second column is text."""
    if not path.exists():
        raise _no_poses(f"no {path.name}", path.parent)
    lines = [line for line in read_bytes(path, MOST_TEXT_BYTES).split(b"\n") if line.strip()]
    times, rows, words = [], [], []
    for line in lines:
        fields = line.decode("utf-8", "replace").split()
        time_s = parse_time(fields[0]) if len(fields) == 1 + has_word + columns else None
        try:
            row = [float(field) for field in fields[1 + has_word :]]
        except ValueError:
            continue
        if time_s is None or not np.isfinite(row).all() or not plausible(row):
            continue
        times.append(time_s)
        rows.append(row)
        words.append(fields[1] if has_word else "")
    if not rows or len(rows) < len(lines) / 2:
        raise _no_poses(f"{len(lines) - len(rows)} of {len(lines)} lines cannot be read", path)
    timestamps_s = np.array(times)
    order = np.argsort(timestamps_s, kind="stable")
    kept = order[np.diff(timestamps_s[order], prepend=-np.inf) > 0]
    faults = {
        "that cannot be read left out": len(lines) - len(rows),
        "out of order sorted": int((np.diff(timestamps_s) < 0).sum()),
        "with a repeated time left out": len(order) - len(kept),
    }
    notes = [f"{path.name}: {count} of {len(lines)} lines {what}" for what, count in faults.items() if count]
    return LogTable(timestamps_s[kept], np.array(rows)[kept], [words[index] for index in kept], notes)


def _no_poses(what: str, where: object) -> JaxmapError:
    fix = "restore the file, or give --poses FILE (TUM text, T_world_camera of the left camera in UTM)"
    return JaxmapError(what, where=where, fix=fix)


READER = Reader(
    "katwijk", "a part of ESA's Katwijk Beach data set, holding LocCam", recognises, open_katwijk, tuple(CAMERAS)
)
