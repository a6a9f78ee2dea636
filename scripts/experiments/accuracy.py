"""Prints the accuracy of the geometric half on real data: Motorcycle, KITTI 01, EuRoC.

    python scripts/accuracy.py [--data FOLDER]

FOLDER holds `kitti_odometry` and `euroc_micro`; parts that are not there are left out, and said so.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax.numpy as jnp
import jaxlie
import numpy as np

from jaxmap.datasets import open_sequence
from jaxmap.datasets.euroc import read_rig
from jaxmap.datasets.samples import motorcycle_disparity
from jaxmap.evaluation.geometry_scores import depth_consistency, point_range_error, score_disparity
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.options import StereoOptions
from jaxmap.stereo.rectify import make_rectifier

FRAMES_APART = 5


def motorcycle(mode: str) -> None:
    """Disparity and points of the Motorcycle pair against its true disparity."""
    sequence = open_sequence("sample:motorcycle")
    front_end = StereoFrontEnd(sequence.camera, StereoOptions(mode=mode))
    frame = front_end(*sequence.read_pair(sequence.frames[0]))
    truth = motorcycle_disparity()
    scores = score_disparity(frame.disparity_px, truth)
    pose = jaxlie.SE3.from_matrix(jnp.asarray(sequence.T_world_camera[0], jnp.float32))
    error = point_range_error(front_end.camera, pose, frame.disparity_px, truth)
    print(
        f"Motorcycle, {mode:5s} median error {scores.median_error_px:.3f} px (<= 0.2), "
        f"bad-2 {scores.bad_2:.2%} (<= 6.5 %), "
        f"valid {scores.valid:.1%} (>= 75 %), "
        f"points in the world {error:.3%} median range error (<= 1 %)"
    )


def kitti(folder: Path) -> None:
    """Depth of frames against that of frames five later, through the poses."""
    sequence = open_sequence(folder / "sequences" / "01")
    front_end = StereoFrontEnd(sequence.camera, StereoOptions())
    disparities = [front_end(*sequence.read_pair(frame)).disparity_px for frame in sequence.frames]
    errors = []
    for a in range(len(disparities) - FRAMES_APART):
        b = a + FRAMES_APART
        T_b_a = np.linalg.inv(sequence.T_world_camera[b]) @ sequence.T_world_camera[a]
        pose = jaxlie.SE3.from_matrix(jnp.asarray(T_b_a, jnp.float32))
        errors.append(depth_consistency(front_end.camera, disparities[a], disparities[b], pose))
    medians = [float(np.median(np.abs(error))) for error in errors]
    everything = np.abs(np.concatenate(errors))
    print(
        f"KITTI 01, {len(disparities)} frames: |dZ|/Z between frames i and i+{FRAMES_APART}: "
        f"median {np.median(everything):.2%}, per pair {min(medians):.2%} to {max(medians):.2%}; "
        f"{np.mean(everything < 0.05):.1%} of the points within 5 %"
    )


def euroc(folder: Path) -> None:
    """The rectified camera of the EuRoC rig."""
    camera = make_rectifier(read_rig(folder)).camera
    print(
        f"EuRoC: rectified f {float(camera.fx_px):.2f} px (436.24), baseline {float(camera.baseline_m):.5f} m (0.11008)"
    )


def main() -> None:
    """Prints one line for each figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    here = Path(__file__).resolve().parents[1]
    parser.add_argument("--data", type=Path, default=here.parent / "shared" / "realdata")
    data = parser.parse_args().data
    for mode in ("3way", "sgbm", "hh", "hh4"):
        motorcycle(mode)
    for folder, measure in ((data / "kitti_odometry", kitti), (data / "euroc_micro", euroc)):
        if folder.is_dir():
            measure(folder)
        else:
            print(f"left out: there is no {folder}")


if __name__ == "__main__":
    main()
