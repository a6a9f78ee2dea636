"""ESA's Katwijk Beach rover: raw LocCam or PanCam pairs, GPS, IMU, inclinometer and wheels."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from jaxmap.datasets.assemble import Reader, ReadOptions, assemble, read_pose_track
from jaxmap.datasets.base import StereoSequence
from jaxmap.datasets.calibration import read_camera_yaml
from jaxmap.datasets.katwijk_files import WHEEL_RADIUS_M, Gps, read_gps, read_imu, read_wheels
from jaxmap.datasets.katwijk_images import pair_images
from jaxmap.datasets.katwijk_rover import (
    ANTENNA_IMU_M,
    CAMERAS,
    IMU_HEIGHT_M,
    R_BODY_IMU,
    TURNING_CENTRE_M,
    RoverCamera,
    body_to_camera,
)
from jaxmap.datasets.matlab_calibration import read_matlab_calibration
from jaxmap.datasets.poses import PoseTrack, make_pose_track
from jaxmap.errors import JaxmapError
from jaxmap.host.files import config_folder
from jaxmap.localisation.estimate import RoverPoses, estimate_poses
from jaxmap.localisation.sensors import GpsFixes, ImuLog, RoverGeometry, WheelLog, time_to_nearest
from jaxmap.stereo.rectify import StereoRig
from jaxmap.types import StereoCamera

Log = TypeVar("Log", GpsFixes, ImuLog, WheelLog)

CRS = "EPSG:32631"
"""UTM 31 north, in which Katwijk lies; poses given for a part are in it."""

AROUND_FRAMES_S = 3600.0
"""What was recorded farther from all frames is not looked at; a garbled line can tell any year."""

FAR_FROM_FIX_S = 5.0
"""Frames farther from any GPS fix are counted: fixes come every 3 s."""


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

    Without `options.poses`, they are estimated from GPS, IMU and odometry by `estimate_poses`; the
    notes tell from what. Given poses are those of the left camera in UTM. The calibration is a YAML
    (`calibration.read_camera_yaml`), MATLAB's `stereoParameters`, or that of the data set.

    Raises:
        JaxmapError: the folder holds parts instead, files are missing or mostly damaged, the images
            are of another size than the calibration, or no poses can be told.
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
    pairs = pair_images(folder / camera.folder)
    times_s = np.array([frame.timestamp_s for frame in pairs.frames])
    if options.poses:
        track, T_child_camera = read_pose_track(options, None, options.poses), None
        crs = CRS if _looks_like_utm(track) else None
        told = [] if crs else ["the poses given are not UTM: --crs says what they are"]
    else:
        track, crs, told = _estimated_track(folder, options, times_s)
        T_child_camera, told_by_mount = body_to_camera(folder, camera, times_s)
        told += told_by_mount
    return assemble(
        name=_name(folder),
        dataset="katwijk",
        where=folder,
        frames=pairs.frames,
        track=track,
        camera=_calibration(camera, options),
        options=replace(options, poses_world="z_up" if options.poses_world == "auto" else options.poses_world),
        T_child_camera=T_child_camera,
        crs=crs,
        notes=[*pairs.notes, *told],
    )


def _calibration(camera: RoverCamera, options: ReadOptions) -> StereoCamera | StereoRig:
    path = options.calibration
    if path is None:
        return read_camera_yaml(config_folder() / "cameras" / f"katwijk_{camera.folder.lower()}.yaml")
    return read_matlab_calibration(path, camera.size_px) if path.suffix.lower() == ".mat" else read_camera_yaml(path)


def _estimated_track(folder: Path, options: ReadOptions, frame_times_s: np.ndarray) -> tuple[PoseTrack, str, list[str]]:
    """Poses of the body in UTM, which UTM, and what they rest on."""
    (gps, gps_notes), (imu, imu_notes), (wheels, wheel_notes) = read_gps(folder), read_imu(folder), read_wheels(folder)
    gps = gps._replace(fixes=_around(gps.fixes, frame_times_s))
    imu, wheels = _around(imu, frame_times_s), _around(wheels, frame_times_s) if wheels else None
    antenna_body_m = R_BODY_IMU @ np.array(options.antenna_m or ANTENNA_IMU_M)
    geometry = RoverGeometry(antenna_body_m, IMU_HEIGHT_M, TURNING_CENTRE_M)
    poses = estimate_poses(gps.fixes, imu, wheels, geometry, where=folder)
    track = make_pose_track(poses.timestamps_s, poses.T_world_body, child="body", where=folder)
    return track, gps.crs, [*_told(poses, gps, frame_times_s), *gps_notes, *imu_notes, *wheel_notes]


def _around(log: Log, frame_times_s: np.ndarray) -> Log:
    """The part of a recording from an hour before the first frame to an hour after the last."""
    times_s = log[0]
    near = (times_s > frame_times_s[0] - AROUND_FRAMES_S) & (times_s < frame_times_s[-1] + AROUND_FRAMES_S)
    return type(log)(*(values[near] for values in log))


def _told(poses: RoverPoses, gps: Gps, frame_times_s: np.ndarray) -> list[str]:
    """What the poses were estimated from, and how well."""
    statuses = ", ".join(f"{count} {status}" for status, count in gps.statuses.items())
    notes = [
        f"position from {poses.fixes} GPS fixes ({statuses}), heading from motion and gyro "
        f"(to {np.degrees(poses.heading_sigma_rad):.1f} deg), roll and pitch from the inclinometer"
    ]
    if np.isfinite(poses.wheel_scale):
        notes.append(f"between fixes the wheels count, with a radius of {poses.wheel_scale * WHEEL_RADIUS_M:.4f} m")
    away_s = time_to_nearest(gps.fixes.timestamps_s, frame_times_s)
    if far := int((away_s > FAR_FROM_FIX_S).sum()):
        notes.append(
            f"{far} of {len(away_s)} frames have no GPS fix within {FAR_FROM_FIX_S:g} s (at most {away_s.max():.0f} s)"
        )
    if poses.outliers:
        notes.append(f"{poses.outliers} of {poses.fixes} GPS fixes do not fit and count less")
    return notes


def _looks_like_utm(track: PoseTrack) -> bool:
    """Whether positions are eastings and northings of a UTM zone in the northern hemisphere."""
    east, north, _ = np.median(track.T[:, :3, 3], axis=0)
    return bool(1e5 < east < 9e5 and 1e4 < north < 1e7)


def _is_part(folder: Path) -> bool:
    # Unlike Path.is_dir, this does not raise where the folder may not be looked into.
    return any(os.path.isdir(folder / camera.folder) for camera in CAMERAS.values())


def _subfolders(folder: Path) -> list[Path]:
    try:
        found = [path for path in folder.iterdir() if os.path.isdir(path)]
    except OSError:
        return []
    return sorted(found, key=lambda path: [word.zfill(9) for word in re.findall(r"[0-9]+|[^0-9]+", path.name)])


def _name(folder: Path) -> str:
    """`Part1`, or `Traverse1_Part1` in the layout by traverses."""
    absolute = Path(os.path.abspath(folder))
    traverse = absolute.parent.name
    return f"{traverse}_{absolute.name}" if re.fullmatch(r"(?i)traverse.*", traverse) else absolute.name


READER = Reader(
    "katwijk", "a part of ESA's Katwijk Beach data set, holding LocCam", recognises, open_katwijk, tuple(CAMERAS)
)
