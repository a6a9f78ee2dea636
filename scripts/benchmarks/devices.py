"""Frames a second on one device and on several, and whether their maps are equal.

    python scripts/benchmarks/devices.py [--devices N] [--frames 64] [--labeller relief] [--json F]
    XLA_FLAGS=--xla_force_host_platform_device_count=2 python scripts/benchmarks/devices.py --frames 8

The second line runs it without GPUs, on two virtual devices that share the cores: it shows that the maps are equal, not
that it is faster. The frames are matched beforehand and looped, so that nothing but fusion is timed.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxmap.host.cache import keep_compiled_programs
from jaxmap.mapping.devices import Device, choose_devices, run_on_devices
from jaxmap.mapping.sequence import PreparedFrame, prepare_frames
from jaxmap.runs.config import check_config
from jaxmap.runs.mapping_plan import Plan, plan_run

VIEWS = 4


def fused(plan: Plan, frames: Sequence[PreparedFrame], devices: Sequence[Device]) -> tuple[float, np.ndarray]:
    """Frames a second, without the first batch, which compiles; and the map."""
    batch = len(devices)
    started_s, voxel_map = 0.0, plan.mapper.init()
    # Each frame keeps its own times.
    fresh: Iterator[PreparedFrame] = (replace(one, stages_s={}) for one in frames)
    run = run_on_devices(plan.mapper, voxel_map, fresh, plan.params, plan.key, devices)
    for number, (after, _) in enumerate(run, 1):
        voxel_map = after
        if number == batch:
            started_s = time.perf_counter()
    return (len(frames) - batch) / (time.perf_counter() - started_s), np.asarray(voxel_map.log_odds)


def main() -> None:
    """Compares one device with several."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", type=int, default=jax.local_device_count())
    parser.add_argument("--frames", type=int, default=64)
    parser.add_argument("--labeller", choices=["none", "plane", "relief"], default="relief")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    keep_compiled_programs()
    config = check_config({"labeller": given.labeller, "stop": VIEWS})
    plan = plan_run("sample:traverse", config, lambda line: None)
    ready = [one for one in prepare_frames(plan.sequence, plan.front_end) if one.frame is not None]
    frames = list(islice(cycle(ready), given.frames))
    one_per_s, expected = fused(plan, frames, choose_devices(1))
    all_per_s, found = fused(plan, frames, choose_devices(given.devices))
    figures: dict[str, Any] = {
        "device": jax.devices()[0].device_kind,
        "devices": given.devices,
        "one_frames_per_s": round(one_per_s, 2),
        "all_frames_per_s": round(all_per_s, 2),
        "greatest_difference": float(np.abs(found - expected).max()),
    }
    print(
        f"{figures['device']}: {one_per_s:.1f} frames/s on one, {all_per_s:.1f} on {given.devices} "
        f"({all_per_s / one_per_s:.2f} times as many); the maps differ by at most {figures['greatest_difference']:.2g}"
    )
    if given.json:
        given.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
