"""How well `jaxmap refine` recovers geometry that was disturbed: poses of each frame, or the camera's mounting.

    python scripts/experiments/refine_geometry.py SEQUENCE TRUE_POSES.tum [--dem F] [--truth LABELS.tif --labels DIR]

True poses are disturbed by 0.2 m and 1 degree in random directions, frame by frame, or all by 2 degrees of pitch and
0.1 m of height in the camera's mounting; then they are refined, from the images alone and with what is known of the
ground. Last come the poses that the reader itself estimates, if it does. Prints one table: root mean square and
greatest error of position and attitude, in the world, and once more after the path as a whole was shifted and turned
about the vertical to the true one (what is left then is what bends the map); the pitch and height of the mounting; with
--labels and --truth the IoU of rock of the map, in cells of 0.2 m within 8 m; seconds, and the spread of heights.
"""

from __future__ import annotations

import tempfile
import time
from argparse import Namespace
from pathlib import Path

import numpy as np
from common import RANGE_M, Frames, Table, command_line, parse
from scipy.spatial.transform import Rotation

from jaxmap.datasets import ReadOptions
from jaxmap.datasets.poses import write_tum
from jaxmap.errors import JaxmapError
from jaxmap.geometry.bounds import usable_depth
from jaxmap.geometry.options import DepthOptions
from jaxmap.refinement.refine import GroundReference, refine
from jaxmap.refinement.rig import vehicle_axes
from jaxmap.refinement.solver import Prior
from jaxmap.runs.config import MapConfig
from jaxmap.runs.refinement import DEPTH_SIGMA_M, GroundFiles, RefineInputs, read_ground, read_inputs
from jaxmap.types import pinhole

POSITION_M, ANGLE_RAD = 0.2, np.radians(1.0)
PITCH_RAD, HEIGHT_M = np.radians(2.0), 0.1
CASES = ("poses", "mounting", "own")


def disturbed(T: np.ndarray, seed: int) -> np.ndarray:
    """Every pose moved by 0.2 m and turned by 1 degree, in directions of its own."""
    rng = np.random.default_rng(seed)
    way, axis = (rng.normal(size=(len(T), 3)) for _ in range(2))
    moved = T.copy()
    moved[:, :3, 3] += POSITION_M * way / np.linalg.norm(way, axis=1, keepdims=True)
    turn = ANGLE_RAD * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    moved[:, :3, :3] = moved[:, :3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    return moved


def mounted_wrong(T: np.ndarray, seed: int) -> np.ndarray:
    """All cameras pitched by 2 degrees and 0.1 m too high or too low."""
    pitch, height = np.random.default_rng(seed).choice([-1, 1], 2)
    R = vehicle_axes(T)
    D = np.eye(4)
    D[:3, :3] = R.T @ Rotation.from_rotvec([0, pitch * PITCH_RAD, 0]).as_matrix() @ R
    D[:3, 3] = R.T @ [0, 0, height * HEIGHT_M]
    return T @ D


def aligned(T: np.ndarray, T_true: np.ndarray) -> np.ndarray:
    """Poses after the path was shifted, and turned about the vertical, to the true one."""
    here, there = T[:, :3, 3].mean(axis=0), T_true[:, :3, 3].mean(axis=0)
    a, b = (T[:, :2, 3] - here[:2]).T, (T_true[:, :2, 3] - there[:2]).T
    G = np.eye(4)
    G[:3, :3] = Rotation.from_euler("z", np.arctan2((a[0] * b[1] - a[1] * b[0]).sum(), (a * b).sum())).as_matrix()
    G[:3, 3] = there - G[:3, :3] @ here
    return G @ T


def errors(T: np.ndarray, T_true: np.ndarray) -> list[float]:
    """Root mean square and greatest error of position (cm) and attitude (deg), in the world and aligned.

    Then pitch (deg) and height (cm) of the mounting, in the mean over the frames.
    """
    numbers = []
    for poses in (T, aligned(T, T_true)):
        off_cm = 100 * np.linalg.norm(poses[:, :3, 3] - T_true[:, :3, 3], axis=1)
        turn = Rotation.from_matrix(T_true[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, :3]).magnitude()
        for values in (off_cm, np.degrees(turn)):
            numbers += [float(np.sqrt((values**2).mean())), float(values.max())]
    left, R = np.linalg.inv(T_true) @ T, vehicle_axes(T_true)
    pitch = (R @ np.degrees(Rotation.from_matrix(left[:, :3, :3]).as_rotvec()).mean(axis=0))[1]
    return [*numbers, float(pitch), float((R @ (100 * left[:, :3, 3].mean(axis=0)))[2])]


def rock_iou(T_rectified: np.ndarray, given: Namespace, inputs: RefineInputs) -> float | None:
    """IoU of rock of the map by the given labels and these poses of the rectified camera; None without labels."""
    if given.labels is None or given.truth is None:
        return None
    T = T_rectified @ np.linalg.inv(inputs.front_end.T_raw_rectified)
    T[:, :3, 3] += inputs.sequence.site_origin
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "poses.tum"
        write_tum(path, np.array([frame.timestamp_s for frame in inputs.sequence.frames]), T)
        labels = {"labeller": "files", "labels": given.labels, "labels_are": given.labels_are}
        depth = DepthOptions(max_m=RANGE_M)
        config = MapConfig(**labels, poses=path, crs=given.crs, depth=depth, max_pose_gap_s=10.0)
        return Frames(given.sequence, given.truth).scored(config).scores["iou"] or 0.0


def main() -> None:
    """Prints the table."""
    parser = command_line(__doc__)
    parser.add_argument("sequence")
    parser.add_argument("true_poses", type=Path)
    parser.add_argument("--dem", type=Path)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--labels", type=Path)
    parser.add_argument("--labels-are", default="raw", choices=("raw", "rectified"))
    parser.add_argument("--crs")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument(
        "--cases", nargs="+", choices=("poses", "mounting", "own"), default=["poses", "mounting", "own"]
    )
    given = parse(parser)
    inputs = read_inputs(given.sequence, ReadOptions(poses=given.true_poses, max_pose_gap_s=10.0, crs=given.crs))
    T_true, camera = inputs.T_world_camera, inputs.front_end.camera
    depth_m = usable_depth(camera, DEPTH_SIGMA_M, 0.5)
    grounds = {"images alone": GroundReference()}
    if given.truth:
        grounds["with labelled rocks"] = read_ground(GroundFiles(truth=(given.truth,)), inputs, depth_m)[0]
    if given.dem:
        grounds["with elevation model"] = read_ground(GroundFiles(heights=given.dem), inputs, depth_m)[0]
    columns = {"what was wrong": "<20", "poses": "<22"}
    for where in ("", "aligned "):
        columns |= {f"{where}cm": "12.2f", f"{where}max": "12.2f", f"{where}deg": "12.3f", f"{where}max.": "13.3f"}
    columns |= {"pitch, deg": "12.3f", "height, cm": "12.2f", "rock IoU": "10.3f"}
    table = Table({**columns, "s": "6.0f", "heights, cm": "13.2f", "before": "8.2f"})

    def run_case(name: str, T: np.ndarray, prior: Prior) -> None:
        table.row(name, "as given", *errors(T, T_true), rock_iou(T, given, inputs), None, None, None)
        for kind, ground in grounds.items():
            started_s = time.perf_counter()
            state = refine(inputs.frames, T, pinhole(camera), prior, ground, (0.3, depth_m))
            seconds, found = time.perf_counter() - started_s, state.rig.T_world_camera
            assert state.before is not None and state.after is not None
            spread = (100 * state.after.height_m, 100 * state.before.height_m)
            table.row(name, kind, *errors(found, T_true), rock_iou(found, given, inputs), seconds, *spread)

    table.row("nothing", "true", *errors(T_true, T_true), rock_iou(T_true, given, inputs), None, None, None)
    for seed in given.seeds:
        if "poses" in given.cases:
            run_case(f"poses, seed {seed}", disturbed(T_true, seed), Prior())
        if "mounting" in given.cases:
            prior = Prior(mounting_m=0.1, mounting_rad=np.radians(2.0))
            run_case(f"mounting, seed {seed}", mounted_wrong(T_true, seed), prior)
    if "own" in given.cases:
        try:
            own = read_inputs(given.sequence, ReadOptions(crs=given.crs))
        except JaxmapError as error:
            print(f"no poses of its own: {error}")
            return
        own_T = own.T_world_camera.copy()
        own_T[:, :3, 3] += own.sequence.site_origin - inputs.sequence.site_origin
        if [frame.name for frame in own.sequence.frames] == [frame.name for frame in inputs.sequence.frames]:
            run_case("the reader's own", own_T, Prior())


if __name__ == "__main__":
    main()
