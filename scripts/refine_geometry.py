"""Prints how well `jaxmap refine` finds back what was made wrong: poses of each frame, or the camera's mounting.

    python scripts/refine_geometry.py SEQUENCE TRUE_POSES.tum [--dem F] [--truth LABELS.tif --labels DIR] [--seeds 0 1]

True poses are made wrong by 0.2 m and 1 degree in random directions, frame by frame, or all by 2 degrees of pitch and
0.1 m of height in the camera's mounting; then they are refined, from the images alone and with what is known of the
ground, and compared with the true ones. Errors are of all poses as they lie in the world, and once more after the path
as a whole was shifted and turned about the vertical to the true one: what is left then is what bends the map. Last come
the poses that the reader itself estimates, if it does. With --labels and --truth, maps with all these poses are scored:
IoU of rock in cells of 0.2 m within 8 m of the camera.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jaxmap.datasets import ReadOptions
from jaxmap.datasets.pose_files import write_tum
from jaxmap.errors import JaxmapError
from jaxmap.evaluation.evaluate import ScoringOptions, evaluate_map
from jaxmap.geometry.bounds import usable_depth
from jaxmap.host.cache import keep_compiled_programs
from jaxmap.mapping.sequence import prepare_frames, run_sequence
from jaxmap.refinement.frames import pinhole
from jaxmap.refinement.refine import GroundReference, Refinement, refine
from jaxmap.refinement.rig import vehicle_axes
from jaxmap.refinement.solver import Prior
from jaxmap.runs.config import DepthConfig, MapConfig
from jaxmap.runs.evaluation import TruthOptions, class_map_of, read_truth
from jaxmap.runs.mapping_plan import plan_run
from jaxmap.runs.refinement import DEPTH_SIGMA_M, GroundFiles, RefineInputs, read_ground, read_inputs

POSITION_M, ANGLE_RAD = 0.2, np.radians(1.0)
PITCH_RAD, HEIGHT_M = np.radians(2.0), 0.1


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


def errors(T: np.ndarray, T_true: np.ndarray) -> str:
    """Root mean square and greatest error of position (cm) and attitude (deg); in the world, and aligned."""
    texts = []
    for poses in (T, aligned(T, T_true)):
        off_cm = 100 * np.linalg.norm(poses[:, :3, 3] - T_true[:, :3, 3], axis=1)
        turn = Rotation.from_matrix(T_true[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, :3]).magnitude()
        turn = np.degrees(turn)
        texts.append(
            f"{np.sqrt((off_cm**2).mean()):7.2f}{off_cm.max():7.2f}{np.sqrt((turn**2).mean()):8.3f}{turn.max():7.3f}"
        )
    return "  |".join(texts)


def mounting_errors(T: np.ndarray, T_true: np.ndarray) -> str:
    """What is left of roll, pitch, heading (deg) and forward, left, up (cm), in the mean over the frames."""
    left = np.linalg.inv(T_true) @ T
    R = vehicle_axes(T_true).R_vehicle_camera
    turn = R @ np.degrees(Rotation.from_matrix(left[:, :3, :3]).as_rotvec()).mean(axis=0)
    way = R @ (100 * left[:, :3, 3].mean(axis=0))
    return f"roll {turn[0]:.3f} pitch {turn[1]:.3f} heading {turn[2]:.3f} deg; height {way[2]:.2f} cm"


def refined(inputs: RefineInputs, T: np.ndarray, prior: Prior, ground: GroundReference) -> tuple[Refinement, float]:
    """Refines poses of the rectified camera; and the seconds that took."""
    camera = inputs.front_end.camera
    depth_range_m = (0.3, usable_depth(camera, DEPTH_SIGMA_M, 0.5))
    started_s = time.perf_counter()
    return refine(inputs.frames, T, pinhole(camera), prior, ground, depth_range_m), time.perf_counter() - started_s


class Scorer:
    """Scores the map that some poses give."""

    def __init__(self, given: argparse.Namespace, inputs: RefineInputs) -> None:
        self._given, self._inputs = given, inputs

    def __call__(self, T_rectified: np.ndarray) -> str:
        """IoU of rock with the given labels; empty without labels."""
        given, sequence = self._given, self._inputs.sequence
        if given.labels is None or given.truth is None:
            return ""
        T = T_rectified @ np.linalg.inv(self._inputs.front_end.T_raw_rectified)
        T[:, :3, 3] += sequence.site_origin
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "poses.tum"
            write_tum(path, np.array([frame.timestamp_s for frame in sequence.frames]), T)
            config = MapConfig(
                labeller="files", labels=given.labels, labels_are=given.labels_are, poses=path, crs=given.crs,
                depth=DepthConfig(max_m=8.0), max_pose_gap_s=10.0,
            )  # fmt: skip
            plan = plan_run(given.sequence, config, lambda line: None)
        frames = prepare_frames(plan.sequence, plan.front_end, plan.label_folder)
        steps = run_sequence(plan.mapper, plan.mapper.init(), frames, plan.params, plan.key)
        voxel_map, _ = deque(steps, maxlen=1).pop()
        where = {"site_origin": plan.sequence.site_origin, "crs": plan.sequence.crs}
        class_map = class_map_of(voxel_map, plan.params.fusion, plan.rule, "rock", **where)
        raster = read_truth([given.truth], class_map.place, TruthOptions())
        scores = evaluate_map(class_map, raster, None, ScoringOptions(cell_size_m=0.2)).scores
        return f"   map: rock IoU {scores['iou'] or 0.0:.3f}"


def grounds(given: argparse.Namespace, inputs: RefineInputs) -> dict[str, Ground]:
    """What refinement is told of the ground: nothing, labels, an elevation model."""
    depth_m = usable_depth(inputs.front_end.camera, DEPTH_SIGMA_M, 0.5)
    found = {"images alone": GroundReference()}
    if given.truth:
        found["with labelled rocks"] = read_ground(GroundFiles(truth=(given.truth,)), inputs, depth_m)[0]
    if given.dem:
        found["with elevation model"] = read_ground(GroundFiles(heights=given.dem), inputs, depth_m)[0]
    return found


def run_case(
    name: str,
    T: np.ndarray,
    T_true: np.ndarray,
    inputs: RefineInputs,
    prior: Prior,
    told: dict[str, Ground],
    score: Scorer,
) -> None:
    """Refines wrong poses with each kind of ground, and prints what is left."""
    print(f"\n{name}\n  {'as given':24s}{errors(T, T_true)}{score(T)}")
    if prior.mounting_rad:
        print(f"  {'':24s}{mounting_errors(T, T_true)}")
    for kind, ground in told.items():
        state, seconds = refined(inputs, T, prior, ground)
        found = state.rig.T_world_camera
        assert state.solution is not None and state.before is not None and state.after is not None
        print(
            f"  {kind:24s}{errors(found, T_true)}{score(found)}   {seconds:.0f} s, spread of heights "
            f"{100 * state.before.height_m:.2f} -> {100 * state.after.height_m:.2f} cm",
            flush=True,
        )
        if prior.mounting_rad:
            print(f"  {'':24s}{mounting_errors(found, T_true)}")


def main(words: Sequence[str] | None = None) -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence")
    parser.add_argument("true_poses", type=Path)
    parser.add_argument("--dem", type=Path)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--labels", type=Path)
    parser.add_argument("--labels-are", default="raw", choices=("raw", "rectified"))
    parser.add_argument("--crs")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--cases", nargs="+", default=["poses", "mounting", "own"])
    given = parser.parse_args(words)
    keep_compiled_programs()
    inputs = read_inputs(given.sequence, ReadOptions(poses=given.true_poses, max_pose_gap_s=10.0, crs=given.crs))
    T_true, told, score = inputs.T_world_camera, grounds(given, inputs), Scorer(given, inputs)
    print(f"{given.sequence}: {len(T_true)} frames")
    print(f"{'':26s}{'position, cm':>14s}{'angle, deg':>15s}  |{'aligned: cm':>14s}{'deg':>15s}   (rms, greatest)")
    print(f"  {'true':24s}{errors(T_true, T_true)}{score(T_true)}")
    for seed in given.seeds:
        if "poses" in given.cases:
            prior = Prior()
            run_case(f"poses wrong, seed {seed}", disturbed(T_true, seed), T_true, inputs, prior, told, score)
        if "mounting" in given.cases:
            prior = Prior(mounting_m=0.1, mounting_rad=np.radians(2.0))
            run_case(f"mounting wrong, seed {seed}", mounted_wrong(T_true, seed), T_true, inputs, prior, told, score)
    if "own" in given.cases:
        try:
            own = read_inputs(given.sequence, ReadOptions(crs=given.crs))
        except JaxmapError as error:
            print(f"\nno poses of its own: {error}")
            return
        own_T = own.T_world_camera.copy()
        own_T[:, :3, 3] += own.sequence.site_origin - inputs.sequence.site_origin
        names = [frame.name for frame in own.sequence.frames]
        kept = [index for index, frame in enumerate(inputs.sequence.frames) if frame.name in names]
        if len(kept) == len(T_true) == len(names):
            run_case("poses as the reader estimates them", own_T, T_true, inputs, Prior(), told, score)


if __name__ == "__main__":
    main()
