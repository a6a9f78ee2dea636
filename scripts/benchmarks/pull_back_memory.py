"""Shows that the gradient of a map's score takes the memory of one frame, however many frames made the map.

    python scripts/benchmarks/pull_back_memory.py [--frames 1 10 50 200] [--plain 1 10 50]

For each number of frames, two processes take the same gradient: one by the pull-back (`map_gradient`), one by plain
reverse mode through the scan. The frames are views of a slope with soft labels, made anew whenever they are read.
Prints one table: the compiler's count of temporary memory, the peak resident size of each process, and the relative
difference of the two gradients.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import ours

from jaxmap.host.memory import peak_resident_mib
from jaxmap.types import Frame, make_stereo_camera

HEIGHT_PX, WIDTH_PX = 240, 320
CAMERA = make_stereo_camera(
    fx_px=260, cx_px=159.5, cy_px=119.5, baseline_m=0.12, width_px=WIDTH_PX, height_px=HEIGHT_PX
)


def make_frame(index: int) -> Frame:
    """A view of rough ground, 1 m below the camera, which moves ahead by 2 cm a frame and looks down by 20 degrees."""
    rng = np.random.default_rng(index)
    row = (np.arange(HEIGHT_PX) - float(CAMERA.cy_px))[:, None] / float(CAMERA.fy_px)
    down = np.cos(0.35) * row + np.sin(0.35)
    depth_m = np.where(down > 0.05, 1.0 / np.maximum(down, 0.05), np.nan) * rng.normal(1, 0.01, (HEIGHT_PX, WIDTH_PX))
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, -np.sin(0.35), np.cos(0.35)], [0, -np.cos(0.35), -np.sin(0.35)]]
    pose[:3, 3] = [0.0, index * 0.02, 1.0]
    soft = rng.dirichlet(np.ones(3), (HEIGHT_PX, WIDTH_PX))
    return Frame(
        jnp.asarray(0.12 * 260 / depth_m, jnp.float32),
        jaxlie.SE3.from_matrix(jnp.asarray(pose, jnp.float32)),
        class_probabilities=jnp.asarray(soft, jnp.float32),
    )


class Frames:
    """So many frames, made whenever they are read."""

    def __init__(self, count: int) -> None:
        self._count = count

    def __iter__(self) -> Iterator[Frame]:
        return map(make_frame, range(self._count))


def measure(way: str, count: int) -> dict[str, Any]:
    """The gradient, the compiler's count of temporary memory and the peak resident size of this process."""
    if way == "scan":
        frames = jax.tree.map(lambda *leaves: jnp.stack(leaves), *Frames(count))
        gradient, temporary = ours.gradient_by_scan(CAMERA, frames)
    else:
        gradient, temporary = ours.gradient_by_pull_back(CAMERA, Frames(count))
    numbers = np.concatenate([np.asarray(leaf).ravel() for leaf in jax.tree.leaves(gradient)])
    return {
        "gradient": numbers.tolist(),
        "temporary_mib": temporary / 2**20,
        "resident_mib": peak_resident_mib(),
    }


def in_process(way: str, count: int) -> dict[str, Any]:
    """`measure` in a process of its own."""
    command = [sys.executable, __file__, "--measure", way, "--frames", str(count)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Prints one line for each number of frames."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[1, 10, 50, 200])
    parser.add_argument("--plain", type=int, nargs="*", help="numbers of frames for the scan; by default all")
    parser.add_argument("--measure", choices=("pull-back", "scan"), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.measure:
        print(json.dumps(measure(given.measure, given.frames[0])))
        return
    print(f"{'':8s}{'temporary memory, MiB':>24s}{'peak resident, MiB':>24s}{'gradients differ by':>22s}")
    print(f"{'frames':8s}{'pull-back':>12s}{'scan':>12s}{'pull-back':>12s}{'scan':>12s}{'(relative)':>22s}")
    for count in given.frames:
        pulled, plain = in_process("pull-back", count), None
        if given.plain is None or count in given.plain:
            plain = in_process("scan", count)
        row = f"{count:<8d}"
        for key in ("temporary_mib", "resident_mib"):
            row += f"{pulled[key]:12.1f}" + (f"{plain[key]:12.1f}" if plain else f"{'-':>12s}")
        if plain:
            one, other = np.array(pulled["gradient"]), np.array(plain["gradient"])
            row += f"{np.abs(one - other).max() / np.abs(other).max():22.1e}"
        print(row, flush=True)


if __name__ == "__main__":
    main()
