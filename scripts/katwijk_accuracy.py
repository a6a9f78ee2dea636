"""Prints how far the Katwijk reader's own poses are from true ones, on simulated parts and made-up drives.

    python scripts/katwijk_accuracy.py [PART TRUTH.tum]... [--drives N]

PART is a folder that holds LocCam, TRUTH.tum its true T_world_camera in UTM. Without any, the traverse
kept beside the repository is taken, if it is there. N drives of each kind are made up by
`tests/rover_logs.py`: straight, curved, with stops, turns on the spot and reversing.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from rover_logs import DRIVES, START_S, drive, write_part  # noqa: E402

from jaxmap.datasets.assemble import ReadOptions  # noqa: E402
from jaxmap.datasets.katwijk import CAMERAS, open_katwijk  # noqa: E402
from jaxmap.datasets.katwijk_rover import R_BODY_IMU  # noqa: E402
from jaxmap.datasets.pose_files import read_poses  # noqa: E402
from jaxmap.datasets.poses import PoseTrack, make_pose_track, poses_at  # noqa: E402
from jaxmap.evaluation.geometry_scores import PoseErrors, pose_errors  # noqa: E402

T_IMU_CAMERA = CAMERAS["loccam"].T_mount_camera
T_BODY_CAMERA = np.block([[R_BODY_IMU, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]]) @ T_IMU_CAMERA


def errors_of(part: Path, truth: PoseTrack) -> PoseErrors:
    """The errors at the times of the frames of a part."""
    sequence = open_katwijk(part, ReadOptions())
    times_s = np.array([frame.timestamp_s for frame in sequence.frames])
    T_true, has_truth = poses_at(truth, times_s, max_gap_s=1.0)
    T = sequence.T_world_camera.copy()
    T[:, :3, 3] += sequence.site_origin
    return pose_errors(T[has_truth], T_true[has_truth], T_BODY_CAMERA)


def errors_of_drive(kind: str, seed: int) -> PoseErrors:
    """The errors on one made-up drive."""
    heading_rad = np.random.default_rng(seed).uniform(-np.pi, np.pi)
    made = drive(DRIVES[kind], seed, heading_rad)
    with tempfile.TemporaryDirectory() as folder:
        frames_s = write_part(Path(folder), made, seed=seed, images=40)
        truth = make_pose_track(START_S + frames_s, made.at(frames_s) @ T_IMU_CAMERA)
        return errors_of(Path(folder), truth)


def report(name: str, errors: list[PoseErrors]) -> None:
    """One line: median and greatest error of each kind."""
    position, heading, roll, pitch = (np.concatenate(values) for values in zip(*errors, strict=True))
    cells = [f"{100 * np.median(position):5.1f} {100 * position.max():5.1f}"]
    cells += [f"{np.median(angle):5.2f} {angle.max():5.2f}" for angle in (heading, roll, pitch)]
    print(f"{name:24s}  {len(position):6d}  " + "  ".join(f"{cell:>13s}" for cell in cells), flush=True)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", type=Path, metavar="PART TRUTH")
    parser.add_argument("--drives", type=int, default=10)
    arguments = parser.parse_args()
    traverse = ROOT.parent / "shared" / "simdata" / "traverse_a"
    parts = arguments.parts or [traverse / "Part1", traverse / "gt" / "poses_utm.tum"]
    columns = ("position cm", "heading deg", "roll deg", "pitch deg")
    print(f"{'median, greatest':24s}  frames  " + "  ".join(f"{column:>13s}" for column in columns))
    for part, truth in zip(parts[::2], parts[1::2], strict=True):
        if part.is_dir():
            report(f"{part.resolve().parent.name} {part.name}", [errors_of(part, read_poses(truth))])
        else:
            print(f"left out: there is no {part}")
    for kind in DRIVES:
        report(f"{arguments.drives} x {kind}", [errors_of_drive(kind, seed) for seed in range(arguments.drives)])


if __name__ == "__main__":
    main()
