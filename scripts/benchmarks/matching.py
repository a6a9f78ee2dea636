"""Time of semi-global matching in JAX beside OpenCV's modes, in one process, in turns.

    python scripts/benchmarks/matching.py [--sizes 512x384x64 1024x768x128 --matchers 3way hh census bt --rounds 7]

The pair is scikit-image's Motorcycle, scaled. `wall` and `cpu` are medians in ms of the clock and of all threads of the
process; a matcher that runs on two cores has less of the first. All drop speckles and keep edges of depth. The load of
the machine is printed, since other work slows down whichever matcher uses more memory or more threads.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable

import cv2
import jax
import numpy as np
from skimage.data import stereo_motorcycle

from jaxmap.host.cache import keep_compiled_programs
from jaxmap.matching.design import MatchDesign, make_match_params
from jaxmap.matching.match import match
from jaxmap.stereo.match import Matcher, StereoOptions

matched = jax.jit(match, static_argnums=0)


def matcher(name: str, width_px: int, count: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """OpenCV's by its mode, or ours by its cost; `census4` has four paths, `census1` compares pixels, not blocks."""
    options = StereoOptions(num_disparities=count, edge_step_px=0)
    if name in ("3way", "sgbm", "hh", "hh4"):
        return Matcher(StereoOptions(num_disparities=count, edge_step_px=0, mode=name), width_px)
    design = MatchDesign(
        cost="bt" if name == "bt" else "census",
        num_disparities=count,
        paths=4 if name == "census4" else 8,
        block_size=1 if name == "census1" else options.block_size,
        edge_step_px=0,
    )
    params = make_match_params(design.cost)
    return lambda left, right: np.asarray(matched(design, left, right, params))


def main() -> None:
    """Prints one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=["512x384x64", "1024x768x128"])
    parser.add_argument("--matchers", nargs="+", default=["3way", "sgbm", "hh", "census", "census4", "census1", "bt"])
    parser.add_argument("--rounds", type=int, default=7)
    given = parser.parse_args()
    keep_compiled_programs()
    print(f"{'size':<14}{'matcher':<9}{'wall':>8}{'cpu':>8}   of hh's cpu")
    for size in given.sizes:
        width_px, height_px, count = (int(number) for number in size.split("x"))
        left, right = (
            cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (width_px, height_px), interpolation=cv2.INTER_AREA)
            for image in stereo_motorcycle()[:2]
        )
        matchers = {name: matcher(name, width_px, count) for name in given.matchers}
        spent: dict[str, list[tuple[float, float]]] = {name: [] for name in matchers}
        for round_index in range(given.rounds + 1):
            for name, run in matchers.items():
                wall_s, cpu_s = time.perf_counter(), time.process_time()
                run(left, right)
                times_ms = 1e3 * (time.perf_counter() - wall_s), 1e3 * (time.process_time() - cpu_s)
                if round_index:
                    spent[name].append(times_ms)
        medians = {name: np.median(times, axis=0) for name, times in spent.items()}
        for name, (wall, cpu) in medians.items():
            share = f"{cpu / medians['hh'][1]:8.2f}" if "hh" in medians else ""
            print(f"{size:<14}{name:<9}{wall:>8.0f}{cpu:>8.0f}   {share}", flush=True)
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores, OpenCV with {cv2.getNumThreads()} threads")


if __name__ == "__main__":
    main()
