"""The compiled step with each labeller, growing with voxels and with the frames that were fused before."""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks import ours, peers
from benchmarks.groups import Group
from benchmarks.harness import Amount, Case, Peer
from benchmarks.scene import grid_of, make_scene

FUSED_BEFORE = {"small": 50, "medium": 500, "large": 2000}
STEP_LIMIT = 0.25
FLAT_LIMIT = 1.25


def step(labeller: str, size: str) -> Case:
    """One frame into 40 x 40 x 4 m, by the size of the voxels."""
    scene = make_scene()
    prepared = ours.Step(scene, ours.labeller_of(labeller), size)
    beside = peers.sgbm(scene)
    if labeller == "deeplab":
        beside = Peer("the network alone", lambda: ours.label_pixels(scene, ours.NETWORK_PX).run, 1.5, size == "medium")
    else:
        beside = beside._replace(limit=STEP_LIMIT, gated=size == "medium")
    return Case(
        prepared,
        Amount(int(np.prod(grid_of(size).shape)), "voxels"),
        Amount(1, "frames"),
        [beside],
        prepared.compile_s,
        prepared.temporary_bytes,
    )


def fused_before(size: str) -> Case:
    """The step into a map that holds many frames against the same step into one that holds few."""
    scene = make_scene()
    prepared = ours.Step(scene, ours.labeller_of("none"), "medium")
    prepared.drive(FUSED_BEFORE[size])
    return Case(
        prepared,
        Amount(FUSED_BEFORE[size], "frames fused before"),
        Amount(1, "frames"),
        [Peer("the same step, map empty at first", prepared.afresh, FLAT_LIMIT, size == "large")],
    )


GROUPS = (
    Group("step_none", "the step without labels: project, carve, fuse", partial(step, "none")),
    Group("step_plane", "the step: project, label by the MLESAC plane, carve, fuse", partial(step, "plane")),
    Group("step_deeplab", "the step: project, label by MobileNetV2, carve, fuse", partial(step, "deeplab")),
    Group("fused_before", "the step without labels, by the frames that were fused before", fused_before),
)
