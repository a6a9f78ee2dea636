"""What a corrected trajectory costs: a part of a traverse is moved, and the map of its observations brought up to date.

    python scripts/benchmarks/corrected_poses.py [--frames 400] [--moved 0.05] [--step-m 1.0] [--shift-m 0.3]

The traverse is made up: small frames of 40 x 30 px whose views are as large as those of a rover at coarse voxels, so
that what counts is how many frames are fused. Maps it, moves its last frames as a loop closure does (by a shift that
grows along them), updates the map, maps it anew, and prints steps and seconds of each, and whether the last two are the
same to the bit.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from observed_scenes import FARTHEST_M, VOXEL_M, write_traverse

from jaxmap.datasets.poses import write_tum
from jaxmap.host.cache import keep_compiled_programs
from jaxmap.host.executors import Workers
from jaxmap.mapping.store import load_map
from jaxmap.runs.config import config_of_observations
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.fusing import map_observations


@contextmanager
def timed(title: str, unit: str, total: int):
    """Takes the time of fusing alone, without pictures and pages; `timed.took_s` holds it."""
    started_s = time.perf_counter()
    yield lambda done: None
    timed.took_s = time.perf_counter() - started_s


def main() -> None:
    """Prints a line for each map."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("frames", 400), ("moved", 0.05), ("step-m", 1.0), ("shift-m", 0.3)):
        parser.add_argument(f"--{name}", type=type(default), default=default)
    arguments = parser.parse_args()
    keep_compiled_programs()
    with tempfile.TemporaryDirectory() as name:
        folder, count = Path(name), arguments.frames
        poses = write_traverse(folder / "seen", count, step_m=arguments.step_m)
        times_s = 10.0 + np.arange(count)
        moved = round(arguments.moved * count)
        corrected = poses.copy()
        corrected[count - moved :, 0, 3] += np.linspace(0, arguments.shift_m, moved + 1)[1:]
        write_tum(folder / "before.tum", times_s, poses)
        write_tum(folder / "after.tum", times_s, corrected)
        config = config_of_observations(folder / "seen" / "observations.zarr", None)
        grid = replace(config.grid, voxel_size_m=VOXEL_M, max_memory_gib=0.25)
        config = replace(config, grid=grid, depth=replace(config.depth, max_m=FARTHEST_M))

        def row(what: str, run: str, poses: str, **ways: bool) -> float:
            with_poses = replace(config, poses=folder / poses)
            where = RunFolder(folder / run)
            metrics = map_observations(
                str(folder / "seen"), with_poses, where, Workers(), lambda line: None, timed, **ways
            )
            shared = metrics["shared"]
            print(
                f"{what:9s} {shared['frames_fused']:5d} of {count} frames in {shared['regions']:3d} regions, "
                f"{shared['steps']:5d} steps, {shared['tiles_fused']} of {shared['tiles']} tiles, {timed.took_s:.1f} s",
                flush=True,
            )
            return shared["steps"]

        full = row("full", "run", "before.tum")
        again = row("update", "run", "after.tum", update=True)
        row("anew", "anew", "after.tum")
        one, other = (np.asarray(load_map(folder / run / "map.zarr")[0].log_odds) for run in ("run", "anew"))
        same = "the same bits" if np.array_equal(one, other) else "OTHER"
        print(f"{moved / count:.1%} of the frames moved: {again / full:.1%} of the steps of the full fusion; {same}")


if __name__ == "__main__":
    main()
