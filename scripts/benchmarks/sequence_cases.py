"""Whole sequences, growing with their frames: as `jaxmap map --labeller deeplab` runs them."""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks import ours, peers
from benchmarks.groups import Group
from benchmarks.harness import Amount, Case
from benchmarks.scene import make_scene, write_sequence

FRAMES = {"small": 8, "medium": 24, "large": 72}
RATE_SHARE = 0.45
"""Of the rate of SGBM alone on the same cores."""


@cache
def _written() -> TemporaryDirectory[str]:
    """The longest sequence; the folder goes with the program."""
    return write_sequence(make_scene(), max(FRAMES.values()))


def sequence(voxels: str, size: str) -> Case:
    """Read, match, label by the network, carve and fuse, against matching alone."""
    scene, frames = make_scene(), FRAMES[size]
    prepared = ours.map_sequence(scene, Path(_written().name), frames, voxels)
    beside = peers.sgbm(scene, frames)._replace(limit=1 / RATE_SHARE, gated=voxels == "medium" and size == "large")
    amount = Amount(frames, "frames")
    return Case(prepared.run, amount, amount, [beside], prepared.compile_s, prepared.temporary_bytes)


GROUPS = (
    Group("sequence", "1024 x 768, MobileNetV2 at 384 x 512, voxels of 0.2 m, by frames", partial(sequence, "medium")),
    Group("sequence_fine", "the same in the default voxels, 0.05 x 0.05 x 0.2 m", partial(sequence, "large")),
)
