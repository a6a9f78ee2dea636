"""Shows that `jaxmap map` neither grows nor stalls over a long sequence.

    python scripts/benchmarks/endurance.py [--frames 10000] [--every 1000] [--size 160 120] [--json F]

A few images lie on disk as PNG and are looped through as one long drive: they are decoded, matched and fused as `jaxmap
map` does it, its log and its checkpoints included. Prints one table, a line every so many frames: frames a second,
resident memory, the greatest number of frames alive at once, and how long the step waited although a frame was ready
(from when both the step before was done and its frame was ready to when the step began); then the slope of the memory
over the second half.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import threading
import time
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scene import resized_scene, write_sequence

from jaxmap.datasets.base import FrameRef, StereoPair
from jaxmap.host.cache import keep_compiled_programs
from jaxmap.mapping.sequence import FusedFrame
from jaxmap.runs.config import check_config
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.mapping import run_plan
from jaxmap.runs.mapping_plan import Plan, plan_run
from jaxmap.stereo.front_end import RectifiedFrame, StereoFrontEnd

VIEWS = 12
STALL_MS = 5.0
"""From here on a wait counts as a stall; the matcher's threads share the processors with the thread that is woken."""


def looped(plan: Plan, frames: int) -> Plan:
    """The plan of so many frames, which go through those of the sequence over and over."""
    sequence = plan.sequence
    order = np.arange(frames) % len(sequence.frames)
    refs = tuple(
        FrameRef(f"{index:06d}", 0.1 * index, sequence.frames[view].left, sequence.frames[view].right)
        for index, view in enumerate(order)
    )
    return replace(plan, sequence=replace(sequence, frames=refs, T_world_camera=sequence.T_world_camera[order]))


class Watch:
    """Counts the frames that are alive, and records when each became ready and when it was fused.

    Stands in for the front end of a plan: run `plan` of this object, with `on_frame`.
    """

    def __init__(self, plan: Plan, every: int) -> None:
        self._read, self._front_end, self._every = plan.sequence.read_pair, plan.front_end, every
        self._lock, self._in_thread = threading.Lock(), threading.local()
        self._ready_s: dict[str, float] = {}
        self._fused_s = self._started_s = time.perf_counter()
        self.alive = self.most_alive = 0
        self.waits_ms: list[float] = []
        self.resident_mib: list[float] = []
        front_end: Any = self
        self.plan = replace(plan, front_end=front_end, sequence=replace(plan.sequence, read_pair=self._counted))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._front_end, name)

    def __call__(self, left: np.ndarray, right: np.ndarray) -> RectifiedFrame:
        """As the front end's own; its end is when the frame is ready."""
        rectified = StereoFrontEnd.__call__(self._front_end, left, right)
        self._ready_s[self._in_thread.name] = time.perf_counter()
        return rectified

    def _counted(self, ref: FrameRef) -> StereoPair:
        self._in_thread.name = ref.name
        pair = self._read(ref)
        self._count(1)
        weakref.finalize(pair.left, self._count, -1)
        return pair

    def _count(self, change: int) -> None:
        with self._lock:
            self.alive += change
            self.most_alive = max(self.most_alive, self.alive)

    def on_frame(self, fused: FusedFrame) -> None:
        """Records a fused frame; prints a line now and then."""
        now_s, prepared = time.perf_counter(), fused.prepared
        could_s = max(self._ready_s.pop(prepared.ref.name), self._fused_s)
        if prepared.index:
            self.waits_ms.append(1e3 * (now_s - prepared.stages_s["step"] - could_s))
        self._fused_s, count = now_s, prepared.index + 1
        if count % self._every == 0:
            resident = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
            self.resident_mib.append(resident)
            late, rate = np.array(self.waits_ms[-self._every :]), count / (now_s - self._started_s)
            print(
                f"{count:8d}{rate:14.1f}{resident:15.1f}{self.most_alive:12d}{np.median(late):17.2f}"
                f"{np.mean(late > STALL_MS):15.2%}",
                flush=True,
            )


def main() -> None:
    """Runs the long drive."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10000)
    parser.add_argument("--every", type=int, default=1000)
    parser.add_argument("--size", type=int, nargs=2, default=[160, 120], metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    keep_compiled_programs()
    with write_sequence(resized_scene(*given.size), VIEWS) as views, tempfile.TemporaryDirectory() as name:
        config = check_config({"labeller": "plane", "depth": {"max_m": 5.0}, "grid": {"voxel_size_m": 0.2}})
        plan = looped(plan_run(views, config, str), given.frames)
        watch, folder = Watch(plan, given.every), RunFolder(Path(name, "run"))
        folder.begin(plan.settings(config), resume=False, overwrite=False)
        columns = ("frames", 8), ("frames/s", 14), ("resident, MiB", 15), ("most alive", 12), ("median wait, ms", 17)
        print("".join(f"{name:>{width}s}" for name, width in (*columns, (f"over {STALL_MS:.0f} ms", 15))))
        options: dict[str, Any] = {"strict": True, "checkpoint_every_s": 30.0, "notify": str}
        metrics = run_plan(watch.plan, folder, on_frame=watch.on_frame, **options)
    later, waits_ms = watch.resident_mib[len(watch.resident_mib) // 2 :], np.array(watch.waits_ms)
    slope = np.polyfit(given.every * np.arange(len(later)), later, 1)[0] if len(later) > 1 else np.nan
    figures = {
        "frames": metrics["sequence"]["fused"],
        "frames_per_s": metrics["times"]["frames_per_s"],
        "resident_mib": [round(one, 1) for one in watch.resident_mib],
        "slope_mib_per_1000_frames": round(1000 * float(slope), 3),
        "most_frames_alive": watch.most_alive,
        "ready_frame_waited_ms": {
            "median": round(float(np.median(waits_ms)), 3),
            "p99": round(float(np.percentile(waits_ms, 99)), 3),
            f"share_over_{STALL_MS:.0f}": round(float(np.mean(waits_ms > STALL_MS)), 5),
        },
        "stages": metrics["times"]["stages"],
        "device": jax.devices()[0].device_kind,
    }
    print(
        f"memory grows by {figures['slope_mib_per_1000_frames']} MiB in 1,000 frames; a ready frame waited "
        f"{figures['ready_frame_waited_ms']['median']} ms (median), on {figures['device']}"
    )
    if given.json:
        given.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
