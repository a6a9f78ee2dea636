"""Kills `jaxmap perceive` and `jaxmap map` on workers with SIGKILL, and shows that what comes out is the same.

    python scripts/benchmarks/kill_nine.py [--points 50] [--workers 2] [--frames 12] [--seed 0]

Each stage runs once in peace, which also tells how long it takes. Then, for each point, it is begun anew, the whole
group of its processes (odd points) or one of its workers (even points) is killed at a random moment, and it is resumed.
Prints a line a point: when it was killed, what was there, and whether the arrays are the same to the bit.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import zarr
from scene import resized_scene, write_sequence

ROOT = Path(__file__).resolve().parents[2]
MAP = ("--grid.voxel-size-m", "0.1", "--depth.max-m", "4", "--grid.max-memory-gib", "0.2")


def digest(folder: Path) -> str:
    """A fingerprint of all arrays of a group, by name."""
    told = hashlib.sha256()
    for path in sorted(path.parent for path in folder.rglob("zarr.json")):
        node = zarr.open(path, mode="r")
        if isinstance(node, zarr.Array):
            told.update(str(path.relative_to(folder)).encode() + np.ascontiguousarray(node[...]).tobytes())
    return told.hexdigest()[:16]


def begin(*words: object) -> subprocess.Popen[bytes]:
    """Starts a command of jaxmap in a group of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    command = [sys.executable, "-m", "jaxmap", *map(str, words)]
    return subprocess.Popen(command, env=environment, start_new_session=True, **quiet)


def finish(process: subprocess.Popen[bytes]) -> None:
    """Waits for a command that must succeed."""
    _, told = process.communicate()
    if process.returncode:
        raise SystemExit(told.decode()[-2000:])


def workers_of(process: int) -> list[int]:
    """The processes that a command has started for its tasks."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return [int(child) for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]


def kill(process: subprocess.Popen[bytes], *, whole: bool) -> str:
    """Kills the command with all that it has started, or one of its workers; says which."""
    if process.poll() is not None:
        return "had ended"
    workers = [] if whole else workers_of(process.pid)
    if workers:
        os.kill(random.choice(workers), signal.SIGKILL)
        finish(process)
        return "a worker"
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    return "the command"


def stage(name: str, words: list[object], out: Path, array: str, arguments: argparse.Namespace) -> int:
    """Kills one stage at random points; returns how many of them came out otherwise."""
    started_s = time.perf_counter()
    finish(begin(*words, "--out", out, "--workers", arguments.workers))
    takes_s, expected = time.perf_counter() - started_s, digest(out / array)
    print(f"{name}: {takes_s:.1f} s in peace, {expected}", flush=True)
    wrong = 0
    for point in range(arguments.points):
        again = out.with_name(f"{out.name}_again")
        shutil.rmtree(again, ignore_errors=True)
        process = begin(*words, "--out", again, "--workers", arguments.workers)
        at_s = random.uniform(0, takes_s)
        time.sleep(at_s)
        killed = kill(process, whole=point % 2 == 1)
        there = sum(1 for path in again.rglob("*") if path.is_file())
        if killed == "the command":
            resume = ["--resume"] if name == "map" else []
            finish(begin(*words, "--out", again, "--workers", arguments.workers, *resume))
        same = digest(again / array) == expected
        wrong += not same
        outcome = "same" if same else "OTHER"
        print(f"{name} {point:3d}: {killed} at {at_s:6.2f} s, {there:4d} files there: {outcome}", flush=True)
    return wrong


def main() -> int:
    """Runs both stages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("points", 50), ("workers", 2), ("frames", 12), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    arguments = parser.parse_args()
    random.seed(arguments.seed)
    with tempfile.TemporaryDirectory() as folder:
        seen, run = (Path(folder, name) for name in ("seen", "run"))
        with write_sequence(resized_scene(256, 192), arguments.frames) as images:
            wrong = stage("perceive", ["perceive", images, "--labeller", "plane"], seen, "observations.zarr", arguments)
        wrong += stage("map", ["map", seen, *MAP], run, "map.zarr", arguments)
    print(f"{wrong} of {2 * arguments.points} came out otherwise")
    return min(wrong, 1)


if __name__ == "__main__":
    sys.exit(main())
