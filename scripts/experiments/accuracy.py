"""The accuracy of the geometric half on recorded data: Motorcycle, KITTI 01, EuRoC.

    python scripts/experiments/accuracy.py [--data FOLDER]

FOLDER holds `kitti_odometry` and `euroc_micro`; missing parts are reported and left out. Prints one table: what was
measured, and the value expected or its target.
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import jaxlie
import numpy as np
from common import SHARED, Table, command_line, parse

from jaxmap.datasets import open_sequence
from jaxmap.datasets.euroc import read_rig
from jaxmap.datasets.samples import motorcycle_disparity
from jaxmap.evaluation.geometry_scores import depth_consistency, point_range_error, score_disparity
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import StereoOptions
from jaxmap.stereo.rectify import make_rectifier

FRAMES_APART = 5


def motorcycle(table: Table, mode: str) -> None:
    """Disparity and points of the Motorcycle pair against its true disparity."""
    sequence = open_sequence("sample:motorcycle")
    front_end = StereoFrontEnd(sequence.camera, StereoOptions(mode=mode))
    frame = front_end(*sequence.read_pair(sequence.frames[0]))
    truth = motorcycle_disparity()
    scores = score_disparity(frame.disparity_px, truth)
    pose = jaxlie.SE3.from_matrix(jnp.asarray(sequence.T_world_camera[0], jnp.float32))
    error = point_range_error(front_end.camera, pose, frame.disparity_px, truth)
    data = f"Motorcycle, {mode}"
    table.row(data, "median error of disparity", f"{scores.median_error_px:.3f} px", "<= 0.2 px")
    table.row(data, "disparities off by more than 2 px", f"{scores.bad_2:.2%}", "<= 6.5 %")
    table.row(data, "pixels with a disparity", f"{scores.valid:.1%}", ">= 75 %")
    table.row(data, "median error of the distance of points", f"{error:.3%}", "<= 1 %")


def kitti(table: Table, folder: Path) -> None:
    """Depth of frames against that of frames five later, through the poses."""
    sequence = open_sequence(folder / "sequences" / "01")
    front_end = StereoFrontEnd(sequence.camera, StereoOptions())
    disparities = [front_end(*sequence.read_pair(frame)).disparity_px for frame in sequence.frames]
    errors = []
    for a in range(len(disparities) - FRAMES_APART):
        b = a + FRAMES_APART
        T_b_a = np.linalg.inv(sequence.T_world_camera[b]) @ sequence.T_world_camera[a]
        pose = jaxlie.SE3.from_matrix(jnp.asarray(T_b_a, jnp.float32))
        errors.append(np.abs(depth_consistency(front_end.camera, disparities[a], disparities[b], pose)))
    medians, every = [float(np.median(error)) for error in errors], np.concatenate(errors)
    data = f"KITTI 01, {len(disparities)} frames"
    table.row(data, f"median |dZ|/Z of frames i and i+{FRAMES_APART}", f"{np.median(every):.2%}", None)
    table.row(data, "the same, least and greatest of a pair", f"{min(medians):.2%}, {max(medians):.2%}", None)
    table.row(data, "points within 5 %", f"{np.mean(every < 0.05):.1%}", None)


def euroc(table: Table, folder: Path) -> None:
    """The rectified camera of the EuRoC rig."""
    camera = make_rectifier(read_rig(folder)).camera
    table.row("EuRoC", "rectified focal length", f"{float(camera.fx_px):.2f} px", "436.24 px")
    table.row("EuRoC", "rectified baseline", f"{float(camera.baseline_m):.5f} m", "0.11008 m")


def main() -> None:
    """Prints the table."""
    parser = command_line(__doc__)
    parser.add_argument("--data", type=Path, default=SHARED / "realdata")
    data = parse(parser).data
    table = Table({"data": "<20", "what": "<42", "measured": "<18", "expected": "<12"})
    for mode in ("3way", "sgbm", "hh", "hh4"):
        motorcycle(table, mode)
    for folder, measure in ((data / "kitti_odometry", kitti), (data / "euroc_micro", euroc)):
        if folder.is_dir():
            measure(table, folder)
        else:
            print(f"left out: there is no {folder}")


if __name__ == "__main__":
    main()
