"""GPS in a bag: fixes as positions in UTM, poses of them and an Imu, and a local track moved onto them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from jaxmap.datasets.bag_frames import FrameTree
from jaxmap.datasets.bag_log import BagLog, Fix
from jaxmap.datasets.bag_poses import BagPoses, placed
from jaxmap.datasets.crs import to_utm, utm_crs
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.poses import make_pose_track, poses_at
from jaxmap.datasets.stamped_poses import make_track
from jaxmap.errors import JaxmapError

MIN_TRAVEL_M = 3.0
"""Over less the fixes do not tell the heading of a track."""


class Positions(NamedTuple):
    """GPS fixes in a UTM zone: times, positions (N, 3) in m, and the angle from east and north to the grid's axes."""

    times_s: np.ndarray
    positions_m: np.ndarray
    R_grid_enu: np.ndarray
    crs: str
    frame: str


def utm_positions(fixes: list[Fix], topic: str) -> Positions:
    """Fixes in the UTM zone of the first one, by PROJ.

    Raises:
        JaxmapError: there are none.
    """
    by_time = {fix.time_ns: fix for fix in fixes if np.isfinite(fix[1:4]).all()}
    if not by_time:
        raise JaxmapError("no message holds a fix", where=topic, fix="choose another topic, or give --poses FILE")
    kept = [by_time[time_ns] for time_ns in sorted(by_time)]
    crs = utm_crs(kept[0].longitude_deg, kept[0].latitude_deg)
    latitude = np.array([fix.latitude_deg for fix in kept])
    longitude = np.array([fix.longitude_deg for fix in kept])
    east_m, north_m = to_utm(crs, longitude, latitude)
    # True north on the grid, from a point 10 m north of the first one.
    ahead = to_utm(crs, longitude[:1], latitude[:1] + 1e-4)
    turn = Rotation.from_euler("z", -np.arctan2(ahead[0][0] - east_m[0], ahead[1][0] - north_m[0]))
    positions = np.column_stack([east_m, north_m, [fix.altitude_m for fix in kept]])
    return Positions(np.array([fix.time_ns / 1e9 for fix in kept]), positions, turn.as_matrix(), crs, kept[0].frame)


def gps_poses(
    log: BagLog,
    gps: str,
    imu: str,
    camera_frame: str,
    T_frame_optical: np.ndarray,
    times_s: Float64[np.ndarray, "N"],
    options: ReadOptions,
) -> BagPoses:
    """Poses of the Imu in UTM: position by GPS, attitude by the Imu, whose world is east, north, up (REP 103).

    Raises:
        JaxmapError: no fixes, no attitudes, or never both at one time.
    """
    fixes = utm_positions(log.fixes[gps], gps)
    attitudes, _ = make_track(log.poses[imu], imu)
    T, known = poses_at(attitudes, fixes.times_s, options.max_pose_gap_s)
    if not known.any():
        raise JaxmapError(f"{gps} and {imu} have no time in common", where=imu, fix="check the clocks")
    T[:, :3, :3] = fixes.R_grid_enu @ T[:, :3, :3]
    T[:, :3, 3] = fixes.positions_m
    arm = antenna_in(log.tree, "".join(log.children[imu]), fixes.frame)
    T[:, :3, 3] -= T[:, :3, :3] @ (np.zeros(3) if arm is None else arm)
    track = make_pose_track(fixes.times_s[known], T[known], where=f"{gps} and {imu}")
    poses = placed(log, track, log.children[imu], camera_frame, T_frame_optical, times_s, options)
    notes = [f"positions from {gps}, attitude from {imu}, which is taken to measure from east and up"]
    notes += ["tf does not say where the antenna is: it is taken to be at the Imu"] * (arm is None)
    return poses._replace(notes=[*notes, *poses.notes], crs=fixes.crs)


def antenna_in(tree: FrameTree, frame: str, antenna: str) -> np.ndarray | None:
    """The position of the antenna in a frame, None where tf does not tell."""
    if frame and frame == antenna:
        return np.zeros(3)
    if not (frame and antenna and tree.holds(frame) and tree.holds(antenna)):
        return None
    found = tree.lookup(frame, antenna, np.zeros(1), 1.0)
    return found[0][0, :3, 3] if found is not None and found[1].all() else None


def georeferenced(poses: BagPoses, log: BagLog, gps: str, options: ReadOptions) -> BagPoses:
    """Poses turned about the vertical and moved so that the antenna passes through the GPS fixes.

    Args:
        poses: in a local world whose z axis points up.
        log: of the bag.
        gps: the NavSatFix topic.
        options: the longest gap between poses.

    Raises:
        JaxmapError: the fixes and the poses have too little in common.
    """
    fixes = utm_positions(log.fixes[gps], gps)
    T, known = poses_at(poses.track, fixes.times_s, options.max_pose_gap_s)
    arm = antenna_in(log.tree, poses.child, fixes.frame)
    T, utm = T[known], fixes.positions_m[known]
    local = T[:, :3, 3] + T[:, :3, :3] @ (np.zeros(3) if arm is None else arm)
    travel_m = float(np.ptp(local[:, :2], axis=0).max()) if len(local) else 0.0
    if len(local) < 3 or travel_m < MIN_TRAVEL_M:
        raise JaxmapError(
            f"{len(local)} fixes at times of poses, over {travel_m:.1f} m, do not tell the heading",
            where=gps,
            fix="leave --bag.gps out, or map a longer part",
        )
    T_utm_local, residual_m = _turn_and_move(local, utm)
    off_m = float(np.median(residual_m))
    if off_m > 0.1 * travel_m:
        raise JaxmapError(
            f"poses and fixes do not agree: half of the fixes are off by more than {off_m:.1f} m of {travel_m:.1f} m",
            where=gps,
            fix="leave --bag.gps out, or choose other poses",
        )
    note = f"turned and moved onto {len(local)} fixes of {gps}; they are off by {off_m:.2f} m (median)"
    notes = [*poses.notes, note] + ["tf does not say where the antenna is"] * (arm is None)
    track = make_pose_track(poses.track.timestamps_s, T_utm_local @ poses.track.T, where=poses.track.where)
    return poses._replace(track=track, crs=fixes.crs, notes=notes)


def _turn_and_move(
    local_m: Float64[np.ndarray, "N 3"], utm_m: Float64[np.ndarray, "N 3"]
) -> tuple[Float64[np.ndarray, "4 4"], Float64[np.ndarray, "N"]]:
    """T_utm_local of heading and offset alone, by least squares, and what is left of each point, in m.

    Points beyond twice the median residual count less (Huber's weights).
    """
    T, residual_m = np.eye(4), np.ones(len(local_m))
    for _ in range(10):
        weights = 1 / np.maximum(1.0, residual_m / max(2 * float(np.median(residual_m)), 1e-6))
        centre, centre_utm = (np.average(points, axis=0, weights=weights) for points in (local_m, utm_m))
        a, b = (local_m - centre)[:, :2], (utm_m - centre_utm)[:, :2]
        cross = weights @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        T[:3, :3] = Rotation.from_euler("z", np.arctan2(cross, weights @ (a * b).sum(axis=1))).as_matrix()
        T[:3, 3] = centre_utm - T[:3, :3] @ centre
        residual_m = np.linalg.norm(local_m @ T[:3, :3].T + T[:3, 3] - utm_m, axis=1)
    return T, residual_m
