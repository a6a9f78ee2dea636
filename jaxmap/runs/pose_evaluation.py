"""`jaxmap evaluate RUN --poses`: the poses of a run against true ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import jaxmap
from jaxmap.datasets.poses import PoseTrack, in_unit_of_frames, read_poses, with_timestamps
from jaxmap.errors import JaxmapError
from jaxmap.evaluation.pose_errors import LEAST_POSES, associate, pose_scores
from jaxmap.runs.folder import RunFolder

_GAP_S = 1.0
"""True poses farther apart say nothing of the unit of their times."""


def evaluate_poses(run: Path, truth: Path, max_diff_s: float, way_m: float) -> dict[str, Any]:
    """ATE and RPE of the poses of a run (`pose_errors.pose_scores`), and what they rest on.

    Args:
        run: a run folder.
        truth: true poses in any form that `read_poses` knows; without times, one for each pose of the run.
        max_diff_s: how far in time a pose and its true one may be apart.
        way_m: length of the pieces of the path over which the RPE is taken as well.

    Raises:
        JaxmapError: poses that are missing or cannot be read, or fewer than three that belong together.
    """
    mine, true = _usable(read_poses(RunFolder(run).poses)), read_poses(truth)
    times_s, given = mine.timestamps_s, len(true.T)
    if times_s is None:
        raise JaxmapError("the poses have no times", where=mine.where, fix="map again")
    timed = true.timestamps_s is not None
    true = _usable(in_unit_of_frames(true, times_s, _GAP_S) if timed else with_timestamps(true, times_s))
    assert true.timestamps_s is not None
    index, true_index = associate(times_s, true.timestamps_s, max_diff_s)
    if len(index) < LEAST_POSES:
        spans = (f"{span[0]:.3f} to {span[-1]:.3f} s" for span in (times_s, true.timestamps_s))
        raise JaxmapError(
            f"{len(index)} of {len(mine.T)} poses have a true one within {max_diff_s:g} s: times here are "
            f"{next(spans)}, there {next(spans)}",
            where=truth,
            fix="allow more with --max-diff-s, or give true poses of the same clock",
        )
    notes = [*true.notes, *true.faults]
    if true.child == "body":
        notes.append(
            f"{truth.name} holds poses of the body, the run those of its left camera: the errors hold the lever arm "
            "between the two"
        )
    return {
        "run": str(run),
        "truth": str(truth),
        "max_diff_s": max_diff_s,
        "poses_of_run": len(mine.T),
        "true_poses": given,
        **pose_scores(mine.T[index], true.T[true_index], way_m),
        "notes": notes,
        "jaxmap_version": jaxmap.__version__,
    }


def _usable(track: PoseTrack) -> PoseTrack:
    """The same poses without those that are NaN."""
    kept = track.usable
    times_s = track.timestamps_s
    return replace(track, T=track.T[kept], timestamps_s=None if times_s is None else np.asarray(times_s)[kept])
