"""How far poses from the images alone (`--poses odometry`) are from true ones, and what their maps are worth.

    python scripts/experiments/odometry_accuracy.py [SEQUENCE TRUE_POSES]... [--scored]

Without a sequence, takes `sample:traverse` and what is kept beside the repository: traverses a and b of another
renderer, and 51 frames of KITTI, once more from frame 12 on: before, its given attitudes are interpolated, and turn
evenly where the images sway. Prints one table: length of the path; drift at its end, in position and in attitude;
KITTI's errors of translation and rotation, which are means over all stretches of 1/5, 2/5 ... 5/5 of the path (the
benchmark's own stretches, of 100 m and more, are longer than these paths); tilt of the world against the true one; ms
a frame, reading included. With --scored, the traverses are mapped with true labels and each kind of poses, within 8 m,
and the IoU of rock follows, a mean over lattices of cells: with true poses, with those from GPS, IMU and wheels, and
with odometry laid on the true start (position and heading).
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import SHARED, Frames, Table, Traverse, command_line, parse
from scipy.spatial.transform import Rotation

from jaxmap.datasets import ReadOptions, StereoSequence, open_sequence
from jaxmap.datasets.poses import poses_at, read_poses, write_tum
from jaxmap.evaluation.pose_errors import relative_errors

STRETCHES = 5
KITTI, KITTI_FROM = SHARED / "realdata" / "kitti_odometry", 12


class Drift(NamedTuple):
    """Errors against true poses: shares of the distance, and degrees per metre of it."""

    path_m: float
    end: float
    end_turned: float
    translation: float
    rotation: float
    tilt_deg: float


def drift(T_world_camera: np.ndarray, T_true: np.ndarray) -> Drift:
    """The errors of a path; both (N, 4, 4)."""
    steps_m = np.linalg.norm(np.diff(T_true[:, :3, 3], axis=0), axis=1)
    way_m = np.concatenate([[0.0], np.cumsum(steps_m)])

    def errors_between(pairs: list[tuple[int, int]]) -> np.ndarray:
        ends = np.array(pairs, int).reshape(-1, 2)
        lengths_m = way_m[ends[:, 1]] - way_m[ends[:, 0]]
        return np.stack(relative_errors(T_world_camera, T_true, ends)) / lengths_m

    pairs = []
    for stretch in range(1, STRETCHES + 1):
        length_m = way_m[-1] * stretch / STRETCHES
        lasts = np.searchsorted(way_m, way_m + length_m - 1e-6)
        pairs += [(first, last) for first, last in enumerate(lasts.tolist()) if last < len(way_m)]
    tilt = np.arccos(np.clip(T_world_camera[0, 2, :3] @ T_true[0, 2, :3], -1, 1))
    end, end_turned = errors_between([(0, len(way_m) - 1)])[:, 0].tolist()
    translation, rotation = errors_between(pairs).mean(axis=1).tolist()
    return Drift(float(way_m[-1]), end, end_turned, translation, rotation, float(np.degrees(tilt)))


def true_poses(sequence: StereoSequence, path: Path) -> np.ndarray:
    """The true pose of each frame."""
    track, times_s = read_poses(path), np.array([frame.timestamp_s for frame in sequence.frames])
    if track.timestamps_s is None:
        # KITTI's world is camera-like.
        return open_sequence(sequence.frames[0].left.parents[1]).T_world_camera
    T, known = poses_at(track, times_s, 1.0)
    assert known.all()
    return T


def laid_on(T_world_camera: np.ndarray, T_true: np.ndarray) -> np.ndarray:
    """Poses moved and turned about the vertical, so that the first is where and heads where the true one does."""
    turn = T_true[0, :3, :3] @ T_world_camera[0, :3, :3].T
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", np.arctan2(turn[1, 0], turn[0, 0])).as_matrix()
    T[:3, 3] = T_true[0, :3, 3] - T[:3, :3] @ T_world_camera[0, :3, 3]
    return T @ T_world_camera


def rock_iou(traverse: Traverse, poses: Path | None) -> float:
    """Of a map with true labels: with poses from a file, or the reader's own."""
    config = replace(traverse.config("true"), poses=poses, crs="EPSG:32631")
    return float(np.mean(Frames(traverse.sequence, traverse.truth).scored(config).lattice_ious()))


def main() -> None:
    """Prints the table."""
    parser = command_line(__doc__)
    parser.add_argument("sequences", nargs="*", metavar="SEQUENCE TRUE_POSES")
    parser.add_argument("--scored", action="store_true")
    given = parse(parser)
    traverses = ["sample:traverse", *(SHARED / "simdata" / name for name in ("traverse_a", "traverse_b"))]
    known = {one.sequence: one for one in map(Traverse, traverses) if one.gt.is_dir()}
    pairs = list(zip(given.sequences[::2], map(Path, given.sequences[1::2]), strict=True))
    if not pairs:
        pairs = [(one.sequence, one.gt / "poses_utm.tum") for one in known.values()]
        if KITTI.is_dir():
            pairs.append((str(KITTI / "sequences" / "01"), KITTI / "poses" / "01.txt"))
    columns = {"sequence": "<24", "frames": "7d", "path, m": "9.1f", "end, %": "8.2f", "end, deg/m": "12.4f"}
    columns |= {"translation, %": "16.2f", "rotation, deg/m": "17.4f", "tilt, deg": "11.2f", "ms a frame": "12.0f"}
    if given.scored:
        columns |= {"IoU, true": "11.3f", "sensors": "9.3f", "odometry": "10.3f"}
    table = Table(columns)
    for source, path in pairs:
        started_s = time.perf_counter()
        sequence = open_sequence(source, ReadOptions(poses=Path("odometry")))
        each_ms = 1e3 * (time.perf_counter() - started_s) / len(sequence.frames)
        truth, T = true_poses(sequence, path), sequence.T_world_camera
        ious: list[float | None] = [None] * 3 if given.scored else []
        if given.scored and source in known:
            with tempfile.TemporaryDirectory() as folder:
                laid = Path(folder) / "odometry.tum"
                write_tum(laid, np.array([frame.timestamp_s for frame in sequence.frames]), laid_on(T, truth))
                ious = [rock_iou(known[source], poses) for poses in (path, None, laid)]
        for first in (0, KITTI_FROM) if sequence.dataset == "kitti" else (0,):
            errors = drift(T[first:], truth[first:])
            name = f"{sequence.name}{f', from {first}' if first else ''}"
            table.row(
                name,
                len(T) - first,
                errors.path_m,
                100 * errors.end,
                errors.end_turned,
                100 * errors.translation,
                errors.rotation,
                errors.tilt_deg,
                each_ms,
                *ious,
            )


if __name__ == "__main__":
    main()
