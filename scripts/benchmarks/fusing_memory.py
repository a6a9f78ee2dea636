"""How near the fusion of a frame comes to touching its memory once: 786,432 points, by the size of the voxels.

    python scripts/benchmarks/fusing_memory.py [--rounds 40] [--json F]

Touching once is to read the frame's points, labels, flags and depths, and to read and write the voxels that it changes
(`peers.memory_pass`): no program that does so is faster. Carving and integration (`bench.py`, case `fuse`) are timed
in turn with it, by the kernel and in JAX alone. Prints medians of time and of processor time, which other programs on
the machine disturb less, and their ratios to touching once.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from pathlib import Path
from typing import Any

from jaxmap.host.memory import restart_with_lasting_memory

TARGET = 2.0


def main() -> None:
    """Measures voxels of 0.2 m, of 0.1 m, and the default ones."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    restart_with_lasting_memory()
    figures: dict[str, Any] = {"load": os.getloadavg()[0]}
    for size, edge_m in (("medium", (0.2, 0.2, 0.2)), ("tenth", (0.1, 0.1, 0.1)), ("large", None)):
        figures[size] = measure(size, edge_m, given.rounds)
    print(f"target: {TARGET:g} times; load {figures['load']:.1f}")
    if given.json:
        given.json.write_text(json.dumps(figures, indent=2) + "\n")


def measure(size: str, edge_m: tuple[float, float, float] | None, rounds: int) -> dict[str, dict[str, float]]:
    """Times one size of voxels; prints a line for each program."""
    import ours
    from cases import touched_once
    from scene import VOXEL_M, make_scene

    from jaxmap.fusion.frame import add_plainly

    if edge_m is not None:
        VOXEL_M[size] = edge_m
    scene = make_scene()
    kernel = ours.fuse_frame(scene, size)
    runs = {
        "touched once": touched_once(scene, kernel),
        "the step": kernel.run,
        "in JAX alone": ours.fuse_frame(scene, size, add_plainly).run,
    }
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            started_s, used_s = time.perf_counter(), time.process_time()
            run()
            taken[name].append((1e3 * (time.perf_counter() - started_s), 1e3 * (time.process_time() - used_s)))
    medians = {name: [statistics.median(column) for column in zip(*rows, strict=True)] for name, rows in taken.items()}
    once_ms, once_used_ms = medians["touched once"]
    print(f"voxels of {' x '.join(map(str, VOXEL_M[size]))} m")
    for name, (ms, used_ms) in medians.items():
        print(
            f"  {name:14s}{ms:8.2f} ms {ms / once_ms:6.1f} times; processors {used_ms:7.2f} ms "
            f"{used_ms / once_used_ms:6.1f} times"
        )
    return {name: {"ms": round(ms, 3), "processor_ms": round(used, 3)} for name, (ms, used) in medians.items()}


if __name__ == "__main__":
    main()
