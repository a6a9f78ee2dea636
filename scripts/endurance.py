"""Shows that the pipelined runner neither grows nor stalls over a long sequence.

    python scripts/endurance.py [--frames 10000] [--every 1000] [--size 160 120] [--json F]

A few rendered views of a slope lie on disk as PNG and are looped through as one long drive of a camera that goes round
and round: they are decoded, matched and fused as `jaxmap map` does it, its log and its checkpoints included. Every so
many frames a line tells the resident memory, the greatest number of frames that were alive at once, and how long the
step waited although a frame was ready: the time from when both the step before was done and its frame was ready to when
the step began. Last comes the slope of the memory over the second half.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import threading
import time
import weakref
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import yaml
from PIL import Image

from jaxmap.datasets.base import FrameRef, StereoPair
from jaxmap.datasets.pose_files import write_tum
from jaxmap.host.cache import keep_compiled_programs
from jaxmap.mapping.sequence import FusedFrame
from jaxmap.runs.config import check_config
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.mapping import run_plan
from jaxmap.runs.mapping_plan import Plan, plan_run
from jaxmap.stereo.front_end import RectifiedFrame, StereoFrontEnd

VIEWS = 12
STALL_MS = 5.0
"""From here on a wait counts as one; the matcher's threads share the processors with the thread that is woken."""


def write_views(folder: Path, width_px: int, height_px: int) -> None:
    """A folder sequence: random texture on a slope, whose disparity grows from 4 px above to 20 px below."""
    rng = np.random.default_rng(0)
    disparity_px = np.linspace(4, 20, height_px).astype(int)
    poses = np.repeat(np.eye(4)[None], VIEWS, axis=0)
    for part in ("left", "right"):
        (folder / part).mkdir(parents=True)
    for index in range(VIEWS):
        right = rng.integers(0, 255, (height_px, width_px + 32), np.uint8)
        left = np.stack([np.roll(row, shift) for row, shift in zip(right, disparity_px, strict=True)])
        for part, image in (("left", left), ("right", right)):
            Image.fromarray(image[:, 32:]).save(folder / part / f"{index:03d}.png")
        turn = 2 * np.pi * index / VIEWS
        poses[index, :3, :3] = [[1, 0, 0], [0, -np.sin(0.35), np.cos(0.35)], [0, -np.cos(0.35), -np.sin(0.35)]]
        poses[index, :3, 3] = [np.cos(turn), np.sin(turn), 1.0]
    camera = dict(fx_px=140.0, cx_px=width_px / 2, cy_px=height_px / 2, baseline_m=0.12)
    (folder / "camera.yaml").write_text(yaml.safe_dump({"image_size_px": [width_px, height_px], **camera}))
    times_s = 0.1 * np.arange(VIEWS)
    (folder / "times.txt").write_text("".join(f"{time_s}\n" for time_s in times_s))
    write_tum(folder / "poses.tum", times_s, poses)


def looped(plan: Plan, frames: int) -> Plan:
    """The plan of so many frames, which go through those of the sequence over and over."""
    sequence = plan.sequence
    order = np.arange(frames) % len(sequence.frames)
    refs = tuple(
        FrameRef(f"{index:06d}", 0.1 * index, sequence.frames[view].left, sequence.frames[view].right)
        for index, view in enumerate(order)
    )
    return replace(plan, sequence=replace(sequence, frames=refs, T_world_camera=sequence.T_world_camera[order]))


class MarkedFrontEnd:
    """A front end that tells when it is done with a pair."""

    def __init__(self, front_end: StereoFrontEnd, mark: Callable[[], None]) -> None:
        self._front_end, self._mark = front_end, mark

    def __getattr__(self, name: str) -> Any:
        return getattr(self._front_end, name)

    def __call__(self, left: np.ndarray, right: np.ndarray) -> RectifiedFrame:
        """As the front end's own."""
        rectified = self._front_end(left, right)
        self._mark()
        return rectified


class Watch:
    """Counts the frames that are alive, and sees when each became ready and when it was fused."""

    def __init__(self, plan: Plan, every: int) -> None:
        """Hooks itself into the plan: run `plan` of this object, with `on_frame`."""
        self._read, self._every, self._lock = plan.sequence.read_pair, every, threading.Lock()
        self._in_thread = threading.local()
        self._ready_s: dict[str, float] = {}
        self._fused_s = self._started_s = time.perf_counter()
        self.alive = self.most_alive = 0
        self.handover_ms: list[float] = []
        self.resident_mib: list[float] = []
        front_end: Any = MarkedFrontEnd(plan.front_end, self._ready)
        self.plan = replace(plan, front_end=front_end, sequence=replace(plan.sequence, read_pair=self._counted))

    def _counted(self, ref: FrameRef) -> StereoPair:
        self._in_thread.name = ref.name
        pair = self._read(ref)
        with self._lock:
            self.alive += 1
            self.most_alive = max(self.most_alive, self.alive)
        weakref.finalize(pair.left, self._gone)
        return pair

    def _gone(self) -> None:
        with self._lock:
            self.alive -= 1

    def _ready(self) -> None:
        self._ready_s[self._in_thread.name] = time.perf_counter()

    def on_frame(self, fused: FusedFrame) -> None:
        """Takes note of a fused frame; says now and then how it goes."""
        now_s, prepared = time.perf_counter(), fused.prepared
        began_s = now_s - prepared.stages_s["step"]
        could_s = max(self._ready_s.pop(prepared.ref.name), self._fused_s)
        if prepared.index:
            self.handover_ms.append(1e3 * (began_s - could_s))
        self._fused_s = now_s
        if (prepared.index + 1) % self._every == 0:
            self.resident_mib.append(resident_mib())
            late = np.array(self.handover_ms[-self._every :])
            print(
                f"{prepared.index + 1:7d} frames, {(prepared.index + 1) / (now_s - self._started_s):6.1f} a second; "
                f"resident {self.resident_mib[-1]:7.1f} MiB; most alive {self.most_alive}; a ready frame waited "
                f"{np.median(late):.2f} ms (median), over {STALL_MS:.0f} ms in {np.mean(late > STALL_MS):.2%}",
                flush=True,
            )


def resident_mib() -> float:
    """The resident size of this process (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def summary(watch: Watch, metrics: dict, every: int) -> dict[str, Any]:
    """What the run has shown."""
    later = watch.resident_mib[len(watch.resident_mib) // 2 :]
    slope = float(np.polyfit(every * np.arange(len(later)), later, 1)[0]) if len(later) > 1 else float("nan")
    late_ms = np.array(watch.handover_ms)
    return {
        "frames": metrics["sequence"]["fused"],
        "frames_per_s": metrics["times"]["frames_per_s"],
        "resident_mib": [round(one, 1) for one in watch.resident_mib],
        "slope_mib_per_1000_frames": round(1000 * slope, 3),
        "most_frames_alive": watch.most_alive,
        "ready_frame_waited_ms": {
            "median": round(float(np.median(late_ms)), 3),
            "p99": round(float(np.percentile(late_ms, 99)), 3),
            f"share_over_{STALL_MS:.0f}": round(float(np.mean(late_ms > STALL_MS)), 5),
        },
        "stages": metrics["times"]["stages"],
        "device": jax.devices()[0].device_kind,
    }


def main() -> None:
    """Runs the long drive."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10000)
    parser.add_argument("--every", type=int, default=1000)
    parser.add_argument("--size", type=int, nargs=2, default=[160, 120], metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    keep_compiled_programs()
    with tempfile.TemporaryDirectory() as name:
        write_views(Path(name, "views"), *given.size)
        config = check_config({"labeller": "plane", "depth": {"max_m": 5.0}, "grid": {"voxel_size_m": 0.2}})
        plan = looped(plan_run(str(Path(name, "views")), config, print), given.frames)
        watch, folder = Watch(plan, given.every), RunFolder(Path(name, "run"))
        folder.begin(plan.settings(config), resume=False, overwrite=False)
        options: dict[str, Any] = {"strict": True, "checkpoint_every_s": 30.0, "notify": print}
        metrics = run_plan(watch.plan, folder, on_frame=watch.on_frame, **options)
    figures = summary(watch, metrics, given.every)
    print(json.dumps(figures, indent=2))
    if given.json:
        given.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
