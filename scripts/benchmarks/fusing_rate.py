"""How fast `jaxmap map OBSERVATIONS` fuses: reading, decoding and the step, without the start of the command.

    python scripts/benchmarks/fusing_rate.py [OBSERVATIONS] [--frames 60] [--rounds 5] [--json F]

Without observations, four frames of the bundled traverse (1024 x 768 pixels, three classes by the bundled network) are
perceived first. The frames are fused over and over, with the default voxels and with voxels of 0.1 m, `--frames`
of them in each round; pictures of key frames are left out, which a run has of 22 frames at most. Prints medians and the
best round, with the load of the machine: other programs on its cores make all of it slower, the time that the
processors work least so.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from jaxmap.host.cache import keep_compiled_programs
from jaxmap.host.memory import restart_with_lasting_memory
from jaxmap.mapping.step import compile_step
from jaxmap.runs.config import check_config
from jaxmap.runs.mapping_plan import Plan, plan_run

TARGETS = {"default voxels": ({}, 15.0), "voxels of 0.1 m": ({"grid": {"voxel_size_m": 0.1}}, 25.0)}
"""The settings, and the frames a second on two cores that are aimed at."""


class Fusing:
    """Fuses the frames of a plan again and again."""

    def __init__(self, plan: Plan) -> None:
        self.plan, self.voxel_map = plan, plan.mapper.init()
        self.mapper, _ = compile_step(plan.mapper, self.voxel_map, plan.frame_form, plan.params, plan.key)

    def rate(self, frames: int) -> tuple[float, float]:
        """Frames a second over so many, and the processors' milliseconds for each."""
        done, started_s, used_s = 0, time.perf_counter(), time.process_time()
        while done < frames:
            for prepared in self.plan.prepare():
                if prepared.frame is not None:
                    self.voxel_map, _ = self.mapper.step(
                        self.voxel_map, prepared.frame, self.plan.params, self.plan.key
                    )
                    jax.block_until_ready(self.voxel_map.log_odds)
                    done += 1
        return done / (time.perf_counter() - started_s), 1e3 * (time.process_time() - used_s) / done


def without_pictures(plan: Plan) -> Plan:
    """The plan, as if none of the frames were a key frame."""
    assert plan.observations is not None
    attributes = replace(plan.observations.attributes, key_frames={})
    return replace(plan, observations=replace(plan.observations, attributes=attributes))


def main() -> None:
    """Measures both sizes of voxels."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("observations", nargs="?", type=Path)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    restart_with_lasting_memory()
    keep_compiled_programs()
    with tempfile.TemporaryDirectory() as name:
        observations = given.observations
        if observations is None:
            observations = Path(name, "obs")
            words = ["perceive", "sample:traverse", "--out", str(observations), "--stop", "4"]
            subprocess.run([sys.executable, "-m", "jaxmap", *words], check=True, stdout=subprocess.DEVNULL)
        runs = {}
        for title, (settings, _) in TARGETS.items():
            runs[title] = Fusing(
                without_pictures(plan_run(str(observations), check_config(settings), lambda line: None))
            )
        for run in runs.values():
            run.rate(4)
        rates: dict[str, list[tuple[float, float]]] = {title: [] for title in runs}
        for _ in range(given.rounds):
            for title, run in runs.items():
                rates[title].append(run.rate(given.frames))
    figures: dict[str, Any] = {"load": os.getloadavg()[0], "device": jax.devices()[0].device_kind}
    for title, (_, target) in TARGETS.items():
        per_s, used_ms = (statistics.median(column) for column in zip(*rates[title], strict=True))
        most = max(rates[title])[0]
        figures[title] = {
            "frames_per_s": round(per_s, 2),
            "most": round(most, 2),
            "processor_ms": round(used_ms, 1),
            "target": target,
        }
        print(
            f"{title}: {per_s:.1f} frames/s (median; at most {most:.1f}), aimed at {target:g}; the processors work "
            f"{used_ms:.0f} ms for a frame"
        )
    print(f"{figures['device']}, {os.cpu_count()} cores, load {figures['load']:.1f}")
    if given.json:
        given.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
