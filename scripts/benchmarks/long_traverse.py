"""Maps a traverse of kilometres into tiles: memory, bytes on disk, frames a second, all against its length.

    python scripts/benchmarks/long_traverse.py [--length-m 10000] [--path straight|meander|return] [--every-m 0.5]
        [--labeller relief] [--voxel-size-m 0.05 0.05 0.2] [--memory-gib 2] [--octomap-m 20] [--observations OBS]
        [--json F]

A few matched frames of the bundled traverse are looped over poses along the path, at the height and tilt that each was
taken with, so that nothing but fusion and tiles is timed: the step, moving the block, writing and committing tiles, as
`jaxmap map` does it. Prints a line for each tenth of the length. `--octomap-m` maps as much of the same traverse with
OctoMap in cubes of the shortest edge (octomap-python), which holds its map in memory. `--observations` maps
observations with one worker and with two, as commands of their own.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jaxlie
import numpy as np

from jaxmap.geometry.bounds import grid_around_views, view_boxes
from jaxmap.geometry.camera import disparity_to_points
from jaxmap.geometry.grid import window_shape
from jaxmap.host.cache import keep_compiled_programs
from jaxmap.host.memory import peak_resident_mib, restart_with_lasting_memory
from jaxmap.mapping.attributes import MapAttributes
from jaxmap.mapping.sequence import prepare_frames
from jaxmap.mapping.step import compile_step, make_mapper
from jaxmap.mapping.tiles import MovingBlock, TileStore, block_shape, channels_of, whole_tiles
from jaxmap.runs.config import check_config
from jaxmap.runs.mapping_plan import DEFAULT_VOXEL_M, Plan, plan_run
from jaxmap.types import Frame, to_device

VIEWS, ROWS = 4, 10
COMMIT_EVERY_S = 60.0
"""As `jaxmap map` does it."""


def path_of(kind: str, length_m: float, every_m: float) -> np.ndarray:
    """East, north and heading (rad) of poses along a path, (N, 3).

    `meander` swings 20 m to both sides; `return` comes back along its own track.
    """
    along_m = np.arange(0.0, length_m, every_m)
    if kind == "return":
        back = along_m > length_m / 2
        return np.stack([np.where(back, length_m - along_m, along_m), 0 * along_m, np.pi * back], axis=1)
    if kind == "straight":
        return np.stack([along_m, 0 * along_m, 0 * along_m], axis=1)
    # Sampled finely, then by its own length: a metre of the meander is a metre.
    x = np.linspace(0.0, length_m, int(20 * length_m))
    y = 20 * np.sin(2 * np.pi * x / 200)
    run_m = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    x = np.interp(along_m, run_m, x)
    heading = np.arctan(20 * 2 * np.pi / 200 * np.cos(2 * np.pi * x / 200))
    return np.stack([x, 20 * np.sin(2 * np.pi * x / 200), heading], axis=1)


def poses_along(track: np.ndarray, T_views: np.ndarray) -> np.ndarray:
    """Camera poses (N, 4, 4) along a track: of the views in turn, each with its own height and tilt."""
    views = T_views[np.arange(len(track)) % len(T_views)]
    turn = track[:, 2] - np.arctan2(views[:, 1, 2], views[:, 0, 2])
    cos, sin, poses = np.cos(turn), np.sin(turn), views.copy()
    poses[:, 0, :3] = cos[:, None] * views[:, 0, :3] - sin[:, None] * views[:, 1, :3]
    poses[:, 1, :3] = sin[:, None] * views[:, 0, :3] + cos[:, None] * views[:, 1, :3]
    poses[:, :2, 3] = track[:, :2]
    poses[:, 2, 3] -= T_views[0, 2, 3] - 1.1
    return poses


@dataclass
class Watch:
    """Seconds of each stage, and a table that is printed line by line."""

    every: int
    every_m: float
    folder: Path
    stages_s: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    rows: list[dict[str, float]] = field(default_factory=list)
    _before: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Times a stage."""
        started_s = time.perf_counter()
        yield
        self.stages_s[name] += time.perf_counter() - started_s

    def row(self, frames: int, tiles: int) -> None:
        """Adds and prints what the last stretch took."""
        spent_s = {name: self.stages_s[name] - self._before.get(name, 0.0) for name in ("step", "move", "save")}
        self._before = dict(self.stages_s)
        stretch_m, length_m = self.every * self.every_m, frames * self.every_m
        self.rows.append(
            {
                "length_m": length_m,
                "frames_per_s": self.every / sum(spent_s.values()),
                **{f"{name}_ms_per_m": 1e3 * seconds / stretch_m for name, seconds in spent_s.items()},
                "resident_mib": resident_mib(),
                "peak_mib": peak_resident_mib(),
                "tiles": tiles,
                "disk_kib_per_m": stored_bytes(self.folder) / 2**10 / length_m,
            }
        )
        if len(self.rows) == 1:
            print("".join(f"{name:>16s}" for name in self.rows[0]))
        print("".join(f"{value:16,.1f}" for value in self.rows[-1].values()), flush=True)


def resident_mib() -> float:
    """Memory of the process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def stored_bytes(folder: Path) -> int:
    """Bytes of the files below a folder."""
    return sum(Path(parent, name).stat().st_size for parent, _, names in os.walk(folder) for name in names)


def map_traverse(given: argparse.Namespace, plan: Plan, frames: list[Frame], poses: np.ndarray) -> list[dict[str, Any]]:
    """Maps the traverse into a folder that is removed; returns the rows of the table."""
    camera, reach_m = plan.front_end.camera, plan.depth_range_m[1]
    grid = whole_tiles(grid_around_views(camera, poses, reach_m, tuple(given.voxel_size_m), (2.5, 1.5)))
    classes = plan.labeller.classes
    window = window_shape(grid, camera, reach_m, poses)
    shape = block_shape(grid, window, channels_of(len(classes), surface=plan.rule.surface), given.memory_gib * 2**30)
    assert shape is not None, "--memory-gib holds no block"
    mapper = make_mapper(camera, grid, plan.labeller, plan.rule, plan.depth_range_m, T_world_camera=poses)
    boxes = view_boxes(grid, camera, poses, reach_m)
    print(
        f"{len(poses)} frames; grid {grid.shape}, window {window}, block {shape}, device {jax.devices()[0].device_kind}"
    )
    with tempfile.TemporaryDirectory(dir=given.folder) as name:
        block = MovingBlock(TileStore(Path(name, "map.zarr"), grid, classes, surface=plan.rule.surface), shape)
        voxel_map, saved_s = block.begin(0), 0.0
        watch = Watch(max(len(poses) // ROWS, 1), given.every_m, Path(name))
        for index, pose in enumerate(poses):
            frame = replace(frames[index % VIEWS], T_world_camera=jaxlie.SE3.from_matrix(to_device(pose, np.float32)))
            if not index:
                mapper, _ = compile_step(mapper, voxel_map, frame, plan.params, plan.key)
                saved_s = time.perf_counter()
            with watch.stage("move"):
                voxel_map = block.cover(voxel_map, boxes[index])
            with watch.stage("step"):
                voxel_map, _ = mapper.step(voxel_map, frame, plan.params, plan.key)
                jax.block_until_ready(voxel_map.log_odds)
            ends = (index + 1) % watch.every == 0
            if ends or time.perf_counter() - saved_s > COMMIT_EVERY_S:
                with watch.stage("save"):
                    block.write_changes(voxel_map)
                    block.store.commit(index + 1, MapAttributes(progress={"complete": False}))
                saved_s = time.perf_counter()
            if ends:
                watch.row(index + 1, len(block.store.tiles()))
        return watch.rows


def map_with_octomap(given: argparse.Namespace, plan: Plan, frames: list[Frame], poses: np.ndarray) -> dict[str, Any]:
    """The beginning of the traverse with OctoMap's `insertPointCloud`: rays of all points within the range."""
    import octomap

    (near_m, far_m), camera = plan.depth_range_m, plan.front_end.camera
    clouds = []
    for frame in frames:
        points, valid = (np.asarray(value) for value in disparity_to_points(camera, frame.matched_px))
        depth_m = points[..., 2]
        clouds.append(points[valid & (depth_m >= near_m) & (depth_m <= far_m)].astype(np.float64))
    tree, before_mib, started_s = octomap.OcTree(min(given.voxel_size_m)), resident_mib(), time.perf_counter()
    count = min(len(poses), max(1, round(given.octomap_m / given.every_m)))
    for index, pose in enumerate(poses[:count]):
        world = clouds[index % VIEWS] @ pose[:3, :3].T + pose[:3, 3]
        tree.insertPointCloud(world, pose[:3, 3].copy(), maxrange=-1.0, discretize=True)
    length_m, spent_s = count * given.every_m, time.perf_counter() - started_s
    with tempfile.TemporaryDirectory(dir=given.folder) as name:
        tree.write(str(Path(name, "map.ot")).encode())
        figures = {
            "length_m": length_m,
            "frames_per_s": count / spent_s,
            "memory_kib_per_m": (resident_mib() - before_mib) * 2**10 / length_m,
            "disk_kib_per_m": stored_bytes(Path(name)) / 2**10 / length_m,
            "voxel_m": min(given.voxel_size_m),
        }
    print("OctoMap: " + ", ".join(f"{name} {value:,.2f}" for name, value in figures.items()))
    return figures


def with_workers(observations: Path) -> dict[str, float]:
    """Seconds of `jaxmap map` from observations with one worker and with two, and their ratio."""
    times_s = []
    for workers in (1, 2):
        with tempfile.TemporaryDirectory() as name:
            words = ["map", str(observations), "--out", str(Path(name, "run")), "--workers", str(workers)]
            started_s = time.perf_counter()
            subprocess.run([sys.executable, "-m", "jaxmap", *words], check=True, stdout=subprocess.DEVNULL)
            times_s.append(time.perf_counter() - started_s)
    one_s, two_s = times_s
    print(f"workers: 1 takes {one_s:.1f} s, 2 take {two_s:.1f} s: {one_s / two_s:.2f} times as fast")
    return {"one_worker_s": one_s, "two_workers_s": two_s}


def main() -> None:
    """Runs the traverse."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--length-m", type=float, default=1000.0)
    parser.add_argument("--path", choices=["straight", "meander", "return"], default="meander")
    parser.add_argument("--every-m", type=float, default=0.5, help="between frames")
    parser.add_argument("--labeller", choices=["none", "plane", "relief"], default="relief")
    parser.add_argument("--voxel-size-m", type=float, nargs=3, default=list(DEFAULT_VOXEL_M))
    parser.add_argument("--memory-gib", type=float, default=2.0, help="for the block while it moves")
    parser.add_argument("--octomap-m", type=float, default=0.0, help="length for OctoMap; 0 leaves it out")
    parser.add_argument("--observations", type=Path, help="map these with one worker and with two")
    parser.add_argument("--folder", type=Path, help="where the map lies while it is made")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    # As the command does.
    restart_with_lasting_memory()
    keep_compiled_programs()
    plan = plan_run("sample:traverse", check_config({"labeller": given.labeller, "stop": VIEWS}), str)
    prepared = prepare_frames(plan.sequence, plan.front_end)
    frames = [one.frame for one in prepared if one.frame is not None]
    T_views = plan.sequence.T_world_camera @ plan.front_end.T_raw_rectified
    poses = poses_along(path_of(given.path, given.length_m, given.every_m), T_views)
    figures: dict[str, Any] = {"path": given.path, "load": os.getloadavg()[0]}
    figures["rows"] = map_traverse(given, plan, frames, poses)
    half = len(figures["rows"]) // 2
    growth = figures["rows"][-1]["resident_mib"] - figures["rows"][half]["resident_mib"]
    print(f"peak {peak_resident_mib():,.0f} MiB; over the second half memory grew by {growth:.1f} MiB")
    if given.octomap_m:
        figures["octomap"] = map_with_octomap(given, plan, frames, poses)
    if given.observations:
        figures["workers"] = with_workers(given.observations)
    if given.json:
        given.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
