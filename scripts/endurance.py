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
import tempfile
import threading
import time
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import yaml
from PIL import Image

from jaxmap.config import check_config, config_tree, load_config
from jaxmap.datasets.base import FrameRef, StereoPair
from jaxmap.datasets.pose_files import write_tum
from jaxmap.mapping import run_plan
from jaxmap.mapping_plan import Plan, plan_run
from jaxmap.run_folder import RunFolder
from jaxmap.sequence import FusedFrame
from jaxmap.stereo.front_end import RectifiedFrame, StereoFrontEnd

VIEWS = 12
AHEAD = 4
"""The default of `prepare_frames`."""
STALL_MS = 5.0


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


class Watch:
    """Counts frames that are alive, and sees when each became ready and was fused."""

    def __init__(self, plan: Plan, every: int) -> None:
        self._every, self._lock = every, threading.Lock()
        self.alive = self.most_alive = 0
        self._ready_s: dict[str, float] = {}
        self._step_end_s = 0.0
        self.handover_ms: list[float] = []
        self.resident_mib: list[tuple[int, float]] = []
        self.started_s = time.perf_counter()
        self.plan = replace(plan, sequence=replace(plan.sequence, read_pair=self._reading(plan)))

    def _reading(self, plan: Plan) -> Any:
        read = plan.sequence.read_pair

        def counted(ref: FrameRef) -> StereoPair:
            pair = read(ref)
            with self._lock:
                self.alive += 1
                self.most_alive = max(self.most_alive, self.alive)
            weakref.finalize(pair.left, self._gone)
            return pair

        return counted

    def _gone(self) -> None:
        with self._lock:
            self.alive -= 1
