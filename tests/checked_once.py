"""The quick check that every command begins with, made once for all tests that plan a run of the same images."""

from __future__ import annotations

import hashlib
from functools import cache

import jax
import numpy as np

import jaxmap.runs.checking
from jaxmap.checks.check import CheckReport, Extent
from jaxmap.datasets import StereoSequence
from jaxmap.errors import JaxmapError
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.types import StereoCamera

MOST_FRAMES = 8
"""Longer sequences take longer to read than to check."""


def key_of(sequence: StereoSequence, front_end: StereoFrontEnd, extent: Extent) -> str | None:
    """A fingerprint of all that a check looks at; None where that is not as simple as in the scene."""
    if not isinstance(sequence.camera, StereoCamera) or len(sequence.frames) > MOST_FRAMES:
        return None
    frames = [(ref.name, ref.timestamp_s) for ref in sequence.frames]
    reading = (sequence.name, sequence.pose_reading, sequence.pose_faults)
    key = hashlib.sha256(repr((frames, reading, front_end.matcher.options, front_end.alignment_rad, extent)).encode())
    arrays = [sequence.T_world_camera, *jax.tree.leaves((sequence.camera, front_end.camera))]
    try:
        for ref in sequence.frames:
            pair = sequence.read_pair(ref)
            arrays += [pair.left, pair.right]
    except JaxmapError:
        return None
    for array in map(np.asarray, arrays):
        key.update(repr((array.shape, array.dtype)).encode() + np.ascontiguousarray(array).tobytes())
    return key.hexdigest()


@cache
def check_once() -> None:
    """From now on, for all of the process."""
    check, reports = jaxmap.runs.checking.check_sequence, {}

    def checked(sequence: StereoSequence, front_end: StereoFrontEnd, extent: Extent) -> CheckReport:
        key = key_of(sequence, front_end, extent)
        if key is None:
            return check(sequence, front_end, extent)
        if key not in reports:
            reports[key] = check(sequence, front_end, extent)
        return reports[key]

    jaxmap.runs.checking.check_sequence = checked
